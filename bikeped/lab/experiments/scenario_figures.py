"""Figures of one scenario: a strip chart over time, and a plan from above."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bikeped.config.schema import DecisionConfig
from bikeped.decision.episodes import onsets, runs
from bikeped.lab.plotting import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    FigureSheet,
    escape_dollars,
    file_stem,
    fill,
    label,
)
from bikeped.lab.scenarios.scenario import Agent, Scenario
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
        sheet.legend(_strip_legend(), columns=4)
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
    found = verdicts(suite.rule_input, suite.tracker.rule(decision))
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


def _strip_legend() -> list[Any]:
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


RANGE_M = 25.0
RINGS_M = (5, 10, 15, 20, 25)
#: The crosswalk of the drawn scenes in the world frame, m: from west to east, from south to north.
CROSSWALK_M = ((3.4, 6.6), (-6.0, 6.0))
#: By kind of road user: colour, marker, dash.
_STYLES = {
    "pedestrian": (GREEN, "o", "-"),
    "cyclist": (BLUE, "s", "-"),
    "motorcycle": (PURPLE, "D", "--"),
}
_VEHICLE = (GREY, "^", ":")
_MARGIN_M = 3.0


def draw_plan(suite: Suite, decision: DecisionConfig, index: int, folder: Path) -> list[Path]:
    """Writes `<scenario>-plan.png` and `.pdf` of the suite's scenario `index`."""
    scenario = suite.scenarios[index]
    box = _bounds(suite, scenario)
    width = 7.0
    aspect = (box[3] - box[2]) / (box[1] - box[0])
    height = min(max(width * 0.92 * aspect + 0.5, 3.2), 8.0)
    caption = (
        "Seen from above. Marks every second with the time in seconds, arrows where people "
        "head. Rings: distance from the camera. Star and cross: cyclist and pedestrian when an "
        "alert begins."
    )
    kinds = list(dict.fromkeys(a.kind for a in scenario.agents))
    entries = len(kinds) + 3
    columns = entries if entries <= 5 else 3
    rows = -(-entries // columns)
    with FigureSheet(f"{scenario.name}: plan", caption, width, height, legend_rows=rows) as sheet:
        axes = sheet.axes[0]
        axes.set_aspect("equal")
        axes.set_xlim(box[0], box[1])
        axes.set_ylim(box[2], box[3])
        axes.grid(visible=False)
        _crosswalk(axes)
        _camera(axes, suite)
        for agent in scenario.agents:
            _path(axes, agent, box, every=2 if len(scenario.agents) <= 4 else 4)
        _alerts(axes, suite, decision, index)
        axes.set_xlabel("east, m")
        axes.set_ylabel("north, m")
        sheet.legend(_plan_legend(kinds), columns=columns)
        return sheet.save(folder, f"{file_stem(scenario.name)}-plan")


def _bounds(suite: Suite, scenario: Scenario) -> tuple[float, float, float, float]:
    """The part of the world that is drawn: paths near the camera, and the camera."""
    camera = np.array([suite.pose.x_m, suite.pose.y_m])
    points = np.concatenate([a.path[:, 1:] for a in scenario.agents])
    near = np.clip(points, camera - RANGE_M - 2, camera + RANGE_M + 2)
    whole = np.concatenate([near, [camera]])
    low, high = whole.min(0) - _MARGIN_M, whole.max(0) + _MARGIN_M
    # A narrow scene keeps a readable shape.
    for axis, least in ((0, 18.0), (1, 12.0)):
        missing = max(least - (high[axis] - low[axis]), 0.0) / 2
        low[axis], high[axis] = low[axis] - missing, high[axis] + missing
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _crosswalk(axes: Axes) -> None:
    from matplotlib.patches import Rectangle

    (west, east), (south, north) = CROSSWALK_M
    for y in np.arange(south, north - 0.1, 1.0):
        axes.add_patch(
            Rectangle((west, float(y)), east - west, 0.5, facecolor="#e4e4e4", lw=0, zorder=0)
        )


def _camera(axes: Axes, suite: Suite) -> None:
    """The camera, the ground that it sees within its range, and range rings."""
    from matplotlib.patches import Circle, Wedge

    pose, camera = suite.pose, suite.camera
    at = (pose.x_m, pose.y_m)
    half = math.degrees(camera.lens.max_theta_rad)
    # The camera's own heading turns its ground frame (x forward, y right) clockwise.
    facing = pose.heading_deg - camera.heading_deg
    wedge = (0.0, 360.0) if half >= 180 else (facing - half, facing + half)
    axes.add_patch(Wedge(at, RANGE_M, *wedge, facecolor=SKY, alpha=0.10, lw=0, zorder=0))
    for radius in RINGS_M:
        axes.add_patch(
            Circle(at, radius, fill=False, edgecolor="#9db8c9", lw=0.7, ls=(0, (4, 4)), zorder=1)
        )
        for angle in (facing + 62, facing - 62):
            x = at[0] + radius * math.cos(math.radians(angle))
            y = at[1] + radius * math.sin(math.radians(angle))
            low_x, high_x = axes.get_xlim()
            low_y, high_y = axes.get_ylim()
            if low_x + 1 < x < high_x - 1 and low_y + 0.5 < y < high_y - 0.5:
                box = {"facecolor": "white", "edgecolor": "none", "pad": 0.4, "alpha": 0.8}
                style: dict[str, Any] = {"fontsize": 7, "color": "#4d6b7d", "bbox": box}
                label(axes, f"{radius} m", (x, y), ha="center", va="center", zorder=1.5, **style)
                break
    axes.plot(*at, marker=(3, 0, facing - 90), color=BLACK, markersize=12, zorder=6)


def _path(axes: Axes, agent: Agent, box: tuple[float, float, float, float], every: int) -> None:
    """A path with marks by the second, the time of every few of them, and the heading."""
    colour, marker, dash = _STYLES.get(agent.kind, _VEHICLE)
    _, x, y = agent.path.T
    axes.plot(x, y, color=colour, linestyle=dash, linewidth=1.4, zorder=2)
    seconds = np.arange(math.ceil(agent.start_s - 1e-9), math.floor(agent.end_s + 1e-9) + 1)
    xy, heading, _ = agent.sample(seconds.astype(np.float64))
    marks: dict[str, Any] = {"markersize": 4.5, "markerfacecolor": "white", "zorder": 3}
    axes.plot(xy[:, 0], xy[:, 1], marker, color=colour, linestyle="", **marks)
    last: FloatArray | None = None
    for t, point, angle in zip(seconds, xy, heading, strict=True):
        inside = box[0] < point[0] < box[1] and box[2] < point[1] < box[3]
        crowded = last is not None and np.hypot(*(point - last)) < 1.0
        if t % every or not inside or crowded:
            continue
        last = point
        side = (-math.sin(angle), math.cos(angle))
        style = {"ha": "center", "va": "center", "fontsize": 7, "color": colour, "zorder": 4}
        label(axes, f"{t:g}", (point[0], point[1]), (8 * side[0], 8 * side[1]), **style)
    _arrows(axes, agent, colour, box)


def _arrows(axes: Axes, agent: Agent, colour: str, box: tuple[float, float, float, float]) -> None:
    """Arrowheads at a fifth, the middle and the end of the visible part of a path."""
    times = np.linspace(agent.start_s, agent.end_s, 200)
    xy, heading, _ = agent.sample(np.asarray(times, np.float64))
    visible = (xy[:, 0] > box[0]) & (xy[:, 0] < box[1]) & (xy[:, 1] > box[2]) & (xy[:, 1] < box[3])
    index = np.nonzero(visible)[0]
    if not len(index) or np.hypot(*np.ptp(xy[index], axis=0)) < 0.5:
        return
    arrow = {"arrowstyle": "-|>", "color": colour, "linewidth": 0, "mutation_scale": 13}
    for share in (0.2, 0.55, 1.0):
        i = index[min(int(share * len(index)), len(index) - 1)]
        step = 0.45 * np.array([math.cos(heading[i]), math.sin(heading[i])])
        ends = tuple(xy[i] + step), tuple(xy[i] - step)
        axes.annotate("", *ends, arrowprops={**arrow, "shrinkA": 0, "shrinkB": 0}, zorder=3.5)


def _alerts(axes: Axes, suite: Suite, decision: DecisionConfig, index: int) -> None:
    """True positions of the frame's cyclist and pedestrian at each alert's onset."""
    scenario, truth = suite.scenarios[index], suite.truths[index]
    agents = {a.id: a for a in scenario.agents}
    state = suite.states(decision)[suite.rule_input.frame_slice(index)]
    for frame in np.nonzero(onsets(state == State.ALERT))[0]:
        pair = (int(truth.cyclist[frame]), int(truth.pedestrian[frame]))
        found = [agents[i].at(float(truth.time_s[frame])) for i in pair if i in agents]
        points = [place[0] for place in found if place is not None]
        if len(points) != 2:
            continue
        (cx, cy), (px, py) = points
        axes.plot([cx, px], [cy, py], color=RED, linewidth=1.0, linestyle=(0, (2, 2)), zorder=4)
        axes.plot(cx, cy, "*", color=RED, markersize=13, markeredgecolor="white", zorder=7)
        axes.plot(px, py, "X", color=RED, markersize=9, markeredgecolor="white", zorder=7)


def _plan_legend(kinds: list[str]) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = []
    for kind in kinds:
        colour, marker, dash = _STYLES.get(kind, _VEHICLE)
        style: dict[str, Any] = {"marker": marker, "linestyle": dash, "markerfacecolor": "white"}
        handles.append(Line2D([], [], color=colour, label=escape_dollars(kind), **style))
    alert = Line2D([], [], color=RED, marker="*", linestyle="", markersize=11, label="alert begins")
    camera = Line2D([], [], color=BLACK, marker="^", linestyle="", markersize=9, label="camera")
    return [*handles, alert, camera, Patch(facecolor=SKY, alpha=0.2, label="in view, 25 m")]
