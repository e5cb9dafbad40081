"""Line and point figures: comparison, errors, truth, Monte Carlo, latency, optimiser."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bikeped.lab.governance.gates import SENSITIVITY_MIN, SPECIFICITY_MIN
from bikeped.lab.plotting import (
    BLACK,
    BLUE,
    DARK,
    GREEN,
    GREY,
    LIGHT,
    RED,
    SERIES,
    FigureSheet,
    escape_dollars,
    label,
    means_and_arms,
    plot_series,
    to_floats,
    to_percents,
)
from bikeped.lab.simulation.truth import ATTENTIVE_PRT_S, PEDESTRIAN_PRT_S

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Data = Mapping[str, Any]
_PREDICTORS = {"none": "no prediction", "first": "first order", "second": "second order"}


def compare(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Sensitivity over specificity, with and without localisation error."""
    with FigureSheet(title, caption, 7.0, 4.2) as sheet:
        axes = sheet.axes[0]
        without = data.get("without_localisation_error", {})
        points = []
        for (name, row), (colour, marker, _) in zip(
            data["configurations"].items(), SERIES, strict=False
        ):
            x, y = to_percents([row["specificity"], row["sensitivity"]])
            points += [x, y]
            other = without.get(name)
            if other is not None:
                x0, y0 = to_percents([other["specificity"], other["sensitivity"]])
                axes.plot([x0, x], [y0, y], color=colour, linewidth=0.8, zorder=2)
                axes.plot(x0, y0, marker, color=colour, markerfacecolor="white", markersize=6)
            text = escape_dollars(f"{name.replace('_', ' ')}: {y:.1f} / {x:.1f}")
            axes.plot(x, y, marker, color=colour, label=text, markersize=8, zorder=3)
        low = min(85.0, np.floor(np.nanmin(points) / 5) * 5 - 2)
        axes.set(xlim=(low, 101), ylim=(low, 101))
        gate = (100 * SPECIFICITY_MIN, 100 * SENSITIVITY_MIN)
        axes.fill_between([gate[0], 101], gate[1], 101, color=LIGHT, alpha=0.55, zorder=0)
        axes.plot([gate[0], gate[0], 101], [101, gate[1], gate[1]], color=GREY, linewidth=1)
        label(axes, "both gates hold", (100.8, gate[1] + 0.4), ha="right", va="bottom", color=DARK)
        axes.set_xlabel("specificity, % (quiet when there is no danger)")
        axes.set_ylabel("sensitivity, % (alert in actionable danger)")
        axes.legend(
            title="sensitivity / specificity, %\nhollow: without localisation error",
            loc="center left",
            bbox_to_anchor=(1.01, 0.5),
            alignment="left",
            title_fontsize=8,
        )
        return sheet.save(folder, "compare")


def error_lines(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Localisation error over distance by kind and bearing."""
    rows = data["table"]
    kinds = list(dict.fromkeys(str(r["kind"]) for r in rows))
    bearings = list(dict.fromkeys(r["bearing_deg"] for r in rows))
    with FigureSheet(title, caption, 7.0, 3.2, 1, len(kinds), 1, sharey=True) as sheet:
        for axes, kind in zip(sheet.axes, kinds, strict=True):
            for bearing, style in zip(bearings, SERIES, strict=False):
                part = [r for r in rows if r["kind"] == kind and r["bearing_deg"] == bearing]
                distance, error = ([r[key] for r in part] for key in ("distance_m", "error_m"))
                text = f"{bearing:g}° aside"
                plot_series(axes, distance, to_floats(error), style, label=text)
            axes.set_title(kind)
            axes.set_xlabel("distance, m")
            axes.set_xlim(0, None)
        sheet.axes[0].set_ylim(0, None)
        sheet.axes[0].set_ylabel("localisation error, m")
        sheet.legend()
        return sheet.save(folder, "errors")


def truth(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Figures under other thresholds of the ground truth."""
    names = {
        "cpa_radius_m": ("passing distance that counts", "{:g} m"),
        "stopping_margin": ("share of the gap needed to stop", "{:.1f}"),
        "ttc_bound_s": ("time to contact", "{:g} s"),
    }
    rows = data["rows"]
    # Ticks in order: a heading before each group, which takes a row of its own, and its rows.
    ticks: list[str] = []
    headings: list[int] = []
    places: list[int] = []
    for index, row in enumerate(rows):
        heading, form = names.get(row["parameter"], (row["parameter"], "{}"))
        if index == 0 or rows[index - 1]["parameter"] != row["parameter"]:
            headings.append(len(ticks))
            ticks.append(heading)
        text = "1.87 s + clearing" if row["value"] is None else form.format(row["value"])
        places.append(len(ticks))
        ticks.append(text + (" (default)" if row.get("default") else ""))
    panels = (
        ("sensitivity", "sensitivity, %", BLUE, "o"),
        ("specificity", "specificity, %", GREEN, "^"),
        ("sev_fn", "SevFN, %", RED, "s"),
    )
    with FigureSheet(title, caption, 7.0, 0.27 * len(rows) + 1.6, 1, 3, sharey=True) as sheet:
        for axes, (key, text, colour, marker) in zip(sheet.axes, panels, strict=True):
            values = to_percents(r.get(key) for r in rows)
            for y, x, row in zip(places, values, rows, strict=True):
                inside = colour if row.get("default") else "white"
                axes.plot(x, y, marker, color=colour, markerfacecolor=inside, markersize=7)
                label(axes, f"{x:.1f}", (x, y), (7, 0), va="center")
            default = [v for v, r in zip(values, rows, strict=True) if r.get("default")]
            if default:
                axes.axvline(default[0], color=GREY, linewidth=0.8, linestyle=":")
            span = max(np.nanmax(values) - np.nanmin(values), 2.0)
            axes.set_xlim(np.nanmin(values) - 0.2 * span, np.nanmax(values) + 0.5 * span)
            axes.set_xlabel(text)
        sheet.label_rows(ticks, -0.7)
        for index in headings:
            sheet.axes[0].get_yticklabels()[index].set_fontweight("bold")
        return sheet.save(folder, "truth")


def montecarlo(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Mean sensitivity of every configuration with its interval, by loss and recall."""
    rows = data["rows"]
    names = list(dict.fromkeys(r["configuration"] for r in rows))
    cases = list(dict.fromkeys((r["loss"], r["recall"]) for r in rows))
    words = {"flat": "one recall", "size": "recall by size", "curve": "recall curve"}
    step = 0.8 / len(cases)
    height = 0.17 * len(names) * len(cases) + 1.4
    with FigureSheet(
        title, caption, 7.0, height, 1, 2, (len(cases) + 1) // 2, sharey=True
    ) as sheet:
        panels = (("sensitivity", "sensitivity, %"), ("specificity", "specificity, %"))
        for axes, (key, text) in zip(sheet.axes, panels, strict=True):
            for index, (case, (colour, marker, _)) in enumerate(zip(cases, SERIES, strict=False)):
                part = {
                    r["configuration"]: r["metrics"].get(key, {})
                    for r in rows
                    if (r["loss"], r["recall"]) == case
                }
                mean, arms = means_and_arms(part.get(n, {}) for n in names)
                loss = "bursts" if case[0] == "burst" else str(case[0])
                axes.errorbar(
                    mean,
                    np.arange(len(names)) + (index - (len(cases) - 1) / 2) * step,
                    xerr=arms,
                    fmt=marker,
                    color=colour,
                    capsize=2.5,
                    linewidth=1.2,
                    markersize=5,
                    label=escape_dollars(f"{loss}, {words.get(case[1], case[1])}"),
                )
            axes.set_xlabel(text)
            for line in np.arange(len(names) - 1) + 0.5:
                axes.axhline(line, color=LIGHT, linewidth=0.7)
        sheet.label_rows([n.replace("_", " ") for n in names])
        sheet.legend(columns=2)
        return sheet.save(folder, "montecarlo")


_PANELS = {
    "sensitivity": ("sensitivity, %", 100.0),
    "specificity": ("specificity, %", 100.0),
    "sev_fn": ("SevFN, %", 100.0),
    "mean_warning_budget_s": ("mean warning budget, s", 1.0),
}


def latency(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Four metrics over the camera's latency, by predictor."""
    with FigureSheet(title, caption, 7.0, 5.0, 2, 2, 1, sharex=True) as sheet:
        for axes, (key, (text, scale)) in zip(sheet.axes, _PANELS.items(), strict=True):
            for (predictor, name), style in zip(_PREDICTORS.items(), SERIES, strict=False):
                if key in data.get(predictor, {}):
                    y = to_floats(data[predictor][key], scale)
                    plot_series(axes, data["delay_ms"], y, style, markersize=4, label=name)
            axes.set_ylabel(text)
            _reference(axes, key)
        for axes in sheet.axes[2:]:
            axes.set_xlabel("camera latency, ms")
        sheet.legend()
        return sheet.save(folder, "latency")


def loss_latency(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Latency and missed detections together, with intervals."""
    with FigureSheet(title, caption, 7.0, 3.1, 1, 2, 1) as sheet:
        for axes, key in zip(sheet.axes, ("sensitivity", "mean_warning_budget_s"), strict=True):
            text, scale = _PANELS[key]
            for (predictor, name), style in zip(_PREDICTORS.items(), SERIES, strict=False):
                row = data["predictors"].get(predictor, {}).get(key)
                if row is None:
                    continue
                mean, low, high = (to_floats(row[k], scale) for k in ("mean", "low", "high"))
                axes.fill_between(data["delay_ms"], low, high, color=style[0], alpha=0.18, lw=0)
                plot_series(axes, data["delay_ms"], mean, style, label=name)
            axes.set_ylabel(text)
            axes.set_xlabel("camera latency, ms")
            _reference(axes, key)
        sheet.legend()
        return sheet.save(folder, "loss_latency")


def optimize(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """The best cost so far over the number of evaluations."""
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    trace = np.asarray(data["trace"], dtype=np.float64)
    with FigureSheet(title, caption, 7.0, 3.0) as sheet:
        axes = sheet.axes[0]
        axes.step(trace[:, 0], trace[:, 1], where="post", color=BLUE)
        axes.plot(trace[-1, 0], trace[-1, 1], "o", color=BLUE)
        end = (trace[-1, 0], trace[-1, 1])
        label(axes, f"{end[1]:.3f}", end, (0, 6), ha="right", va="bottom", fontsize=None)
        start = data.get("start", {}).get("cost")
        if start is not None:
            axes.axhline(start, color=GREY, linestyle="--", linewidth=1)
            place = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
            text = f"configuration in force: {start:.3f}"
            label(axes, text, (0.99, start), (0, 3), color=DARK, **place)
        if trace[:, 1].max() > 4 * trace[-1, 1]:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("configurations tried")
        axes.set_ylabel("cost (lower is better)")
        return sheet.save(folder, "optimize")


def _reference(axes: Axes, key: str) -> None:
    """Reaction times beside a budget, the gate beside a share."""
    lines: list[tuple[float, str]] = []
    if key == "mean_warning_budget_s":
        lines = [
            (PEDESTRIAN_PRT_S, f"distracted {PEDESTRIAN_PRT_S:g} s"),
            (ATTENTIVE_PRT_S, f"attentive {ATTENTIVE_PRT_S:g} s"),
        ]
    elif key in ("sensitivity", "specificity"):
        gate = 100 * (SENSITIVITY_MIN if key == "sensitivity" else SPECIFICITY_MIN)
        lines = [(gate, f"gate {gate:g} %")]
    for value, text in lines:
        axes.axhline(value, color=BLACK, linewidth=0.9, linestyle=(0, (4, 3)))
        place = {"xycoords": ("axes fraction", "data"), "va": "bottom"}
        label(axes, text, (0.01, value), (0, 2), fontsize=7.5, color=DARK, **place)
    if key == "mean_warning_budget_s":
        axes.set_ylim(0, None)  # last, for it ends the automatic scale
