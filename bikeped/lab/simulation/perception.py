"""Simulated perception of the true positions by the camera (definitions, sections 3 and 7).

Localisation error: the bottom centre of the tightest upright rectangle around an object's visible
box corners is not its ground point. Projected area: the input of recall by size. Missed detections:
independent, or in bursts by Gilbert's two-state channel.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bikeped.errors import BikepedError
from bikeped.geometry.camera import GroundCamera
from bikeped.lab.scenarios.scenario import SIZES_M, Scenario
from bikeped.lab.simulation.camera_pose import CameraPose, CameraView
from bikeped.lab.simulation.truth import KIND_OF
from bikeped.types import BoolArray, FloatArray, Kind, KindArray

#: Where the paper's simulation camera stands: world (5, -13), looking north.
SIMULATION_POSE = CameraPose(5.0, -13.0, 90.0)
#: Square pixels of the crop to square pixels at the network's input.
AREA_SCALE = (1280 / 3840) ** 2

OVERALL_RECALL: dict[Kind, float] = {
    Kind.PEDESTRIAN: 0.755,
    Kind.CYCLIST: 0.747,
    Kind.VEHICLE: 0.765,
}
SIZE_BOUNDS_PX2 = (32.0**2, 96.0**2)
SIZE_RECALL = (0.514, 0.725, 0.832)

RecallMode = Literal["flat", "size", "curve"]
#: Bin centres (px^2 at the network's input, increasing) and the recall of each bin.
RecallCurve = tuple[tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class RecallModel:
    """Recall of an object: by kind, by size class, or by a curve over projected area."""

    mode: RecallMode = "size"
    curve: RecallCurve | None = None

    def recall(self, kind: KindArray, area_px2: FloatArray) -> FloatArray:
        """Recall of objects, elementwise."""
        if self.mode == "flat":
            table = np.asarray([OVERALL_RECALL[k] for k in Kind])
            return np.asarray(table[np.maximum(kind, 0)] + 0.0 * area_px2)
        if self.mode == "curve":
            if self.curve is None:
                raise ValueError("recall curve: none is given")
            return np.asarray(np.interp(area_px2, *self.curve))
        return np.asarray(SIZE_RECALL)[np.searchsorted(SIZE_BOUNDS_PX2, area_px2, side="right")]


def recall_models(curve: RecallCurve | None) -> list[RecallModel]:
    """The recall models, from the coarsest to the finest; the last by `curve`, when given."""
    models = [RecallModel("flat"), RecallModel("size")]
    return models if curve is None else [*models, RecallModel("curve", curve)]


@dataclass(frozen=True)
class PerceptionResult:
    """One scenario through one camera: arrays over frames and agents [f, a].

    Positions are in the camera ground frame; NaN where `present` is false. `observed_m` carries the
    localisation error; `kind` [a].
    """

    true_m: FloatArray
    observed_m: FloatArray
    area_px2: FloatArray
    present: BoolArray
    kind: KindArray

    @property
    def error_m(self) -> FloatArray:
        """Localisation error [f, a]."""
        return np.asarray(np.sqrt(((self.observed_m - self.true_m) ** 2).sum(-1)))

    def recall(self, model: RecallModel) -> FloatArray:
        """Recall [f, a] of every object by the model."""
        return model.recall(np.broadcast_to(self.kind, self.area_px2.shape), self.area_px2)


def simulate_perception(
    scenario: Scenario,
    camera: GroundCamera,
    pose: CameraPose = SIMULATION_POSE,
    reach_m: float | None = None,
) -> PerceptionResult:
    """Every agent of every frame as the camera localises it, in its ground frame at `pose`.

    With `reach_m` only those who are ahead of the camera and no farther are seen.
    """
    time_s = scenario.frame_times()
    frames, agents = len(time_s), len(scenario.agents)
    true = np.full((frames, agents, 2), np.nan)
    observed = np.full((frames, agents, 2), np.nan)
    area = np.zeros((frames, agents))
    present = np.zeros((frames, agents), np.bool_)
    for index, agent in enumerate(scenario.agents):
        xy, heading, there = agent.sample(time_s)
        there &= agent.in_sight(time_s)
        if reach_m is not None:
            there &= CameraView(pose, reach_m).sees(xy)
        ground = np.where(there[:, None], pose.world_to_ground(xy), np.nan)
        direction = pose.turn_to_ground(np.stack([np.cos(heading), np.sin(heading)], -1))
        true[:, index] = ground
        present[:, index] = there
        put, size = localise(camera, ground[there], direction[there], agent.size_m)
        observed[there, index] = put
        area[there, index] = size
    kind = np.asarray([KIND_OF[a.kind] for a in scenario.agents], np.int8)
    return PerceptionResult(true, observed, area, present, kind)


def localise(
    camera: GroundCamera,
    xy_m: FloatArray,
    direction: FloatArray,
    size_m: tuple[float, float, float],
) -> tuple[FloatArray, FloatArray]:
    """Where the camera puts boxes of `size_m` (length, width, height) at `xy_m` [n, 2], and their
    projected area [n] at the network's input.

    `direction` [n, 2] is the unit vector of the length, in the camera ground frame. Without a
    visible corner, or with the bottom centre above the horizon, the true position is returned.
    """
    length, width, height = size_m
    across = np.stack([-direction[:, 1], direction[:, 0]], -1)
    corners = np.empty((len(xy_m), 8, 3))
    signs = itertools.product((-0.5, 0.5), (-0.5, 0.5), (0.0, height))
    for index, (along_sign, across_sign, top) in enumerate(signs):
        corners[:, index, :2] = (
            xy_m + along_sign * length * direction + across_sign * width * across
        )
        corners[:, index, 2] = top
    uv, seen = camera.project(corners)
    some: BoolArray = np.asarray(seen.any(axis=1))
    # Where no corner is seen, a rectangle at the origin stands in; it is not used.
    low = np.where(seen[..., None], uv, np.inf).min(axis=1, initial=np.inf)
    high = np.where(seen[..., None], uv, -np.inf).max(axis=1, initial=-np.inf)
    low, high = (np.where(some[:, None], edge, 0.0) for edge in (low, high))
    bottom = np.stack([(low[:, 0] + high[:, 0]) / 2, high[:, 1]], -1)
    ground, valid = camera.ground(bottom)
    usable = some & valid
    extent = high - low
    return np.where(usable[:, None], ground, xy_m), extent[:, 0] * extent[:, 1] * AREA_SCALE


def error_table(
    camera: GroundCamera,
    kinds: tuple[str, ...] = ("pedestrian", "cyclist", "car"),
    distances_m: tuple[float, ...] = (3, 5, 8, 10, 15, 20, 25),
    bearings_deg: tuple[float, ...] = (0, 30, 60, 80),
) -> list[dict[str, float | str]]:
    """The localisation errors of the paper's table and text (section 3.7).

    The length of every object lies along the camera's right axis: across the line of sight
    straight ahead. Kept so at other bearings, it gives the paper's 0.35, 0.89 and 2.5 m at 80
    degrees and 10 m.
    """
    rows: list[dict[str, float | str]] = []
    for kind, bearing, distance in itertools.product(kinds, bearings_deg, distances_m):
        angle = np.radians(bearing)
        xy = np.array([[np.cos(angle), np.sin(angle)]]) * distance
        put, _ = localise(camera, xy, np.array([[0.0, 1.0]]), SIZES_M[kind])
        error_m = float(np.hypot(*(put - xy)[0]))
        rows.append(
            {"kind": kind, "distance_m": distance, "bearing_deg": bearing, "error_m": error_m}
        )
    return rows


def trial_generator(seed: int, name: str, trial: int) -> np.random.Generator:
    """Random numbers of one trial of one scenario, independent of order and process."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), trial])


def missed_detections(
    draw: FloatArray, recall: FloatArray, present: BoolArray, burst: float | None = None
) -> BoolArray:
    """Which detections are missed; frames along the first axis, any number of trials and agents
    along the others (`recall` and `present` broadcast against `draw`, uniform in 0..1).

    Independent with probability 1 - recall each; with `burst` (mean length B in frames) as
    Gilbert's two states per agent: recovery 1/B, onset (1 - recall)/(B recall), started in the
    stationary state. The onset cannot exceed 1: below a recall of 1/(1 + B) losses are rarer.
    """
    if burst is None:
        return np.asarray((draw >= recall) & present)
    missed: BoolArray = np.zeros(draw.shape, np.bool_)
    bad: BoolArray = np.zeros(draw.shape[1:], np.bool_)
    started: BoolArray = np.zeros(draw.shape[1:], np.bool_)
    onset = np.minimum((1 - recall) / (burst * np.maximum(recall, 1e-9)), 1.0)
    for frame in range(len(draw)):
        here = present[frame]
        moved = np.where(bad, draw[frame] >= 1 / burst, draw[frame] < onset[frame])
        bad = np.asarray(np.where(started, moved, draw[frame] >= recall[frame])) & here
        started |= here
        missed[frame] = bad
    return missed


def load_recall_curve(path: Path) -> RecallCurve:
    """Bin centres (square pixels at the network's input) and the recall of each bin.

    CSV with the two columns (a header is allowed), or JSON: a list of [centre, recall], or
    `{"area_px2": [...], "recall": [...]}`. BikepedError names the file and the remedy.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BikepedError(f"{path}: cannot be read; check --recall-curve") from error
    try:
        pairs = _json_pairs(text) if path.suffix == ".json" else _csv_pairs(text)
        values = np.asarray(pairs, np.float64).reshape(-1, 2)
    except (ValueError, TypeError, KeyError, RecursionError, csv.Error) as error:
        raise BikepedError(
            f"{path}: is not a recall curve; write lines of bin centre, recall"
        ) from error
    centre, recall = values[:, 0], values[:, 1]
    if len(values) < 2 or not np.isfinite(values).all() or not (np.diff(centre) > 0).all():
        raise BikepedError(f"{path}: bin centre: needs two or more finite centres that increase")
    if centre[0] < 0 or recall.min() < 0 or recall.max() > 1:
        raise BikepedError(f"{path}: recall: expected 0 to 1 at centres from 0; correct the values")
    return tuple(centre.tolist()), tuple(recall.tolist())


def _json_pairs(text: str) -> list[Any]:
    data = json.loads(text)
    if isinstance(data, dict):
        return list(zip(data["area_px2"], data["recall"], strict=True))
    return list(data)


def _csv_pairs(text: str) -> list[list[float]]:
    lines = [line for line in csv.reader(io.StringIO(text)) if line]
    if lines:
        try:
            float(lines[0][0])
        except ValueError:
            lines = lines[1:]  # a header
    return [[float(a), float(b)] for a, b in lines]
