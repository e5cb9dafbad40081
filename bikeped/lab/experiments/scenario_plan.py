"""A plan of one scenario from above: paths over time, the camera's view, alerts."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bikeped.config import DecisionConfig
from bikeped.decision.episodes import onsets
from bikeped.lab.plotting import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    PURPLE,
    RED,
    SKY,
    FigureSheet,
    escape_dollars,
    file_stem,
    label,
)
from bikeped.lab.scenarios.scenario import Agent, Scenario
from bikeped.lab.simulation.suite import Suite
from bikeped.types import FloatArray, State

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
        sheet.legend(_legend(kinds), columns=columns)
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


def _legend(kinds: list[str]) -> list[Any]:
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
