"""Figures made of points and lines: comparison, errors, truth, chance, latency, optimiser."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bikeped.lab.governance.gates import SENSITIVITY_MIN, SPECIFICITY_MIN
from bikeped.lab.plotting import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT,
    RED,
    SERIES,
    FigureSheet,
    escape_dollars,
    to_floats,
    to_percents,
)
from bikeped.lab.simulation.truth import ATTENTIVE_PRT_S, PEDESTRIAN_PRT_S
from bikeped.types import FloatArray

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
            label = escape_dollars(f"{name.replace('_', ' ')}: {y:.1f} / {x:.1f}")
            axes.plot(x, y, marker, color=colour, label=label, markersize=8, zorder=3)
        low = min(85.0, np.floor(np.nanmin(points) / 5) * 5 - 2)
        axes.set(xlim=(low, 101), ylim=(low, 101))
        gate = (100 * SPECIFICITY_MIN, 100 * SENSITIVITY_MIN)
        axes.fill_between([gate[0], 101], gate[1], 101, color=LIGHT, alpha=0.55, zorder=0)
        axes.plot([gate[0], gate[0], 101], [101, gate[1], gate[1]], color=GREY, linewidth=1)
        axes.annotate(
            "both gates hold",
            (100.8, gate[1] + 0.4),
            ha="right",
            va="bottom",
            fontsize=8,
            color="#3d3d3d",
        )
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
            for bearing, (colour, marker, dash) in zip(bearings, SERIES, strict=False):
                part = [r for r in rows if r["kind"] == kind and r["bearing_deg"] == bearing]
                axes.plot(
                    [r["distance_m"] for r in part],
                    to_floats(r["error_m"] for r in part),
                    color=colour,
                    marker=marker,
                    linestyle=dash,
                    label=f"{bearing:g}° aside",
                )
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
    labels, groups = [], []
    for row in data["rows"]:
        _, form = names.get(row["parameter"], (row["parameter"], "{}"))
        text = "1.87 s + clearing" if row["value"] is None else form.format(row["value"])
        labels.append(escape_dollars(text + (" (default)" if row.get("default") else "")))
        groups.append(row["parameter"])
    # A gap between the groups makes room for each one's heading.
    places: list[float] = []
    headings: list[tuple[float, str]] = []
    place = -1.0
    for index, group in enumerate(groups):
        place += 1
        if index == 0 or groups[index - 1] != group:
            headings.append((place, str(names.get(group, (group, ""))[0])))
            place += 1
        places.append(place)
    panels = (
        ("sensitivity", "sensitivity, %", BLUE, "o"),
        ("specificity", "specificity, %", GREEN, "^"),
        ("sev_fn", "SevFN, %", RED, "s"),
    )
    with FigureSheet(title, caption, 7.0, 0.27 * len(places) + 1.6, 1, 3, sharey=True) as sheet:
        for axes, (key, label, colour, marker) in zip(sheet.axes, panels, strict=True):
            values = to_percents(r.get(key) for r in data["rows"])
            for y, x, row in zip(places, values, data["rows"], strict=True):
                fill = colour if row.get("default") else "white"
                axes.plot(x, y, marker, color=colour, markerfacecolor=fill, markersize=7)
                axes.annotate(
                    f"{x:.1f}", (x, y), (7, 0), textcoords="offset points", va="center", fontsize=8
                )
            default = [v for v, r in zip(values, data["rows"], strict=True) if r.get("default")]
            if default:
                axes.axvline(default[0], color=GREY, linewidth=0.8, linestyle=":")
            span = max(np.nanmax(values) - np.nanmin(values), 2.0)
            axes.set_xlim(np.nanmin(values) - 0.2 * span, np.nanmax(values) + 0.5 * span)
            axes.set_xlabel(label)
            axes.grid(visible=False, axis="y")
        first = sheet.axes[0]
        first.set_yticks(
            [*places, *(y for y, _ in headings)],
            [*labels, *(escape_dollars(t) for _, t in headings)],
        )
        for tick in first.get_yticklabels()[len(places) :]:
            tick.set_fontweight("bold")
        first.set_ylim(max(places) + 0.7, -0.7)
        for axes in sheet.axes:
            axes.tick_params(axis="y", length=0)
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
        for axes, (key, label) in zip(
            sheet.axes,
            (("sensitivity", "sensitivity, %"), ("specificity", "specificity, %")),
            strict=True,
        ):
            for index, (case, (colour, marker, _)) in enumerate(zip(cases, SERIES, strict=False)):
                part = {
                    r["configuration"]: r["metrics"].get(key, {})
                    for r in rows
                    if (r["loss"], r["recall"]) == case
                }
                mean, low, high = (
                    to_percents(part.get(n, {}).get(k) for n in names)
                    for k in ("mean", "low", "high")
                )
                y = np.arange(len(names)) + (index - (len(cases) - 1) / 2) * step
                loss = "bursts" if case[0] == "burst" else str(case[0])
                axes.errorbar(
                    mean,
                    y,
                    xerr=_whiskers(mean, low, high),
                    fmt=marker,
                    color=colour,
                    capsize=2.5,
                    linewidth=1.2,
                    markersize=5,
                    label=escape_dollars(f"{loss}, {words.get(case[1], case[1])}"),
                )
            axes.set_xlabel(label)
            for line in np.arange(len(names) - 1) + 0.5:
                axes.axhline(line, color=LIGHT, linewidth=0.7)
            axes.grid(visible=False, axis="y")
        first = sheet.axes[0]
        first.set_yticks(range(len(names)), [escape_dollars(n.replace("_", " ")) for n in names])
        first.set_ylim(len(names) - 0.5, -0.5)
        for axes in sheet.axes:
            axes.tick_params(axis="y", length=0)
        sheet.legend(columns=2)
        return sheet.save(folder, "montecarlo")


def latency(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Four figures over the camera's latency, by predictor."""
    panels = (
        ("sensitivity", "sensitivity, %", 100.0),
        ("specificity", "specificity, %", 100.0),
        ("sev_fn", "SevFN, %", 100.0),
        ("mean_warning_budget_s", "mean warning budget, s", 1.0),
    )
    with FigureSheet(title, caption, 7.0, 5.0, 2, 2, 1, sharex=True) as sheet:
        for axes, (key, label, scale) in zip(sheet.axes, panels, strict=True):
            for predictor, (colour, marker, dash) in zip(_PREDICTORS, SERIES, strict=False):
                if key in data.get(predictor, {}):
                    axes.plot(
                        data["delay_ms"],
                        to_floats(data[predictor][key], scale),
                        color=colour,
                        marker=marker,
                        linestyle=dash,
                        markersize=4,
                        label=_PREDICTORS[predictor],
                    )
            axes.set_ylabel(label)
            _reference(axes, key)
        for axes in sheet.axes[2:]:
            axes.set_xlabel("camera latency, ms")
        sheet.legend()
        return sheet.save(folder, "latency")


def loss_latency(data: Data, title: str, caption: str, folder: Path) -> list[Path]:
    """Latency and lost detections together, with intervals."""
    panels = (
        ("sensitivity", "sensitivity, %", 100.0),
        ("mean_warning_budget_s", "mean warning budget, s", 1.0),
    )
    found = data["predictors"]
    with FigureSheet(title, caption, 7.0, 3.1, 1, 2, 1) as sheet:
        for axes, (key, label, scale) in zip(sheet.axes, panels, strict=True):
            for predictor, (colour, marker, dash) in zip(_PREDICTORS, SERIES, strict=False):
                row = _by_figure(found.get(predictor), key)
                if row is None:
                    continue
                mean, low, high = (to_floats(row[k], scale) for k in ("mean", "low", "high"))
                axes.fill_between(data["delay_ms"], low, high, color=colour, alpha=0.18, lw=0)
                axes.plot(
                    data["delay_ms"],
                    mean,
                    color=colour,
                    marker=marker,
                    linestyle=dash,
                    label=_PREDICTORS[predictor],
                )
            axes.set_ylabel(label)
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
        axes.annotate(
            f"{trace[-1, 1]:.3f}",
            (trace[-1, 0], trace[-1, 1]),
            (0, 6),
            textcoords="offset points",
            ha="right",
            va="bottom",
        )
        start = data.get("start", {}).get("cost")
        if start is not None:
            axes.axhline(start, color=GREY, linestyle="--", linewidth=1)
            axes.annotate(
                f"configuration in force: {start:.3f}",
                (0.99, start),
                (0, 3),
                xycoords=("axes fraction", "data"),
                textcoords="offset points",
                ha="right",
                va="bottom",
                fontsize=8,
                color="#3d3d3d",
            )
        if trace[:, 1].max() > 4 * trace[-1, 1]:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
            axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("configurations tried")
        axes.set_ylabel("cost (lower is better)")
        return sheet.save(folder, "optimize")


def _whiskers(mean: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Lengths of the interval's two arms; none where there is no interval."""
    return np.nan_to_num(np.maximum(np.stack([mean - low, high - mean]), 0.0))


def _by_figure(rows: Any, key: str) -> dict[str, list[float | None]] | None:
    """Means and ends as lists over the delays, whether they come as lists or one by one."""
    if rows is None:
        return None
    if isinstance(rows, list):
        return {k: [r[key][k] for r in rows] for k in ("mean", "low", "high")}
    found = rows.get(key)
    if isinstance(found, list):
        return {k: [r[k] for r in found] for k in ("mean", "low", "high")}
    return found if found is None else {k: list(found[k]) for k in ("mean", "low", "high")}


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
        axes.annotate(
            text,
            (0.01, value),
            (0, 2),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            fontsize=7.5,
            va="bottom",
            color="#3d3d3d",
        )
    if key == "mean_warning_budget_s":
        axes.set_ylim(0, None)  # last, for it ends the automatic scale
