"""A strip chart of one scenario: distance over time, danger, states, alerts, time to react."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bikeped.config import DecisionConfig, rule_settings
from bikeped.decision.episodes import onsets, runs
from bikeped.lab.plotting import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    RED,
    SKY,
    FigureSheet,
    escape_dollars,
    file_stem,
    fill,
    label,
)
from bikeped.lab.simulation.simulate import verdicts
from bikeped.lab.simulation.suite import Suite
from bikeped.lab.simulation.truth import PEDESTRIAN_PRT_S, GroundTruth
from bikeped.types import BoolArray, FloatArray, State

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Colour, hatch and text colour of a state's band; the letters make it readable in grey.
_STATE_STYLES = {
    State.IDLE: (SKY, "", BLACK),
    State.SAFE: ("#7fcdbb", "", BLACK),
    State.WARNING: (ORANGE, "//", BLACK),
    State.ALERT: (RED, "", "white"),
}
#: Longer distances do not matter to an encounter, m.
_TOP_M = 30.0
#: A label on a white ground, above all else.
_BOXED: dict[str, Any] = {
    "bbox": {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 0.6},
    "zorder": 6,
}


def draw_strip(suite: Suite, decision: DecisionConfig, index: int, folder: Path) -> list[Path]:
    """Writes `<scenario>-strip.png` and `.pdf` of the suite's scenario `index`."""
    scenario, truth = suite.scenarios[index], suite.truths[index]
    part = suite.rule_input.frame_slice(index)
    state = suite.states(decision)[part]
    title = f"{scenario.name}: distance, danger and alerts"
    caption = (
        "Line: true distance of the nearest cyclist and pedestrian; dots: distance that made the "
        "camera alert. Shaded: danger in which a warning still helps, and hatched, danger that "
        "comes too soon. Arrow: what a distracted person needs to react."
    )
    ratios = {"height_ratios": [6, 1]}
    with FigureSheet(title, caption, 7.0, 3.5, 2, 1, 2, sharex=True, gridspec_kw=ratios) as sheet:
        main, band = sheet.axes
        onset = onsets(state == State.ALERT)
        _shade(main, truth)
        _distances(main, suite, decision, index)
        _moments(main, truth, onset)
        _band(band, truth.time_s, state)
        band.set_xlabel("time, s")
        band.set_xlim(0, truth.time_s[-1] + 1 / 30)
        sheet.legend(_legend(), columns=4)
        return sheet.save(folder, f"{file_stem(scenario.name)}-strip")


def spans(mask: BoolArray, time_s: FloatArray) -> list[tuple[float, float]]:
    """From and to of the runs of true frames, each frame lasting 1/30 s."""
    return [
        (float(time_s[a]), float(time_s[b - 1]) + 1 / 30) for a, b in runs(mask).tolist() if mask[a]
    ]


def _shade(axes: Axes, truth: GroundTruth) -> None:
    for begin, end in spans(truth.actionable, truth.time_s):
        axes.axvspan(begin, end, color="#fbd9a0", alpha=0.75, linewidth=0, zorder=0)
    for begin, end in spans(truth.imminent, truth.time_s):
        axes.axvspan(
            begin, end, facecolor="#f3b49b", edgecolor="#b45028", hatch="////", lw=0, zorder=0
        )


def _distances(axes: Axes, suite: Suite, decision: DecisionConfig, index: int) -> None:
    truth = suite.truths[index]
    nearest = np.where(np.isfinite(truth.nearest_m), truth.nearest_m, np.nan)
    axes.plot(truth.time_s, nearest, color=BLUE, zorder=3)
    part = suite.rule_input.frame_slice(index)
    found = verdicts(suite.rule_input, rule_settings(decision))
    frame = suite.rule_input.rows.frame[suite.rule_input.pairs.pedestrian_row]
    fired = found.fires & (frame >= part.start) & (frame < part.stop)
    seconds = suite.rule_input.time_s[frame[fired]]
    axes.plot(seconds, found.distance_m[fired], ".", color=RED, markersize=3, zorder=4)
    if np.isfinite(nearest).any():
        top = float(np.nanmax(nearest))
    else:
        top = 10.0
        place: dict[str, Any] = {"xycoords": "axes fraction", "ha": "center", "fontsize": None}
        label(axes, "no cyclist and pedestrian at the same time", (0.5, 0.5), color=GREY, **place)
    axes.set_ylim(0, min(max(top * 1.08, 6.0), _TOP_M))
    axes.set_ylabel("distance, m")


def _moments(axes: Axes, truth: GroundTruth, onset: BoolArray) -> None:
    """Onsets with their budget, the closest approach, and the time that a person needs."""
    top = axes.get_ylim()[1]
    last_label = -np.inf
    for number, frame in enumerate(np.nonzero(onset)[0]):
        at = float(truth.time_s[frame])
        axes.axvline(at, color=RED, linewidth=1.3, zorder=2)
        budget = float(truth.budget_s[frame])
        if number == 0:
            arrow = {"arrowstyle": "->", "color": BLACK, "linewidth": 1.5, "shrinkA": 0}
            ends = (at + PEDESTRIAN_PRT_S, top * 0.06), (at, top * 0.06)
            axes.annotate("", *ends, arrowprops=arrow, zorder=6)
            middle = (at + PEDESTRIAN_PRT_S / 2, top * 0.06)
            label(axes, f"{PEDESTRIAN_PRT_S:g} s", middle, (0, 3), ha="center", **_BOXED)
        if np.isfinite(budget) and at - last_label > 1.6:
            last_label = at
            text = f"budget {budget:.2f} s"
            label(axes, text, (at, top * 0.985), (3, 0), va="top", color="#8c2d04", **_BOXED)
    if np.isfinite(truth.nearest_m).any():
        closest = int(np.argmin(truth.nearest_m))
        at, distance = float(truth.time_s[closest]), float(truth.nearest_m[closest])
        axes.plot(at, distance, "v", color=BLACK, markersize=8, zorder=5, clip_on=False)
        label(axes, f"{distance:.1f} m", (at, distance), (6, 7), **_BOXED)


def _band(axes: Axes, time_s: FloatArray, state: np.ndarray[Any, np.dtype[np.int8]]) -> None:
    """The state over time as a band with its names."""
    for code in State:
        colour, hatch, ink = _STATE_STYLES[code]
        for begin, end in spans(np.asarray(state == int(code)), time_s):
            axes.barh(0, end - begin, 1.0, left=begin, **fill(colour, hatch))
            # About 0.11 in a letter; shorter spans have their colour only.
            if (end - begin) / time_s[-1] * 6.2 > 0.11 * len(code.name):
                box = {"facecolor": colour, "edgecolor": "none", "pad": 1.0}
                centred: dict[str, Any] = {
                    "ha": "center",
                    "va": "center",
                    "fontweight": "bold",
                    "bbox": box,
                }
                middle = ((begin + end) / 2, 0)
                axes.text(*middle, code.name, fontsize=7.5, color=ink, **centred)
    axes.set_yticks([])
    axes.set_ylim(-0.5, 0.5)
    axes.set_ylabel("state", rotation=0, ha="right", va="center")
    axes.grid(visible=False)
    axes.spines["left"].set_visible(False)


def _legend() -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Line2D([], [], color=BLUE, label="true distance"),
        Line2D([], [], color=RED, marker=".", linestyle="", label="measured, alerting"),
        Line2D([], [], color=RED, label="alert begins"),
        Line2D([], [], color=BLACK, marker="v", linestyle="", label="closest approach"),
        Patch(facecolor="#fbd9a0", label="danger, actionable"),
        Patch(facecolor="#f3b49b", edgecolor="#b45028", hatch="////", label="danger, imminent"),
        Line2D([], [], color=BLACK, marker=">", label=escape_dollars("time to react")),
    ]
