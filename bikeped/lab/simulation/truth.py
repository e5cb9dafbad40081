"""Kinematic ground truth: in which frames there is danger, and whether a warning can help. Pure.

Definitions, section 5; paper, section 4.2. Positions come from the scenario's script, so ground
truth knows the future: each frame looks 5 s ahead along the scripted paths.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bikeped.lab.scenarios.scenario import Scenario
from bikeped.lab.simulation.camera_pose import CameraView
from bikeped.types import BoolArray, FloatArray, IntArray, Kind

#: Distracted pedestrian's perception-reaction time, s (paper, section 4.5).
PEDESTRIAN_PRT_S = 1.87
ATTENTIVE_PRT_S = 0.84
SAMPLE_S = 0.05
LOOK_AHEAD_S = 5.0
PAIR_RANGE_M = 25.0
CONTACT_M = 1.0
CLEARANCE_WAY_M = 2.0
CLEARANCE_STANDING_S = 30.0
STANDING_MPS = 0.1
CLOSING_MIN_MPS = 0.3
SEVERITY_SPEED_MPS = 12.0
CPA_SLACK_M = 0.05

#: Frames (1/30 s) and look-ahead samples (1/20 s) both lie on a grid of 1/60 s.
_GRID_HZ = 60
_FRAME_STRIDE = 2
_SAMPLE_STRIDE = 3
_SAMPLES = round(LOOK_AHEAD_S / SAMPLE_S)
_EPSILON = 1e-9

KIND_OF: dict[str, Kind] = {
    "pedestrian": Kind.PEDESTRIAN,
    "cyclist": Kind.CYCLIST,
    "motorcycle": Kind.CYCLIST,
    "car": Kind.VEHICLE,
    "bus": Kind.VEHICLE,
    "truck": Kind.VEHICLE,
}


@dataclass(frozen=True)
class BrakingProfile:
    """A cyclist's reaction time (s) and deceleration (m/s^2)."""

    reaction_s: float
    deceleration_mps2: float


BRAKING_PROFILES: dict[str, BrakingProfile] = {
    "bicycle": BrakingProfile(0.84, 1.96),
    "ebike": BrakingProfile(0.84, 6.0),
    "aashto": BrakingProfile(2.5, 3.4),
}


@dataclass(frozen=True)
class GroundTruthSettings:
    """The three free thresholds, and the braking profile (None: by the scenario's vehicle).

    `ttc_bound_s` None is the definition's 1.87 s + the pedestrian's clearance time.
    """

    cpa_radius_m: float = 5.0
    stopping_margin: float = 0.8
    ttc_bound_s: float | None = None
    braking: str | None = None


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of one scenario, arrays over its frames [f].

    `ttc_s` and `budget_s` may be infinite. `cyclist` and `pedestrian` are ids of the frame's pair,
    -1 where there is none within range. `distance_m` is that pair's distance; `nearest_m` the
    smallest distance of any pair, at any range.
    """

    time_s: FloatArray
    danger: BoolArray
    actionable: BoolArray
    severity: FloatArray
    ttc_s: FloatArray
    d_min_m: FloatArray
    budget_s: FloatArray
    distance_m: FloatArray
    cyclist: IntArray
    pedestrian: IntArray
    nearest_m: FloatArray

    @property
    def imminent(self) -> BoolArray:
        """Danger in which a warning comes too late to act upon."""
        return np.asarray(self.danger & ~self.actionable)


def compute_ground_truth(
    scenario: Scenario,
    settings: GroundTruthSettings = GroundTruthSettings(),
    view: CameraView | None = None,
) -> GroundTruth:
    """The ground truth of every frame of a scenario; with a `view`, of those who are in it."""
    time_s = scenario.frame_times()
    frames = len(time_s)
    grid_s = np.arange(_FRAME_STRIDE * (frames - 1) + _SAMPLE_STRIDE * _SAMPLES + 1) / _GRID_HZ
    cyclists = [a for a in scenario.agents if KIND_OF[a.kind] is Kind.CYCLIST]
    pedestrians = [a for a in scenario.agents if KIND_OF[a.kind] is Kind.PEDESTRIAN]
    paths = {a.id: a.sample(grid_s)[0] for a in (*cyclists, *pedestrians)}
    if view is not None:
        paths = {i: np.where(view.sees(xy)[:, None], xy, np.nan) for i, xy in paths.items()}
    there = {i: ~np.isnan(xy[:, 0]) for i, xy in paths.items()}
    best = _PairTruth.none(frames)
    nearest = np.full(frames, np.inf)
    braking = BRAKING_PROFILES[settings.braking or scenario.vehicle]
    for cyclist, pedestrian in itertools.product(cyclists, pedestrians):
        ids = cyclist.id, pedestrian.id
        if not (there[cyclist.id] & there[pedestrian.id]).any():
            continue
        apart = paths[cyclist.id] - paths[pedestrian.id]
        distance = np.sqrt((apart**2).sum(-1))  # NaN where either does not exist
        now = distance[: _FRAME_STRIDE * frames : _FRAME_STRIDE]
        nearest = np.fmin(nearest, now)
        at = np.flatnonzero(now <= PAIR_RANGE_M)
        best.replace_where_worse(_pair(*ids, paths, distance, at, settings, braking), at)
    return GroundTruth(
        time_s=time_s,
        danger=best.danger,
        actionable=best.danger & (best.ttc >= PEDESTRIAN_PRT_S - _EPSILON),
        severity=np.where(best.danger, best.severity, 0.0),
        ttc_s=best.ttc,
        d_min_m=best.d_min,
        budget_s=best.budget,
        distance_m=best.distance,
        cyclist=best.cyclist,
        pedestrian=best.pedestrian,
        nearest_m=nearest,
    )


@dataclass(frozen=True)
class _PairTruth:
    """One pair in the frames [n] in which both exist within range."""

    danger: BoolArray
    severity: FloatArray
    ttc: FloatArray
    d_min: FloatArray
    budget: FloatArray
    distance: FloatArray
    cyclist: IntArray
    pedestrian: IntArray

    @staticmethod
    def none(frames: int) -> _PairTruth:
        """No pair in any frame."""
        false, infinite = np.zeros(frames, np.bool_), np.full(frames, np.inf)
        no_id = np.full(frames, -1, np.int64)
        arrays: list[Any] = [false, np.zeros(frames), *[infinite] * 4, no_id, no_id]
        return _PairTruth(*(array.copy() for array in arrays))

    def replace_where_worse(self, pair: _PairTruth, frames: IntArray) -> None:
        """Takes `pair`, of these frames, where it is in danger with a higher severity, or, without
        danger so far, has a smaller d_min. Of equal pairs the first offered stays."""
        best = {name: values[frames] for name, values in vars(self).items()}
        # Two cyclists of one speed tie, whatever the last bit of their differences is.
        severer = pair.severity > best["severity"] + _EPSILON
        worse_danger = pair.danger & (~best["danger"] | severer)
        none_yet = best["cyclist"] < 0
        smaller = pair.d_min < best["d_min"] - _EPSILON
        nearer = ~pair.danger & ~best["danger"] & (none_yet | smaller)
        at = worse_danger | nearer
        for name, values in vars(self).items():
            values[frames[at]] = getattr(pair, name)[at]


def _pair(
    cyclist: int,
    pedestrian: int,
    paths: Mapping[int, FloatArray],
    distance: FloatArray,
    frames: IntArray,
    settings: GroundTruthSettings,
    braking: BrakingProfile,
) -> _PairTruth:
    """The pair in these frames [n], in which both exist; `distance` on the fine grid."""
    frame = _FRAME_STRIDE * frames
    ahead_of = np.where(np.isnan(distance), np.inf, distance)
    # After an agent's end, or out of the view, the distance is infinite.
    ahead = ahead_of[frame[:, None] + _SAMPLE_STRIDE * np.arange(_SAMPLES)]
    now = distance[frame]
    closing = np.nan_to_num((now - distance[frame + _SAMPLE_STRIDE]) / SAMPLE_S, nan=0.0)
    d_min = ahead.min(axis=1)
    contact = ahead < CONTACT_M
    ttc = np.where(contact.any(axis=1), contact.argmax(axis=1) * SAMPLE_S, np.inf)
    near_cpa = ahead <= d_min[:, None] + CPA_SLACK_M
    cyclist_speed = _speed(paths[cyclist], frame)
    pedestrian_speed = _speed(paths[pedestrian], frame)
    stopping = cyclist_speed * braking.reaction_s + cyclist_speed**2 / (
        2 * braking.deceleration_mps2
    )
    free = np.maximum(now - CONTACT_M, 0.0)
    if settings.ttc_bound_s is None:
        clearance = np.where(
            pedestrian_speed < STANDING_MPS,
            CLEARANCE_STANDING_S,
            CLEARANCE_WAY_M / np.maximum(pedestrian_speed, STANDING_MPS),
        )
        bound: FloatArray = PEDESTRIAN_PRT_S + clearance
    else:
        bound = np.full(len(frames), settings.ttc_bound_s)
    danger = (
        (closing > CLOSING_MIN_MPS)
        & (d_min < settings.cpa_radius_m)
        & ((stopping > settings.stopping_margin * free) | (ttc < bound))
    )
    return _PairTruth(
        danger=danger,
        # Kinetic energy relative to that at 12 m/s, at most 1.
        severity=np.minimum((cyclist_speed / SEVERITY_SPEED_MPS) ** 2, 1.0),
        ttc=ttc,
        d_min=d_min,
        budget=near_cpa.argmax(axis=1) * SAMPLE_S,
        distance=now,
        cyclist=np.full(len(frames), cyclist, np.int64),
        pedestrian=np.full(len(frames), pedestrian, np.int64),
    )


def _speed(xy: FloatArray, frame: IntArray) -> FloatArray:
    """Forward difference over 0.05 s; 0 where either end does not exist."""
    step = xy[frame + _SAMPLE_STRIDE] - xy[frame]
    return np.asarray(np.nan_to_num(np.sqrt((step**2).sum(-1)) / SAMPLE_S, nan=0.0))
