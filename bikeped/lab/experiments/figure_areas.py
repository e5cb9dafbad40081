"""Bar charts and maps: budgets, deployment, placement, braking, the map of errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bikeped.lab.plotting import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    SKY,
    FigureSheet,
    escape_dollars,
    fill,
    label,
    means_and_arms,
    to_floats,
    to_percents,
)
from bikeped.lab.simulation.truth import ATTENTIVE_PRT_S, PEDESTRIAN_PRT_S
from bikeped.types import FloatArray

Data = Mapping[str, Any]
#: Pairs farther from the camera are not evaluated, m (definitions, section 8).
MAX_RANGE_M = 25.0
#: Colour, hatch and legend of a budget's class.
_CLASSES = {
    "above distracted": (GREEN, "", f"above {PEDESTRIAN_PRT_S:g} s: even a distracted person"),
    "above attentive": (ORANGE, "///", f"above {ATTENTIVE_PRT_S:g} s: an attentive person only"),
    "below": (RED, "xxx", "below: too late to react"),
}


def budgets(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Bars of the mean budget by scenario, coloured by the worst onset; onsets as ticks."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    rows = sorted(data["rows"], key=lambda r: (-(r["mean"] or -1.0), r["scenario"]))
    with FigureSheet(title, caption, 7.0, 0.24 * len(rows) + 0.8, legend_rows=3) as sheet:
        axes = sheet.axes[0]
        for y, row in enumerate(rows):
            colour, hatch, _ = _CLASSES.get(row["class"], (GREY, "", row["class"]))
            axes.barh(y, row["mean"] or 0.0, 0.72, zorder=2, **fill(colour, hatch))
            if row["mean"] is None:
                label(axes, "no alert with a budget", (0, y), (4, 0), va="center")
            at = [y] * len(row["onsets"])
            ticks: dict[str, Any] = {"markersize": 10, "markeredgewidth": 1.6, "zorder": 3}
            axes.plot(row["onsets"], at, "|", color=BLACK, **ticks)
        for value, dash in ((PEDESTRIAN_PRT_S, "-"), (ATTENTIVE_PRT_S, "--")):
            axes.axvline(value, color=BLACK, linewidth=1.1, linestyle=dash, zorder=4)
        sheet.label_rows([r["scenario"] for r in rows], -0.6)
        axes.set_xlim(0, None)
        axes.set_xlabel("warning budget, s (from the alert to the closest approach)")
        present = {r["class"] for r in rows}
        handles: list[Any] = [
            Patch(label=text, **fill(c, h))
            for key, (c, h, text) in _CLASSES.items()
            if key in present
        ]
        handles += [
            Line2D([], [], color=BLACK, label=f"distracted, {PEDESTRIAN_PRT_S:g} s"),
            Line2D([], [], color=BLACK, linestyle="--", label=f"attentive, {ATTENTIVE_PRT_S:g} s"),
            Line2D([], [], color=BLACK, marker="|", linestyle="", markersize=9, label="one alert"),
        ]
        sheet.legend(handles, columns=2)
        return sheet.save(folder, "budgets")


def deployment(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Bars of the sensitivity by road width, one camera and two, for each mount."""
    rows = data["rows"]
    mounts = list(dict.fromkeys((r["height_m"], r["pitch_deg"]) for r in rows))
    styles = {1: (SKY, "///"), 2: (BLUE, "")}
    with FigureSheet(title, caption, 7.0, 3.2, 1, len(mounts), 1, sharey=True) as sheet:
        for axes, (height, pitch) in zip(sheet.axes, mounts, strict=True):
            part = [r for r in rows if (r["height_m"], r["pitch_deg"]) == (height, pitch)]
            widths = sorted({r["width_ft"] for r in part})
            counts = sorted({r["cameras"] for r in part})
            for number, cameras in enumerate(counts):
                found = {r["width_ft"]: r for r in part if r["cameras"] == cameras}
                x = np.arange(len(widths)) + (number - (len(counts) - 1) / 2) * 0.4
                rows_by_width = [found.get(w, {}) for w in widths]
                mean, arms = means_and_arms(r.get("sensitivity", {}) for r in rows_by_width)
                name = f"{cameras} camera{'s' if cameras != 1 else ''}"
                axes.bar(x, mean, 0.38, label=name, **fill(*styles.get(cameras, (GREY, ".."))))
                axes.errorbar(x, mean, yerr=arms, fmt="none", color=BLACK, capsize=3, linewidth=1.2)
                for place, value, arm in zip(x, mean, arms[1], strict=True):
                    label(axes, f"{value:.0f}", (place, value + arm), (0, 2), ha="center")
                lower, _ = means_and_arms(
                    r.get("visible_only", {}).get("sensitivity", {}) for r in rows_by_width
                )
                if np.isfinite(lower).any():
                    name = "if objects out of sight are never detected"
                    dash: dict[str, Any] = {"markersize": 13, "markeredgewidth": 2}
                    axes.plot(x, lower, "_", color=BLACK, label=None if number else name, **dash)
            axes.set_title(f"{height:g} m high, pitch {pitch:g}°")
            axes.set_xticks(range(len(widths)), [f"{w:g}" for w in widths])
            axes.set_xlabel("road width, ft")
            axes.set_ylim(0, 105)
            axes.grid(visible=False, axis="x")
        sheet.axes[0].set_ylabel("sensitivity, %")
        sheet.legend()
        return sheet.save(folder, "deployment")


def placement(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Sensitivity by height and pitch; beside it, when known, with objects out of sight missed."""
    grids = {"": np.stack([to_percents(row) for row in data["sensitivity"]])}
    if "visible_only_sensitivity" in data:
        other = np.stack([to_percents(row) for row in data["visible_only_sensitivity"]])
        if not np.allclose(other, grids[""], atol=0.05, equal_nan=True):
            grids = {"as the paper counts": grids[""], "objects out of sight never detected": other}
    heights, pitches = data["height_m"], data["pitch_deg"]
    values = np.concatenate([g[np.isfinite(g)] for g in grids.values()])
    # A few cells that see nothing must not take the scale from the others.
    low = 5.0 * np.floor(np.percentile(values, 8) / 5) if len(values) else 0.0
    high = max(5.0 * np.ceil(values.max() / 5), low + 10) if len(values) else 100.0
    width = 3.4 * len(grids) + 0.7 if len(grids) > 1 else 6.0
    with FigureSheet(title, caption, width, 4.2, 1, len(grids), sharey=True) as sheet:
        image = None
        for axes, (name, grid) in zip(sheet.axes, grids.items(), strict=True):
            image = axes.imshow(
                grid, origin="lower", aspect="auto", cmap="cividis", vmin=low, vmax=high
            )
            for (i, j), value in np.ndenumerate(grid):
                text = "-" if np.isnan(value) else f"{value:.0f}"
                colour = "white" if value < (low + high) / 2 else BLACK
                axes.text(j, i, text, ha="center", va="center", fontsize=7, color=colour)
            axes.set_xticks(range(len(pitches)), [f"{p + 0.0:g}" for p in pitches])
            axes.set_yticks(range(len(heights)), [f"{h:g}" for h in heights])
            axes.grid(visible=False)
            axes.spines[:].set_visible(False)
            axes.set_xlabel("pitch, degrees (0: level, -90: straight down)")
            axes.set_title(name)
        sheet.axes[0].set_ylabel("camera height, m")
        if image is not None:
            sheet.colour_bar(image, "sensitivity, %", "min", pad=0.015)
        return sheet.save(folder, "placement")


def braking(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Figures under each braking profile of the ground truth."""
    words = {
        "scenario": "as each scenario has it",
        "bicycle": "bicycle: 0.84 s, 1.96 m/s²",
        "ebike": "e-bike: 0.84 s, 6.0 m/s²",
        "aashto": "AASHTO: 2.5 s, 3.4 m/s²",
    }
    panels = (
        ("sensitivity", "sensitivity, %", BLUE, ""),
        ("specificity", "specificity, %", GREEN, "///"),
        ("sev_fn", "SevFN, %", RED, "..."),
    )
    rows = data["rows"]
    with FigureSheet(title, caption, 7.0, 0.36 * len(rows) + 1.0, 1, 3, sharey=True) as sheet:
        for axes, (key, text, colour, hatch) in zip(sheet.axes, panels, strict=True):
            values = to_percents(r["metrics"].get(key) for r in rows)
            axes.barh(range(len(rows)), np.nan_to_num(values), 0.66, **fill(colour, hatch))
            room = 100.0 if np.nanmax(values) > 50 else float(np.nanmax(values)) * 1.1 + 1
            for y, value in enumerate(values):
                number = "-" if np.isnan(value) else f"{value:.1f}"
                label(axes, number, (np.nan_to_num(value), y), (3, 0), va="center")
            axes.set_xlim(0, room * 1.22)
            if room == 100.0:
                axes.set_xticks(range(0, 101, 25))
            axes.set_xlabel(text)
        sheet.label_rows([words.get(r["profile"], r["profile"]) for r in rows])
        return sheet.save(folder, "braking")


def error_map(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """The ground in front of the camera, coloured by the localisation error, with contours."""
    from matplotlib.patches import Wedge

    maps = data["map"]
    limit = 3.0
    with FigureSheet(
        title, caption, 7.0, 2.6 * len(maps) + 0.4, len(maps), 1, sharex=True
    ) as sheet:
        image = None
        for axes, (kind, part) in zip(sheet.axes, maps.items(), strict=True):
            x, y = np.asarray(part["x_m"]), np.asarray(part["y_m"])
            error: FloatArray = np.stack([to_floats(row) for row in part["error_m"]])
            # Beyond the range of decisions nothing is used.
            distance = np.hypot(*np.meshgrid(x, y, indexing="ij"))
            beyond, near = distance > MAX_RANGE_M + 1, distance < 5
            # Close by, objects are cut by the image's edge and contours would be noise.
            calm = np.where(beyond | near, np.nan, error)
            image = axes.pcolormesh(
                y, x, error, cmap="cividis", vmin=0, vmax=limit, rasterized=True
            )
            lines = axes.contour(y, x, calm, [0.5, 1.0, 2.0], colors="white", linewidths=1.0)
            half = Wedge((0, 0), MAX_RANGE_M, 0, 180, transform=axes.transData)
            image.set_clip_path(half)
            lines.set_clip_path(half)
            axes.clabel(lines, fmt="%g m", fontsize=7.5)
            axes.plot(0, 0, "^", color=BLACK, markersize=8, clip_on=False)
            axes.set_aspect("equal")
            axes.set_title(escape_dollars(kind))
            axes.set_ylabel("ahead, m")
            axes.set_ylim(0, 25.5)
            axes.set_xlim(-25.5, 25.5)
        sheet.axes[-1].set_xlabel("to the right of the camera, m")
        if image is not None:
            sheet.colour_bar(image, "localisation error, m", "max", shrink=0.6)
        return sheet.save(folder, "errors_map")
