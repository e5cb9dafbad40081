"""Scenes of traffic before their cameras: truth, conflicts, perception, tracks and states, cached.

The same functions as for scenarios (`lab.simulation`); only who is in the camera's view counts.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from bikeped.config.build import ground_camera, rule_settings, tracker_settings
from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.decision.rules import RuleSettings, is_remembered, resolve_state
from bikeped.decision.shown import shown_alert
from bikeped.encounters import CONFLICT_S, measure_encounters, pair_samples
from bikeped.geometry.camera import GroundCamera
from bikeped.lab.scenarios.scenario import Scenario
from bikeped.lab.simulation.camera_pose import CameraView
from bikeped.lab.simulation.light_record import NO_CONFLICTS, Conflicts, LightRecord
from bikeped.lab.simulation.perception import (
    PerceptionResult,
    RecallModel,
    missed_detections,
    simulate_perception,
    trial_generator,
)
from bikeped.lab.simulation.simulate import (
    FPS,
    DetectionSequence,
    RuleInput,
    build_rule_input,
    states,
    track,
)
from bikeped.lab.simulation.truth import KIND_OF, GroundTruth, compute_ground_truth
from bikeped.lab.traffic.readers import TrafficScene
from bikeped.tracking.batch_tracker import TrackerSettings
from bikeped.types import BoolArray, FloatArray, IntArray, Kind, State

Noise = Literal["none", "realistic", "bursts"]
#: Who is farther from the camera, or beside and behind it, does not count, metres.
VIEW_M = 25.0
#: The detector finds people this far, so that tracks are there when they begin to count, metres.
SEEN_M = 30.0
#: Mean length of a burst of missed detections, frames.
BURST_FRAMES = 5.0


@dataclass(frozen=True)
class TrafficSuite:
    """Scenes, the camera that every pole carries, its tracker, and how the detector errs."""

    scenes: tuple[TrafficScene, ...]
    camera: GroundCamera
    tracker: TrackerSettings
    noise: Noise = "realistic"
    seed: int = 0

    @staticmethod
    def load(
        scenes: Sequence[TrafficScene], loaded: LoadedConfig, noise: Noise, seed: int
    ) -> TrafficSuite:
        """The scenes before the configured camera, with the configuration's tracker."""
        tracker = tracker_settings(loaded.config.tracking, loaded.config.decision.nominal_fps)
        return TrafficSuite(tuple(scenes), ground_camera(loaded), tracker, noise, seed)

    def with_noise(self, noise: Noise, seed: int) -> TrafficSuite:
        """The same scenes under other noise; what does not depend on it is kept."""
        other = replace(self, noise=noise, seed=seed)
        for name in ("truths", "conflicts", "present", "perception_results"):
            if name in self.__dict__:
                other.__dict__[name] = self.__dict__[name]
        return other

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(s.scenario.name for s in self.scenes)

    @cached_property
    def truths(self) -> tuple[GroundTruth, ...]:
        return tuple(
            compute_ground_truth(s.scenario, view=CameraView(s.pose, VIEW_M)) for s in self.scenes
        )

    @cached_property
    def present(self) -> tuple[tuple[BoolArray, BoolArray], ...]:
        """By scene: frames [f] with a cyclist in view, and with a pedestrian."""
        return tuple((_any_of(s, Kind.CYCLIST), _any_of(s, Kind.PEDESTRIAN)) for s in self.scenes)

    @cached_property
    def conflicts(self) -> tuple[Conflicts, ...]:
        return tuple(_real_conflicts(s) for s in self.scenes)

    @cached_property
    def perception_results(self) -> tuple[PerceptionResult, ...]:
        return tuple(
            simulate_perception(s.scenario, self.camera, s.pose, SEEN_M) for s in self.scenes
        )

    @cached_property
    def rule_input(self) -> RuleInput:
        """Track rows of all scenes, of the detections with this suite's noise."""
        found = zip(self.names, self.perception_results, strict=True)
        return build_rule_input(track([self._detections(*item) for item in found], self.tracker))

    def _detections(self, name: str, seen: PerceptionResult) -> DetectionSequence:
        if self.noise == "none":
            return DetectionSequence(seen.true_m, seen.present, seen.kind)
        missed = missed_detections(
            trial_generator(self.seed, name, 0).random(seen.present.shape),
            seen.recall(RecallModel("size")),
            seen.present,
            BURST_FRAMES if self.noise == "bursts" else None,
        )
        return DetectionSequence(seen.observed_m, seen.present & ~missed, seen.kind)

    def lights(self, decision: DecisionConfig) -> list[LightRecord]:
        """What the light does in every scene under a decision."""
        settings = rule_settings(decision)
        return self._records(states(self.rule_input, settings), settings)

    def foresight(self, decision: DecisionConfig) -> list[LightRecord]:
        """The light that knows danger itself, with the decision's window, hold and memory."""
        settings = rule_settings(decision)
        raw = []
        for truth, (cyclist, pedestrian) in zip(self.truths, self.present, strict=True):
            last_s = np.maximum.accumulate(np.where(cyclist, truth.time_s, -np.inf))
            memory = is_remembered(truth.time_s, last_s, settings.memory_s)
            raw.append(resolve_state(pedestrian, memory, truth.danger))
        return self._records(np.concatenate(raw), settings)

    def _records(
        self, raw: np.ndarray[tuple[int, ...], np.dtype[np.int8]], settings: RuleSettings
    ) -> list[LightRecord]:
        parts = np.split(raw, np.cumsum([len(t.time_s) for t in self.truths])[:-1])
        scenes = zip(parts, self.truths, self.present, self.conflicts, strict=True)
        return [
            LightRecord(
                truth,
                cyclist & pedestrian,
                conflicts,
                own,
                shown_alert(truth.time_s, own == int(State.ALERT), settings.shown),
            )
            for own, truth, (cyclist, pedestrian), conflicts in scenes
        ]


def positions_in_view(scene: TrafficScene, time_s: FloatArray) -> FloatArray:
    """World positions [f, a, 2] of all road users; NaN where one is absent or out of view."""
    xy = np.stack([a.sample(time_s)[0] for a in scene.scenario.agents], 1)
    return np.where(CameraView(scene.pose, VIEW_M).sees(xy)[..., None], xy, np.nan)


def _any_of(scene: TrafficScene, kind: Kind) -> BoolArray:
    time_s = scene.scenario.frame_times(FPS)
    xy = positions_in_view(scene, time_s)[:, _of_kind(scene.scenario, kind)]
    return np.asarray((~np.isnan(xy[..., 0])).any(axis=1))


def _of_kind(scenario: Scenario, kind: Kind) -> list[int]:
    return [i for i, a in enumerate(scenario.agents) if KIND_OF[a.kind] is kind]


def _real_conflicts(scene: TrafficScene) -> Conflicts:
    """Real conflicts of a scene, and how long each pair had been in view."""
    time_s = scene.scenario.frame_times(FPS)
    xy = positions_in_view(scene, time_s)
    pairs: IntArray = np.asarray(
        list(
            itertools.product(
                *(_of_kind(scene.scenario, k) for k in (Kind.CYCLIST, Kind.PEDESTRIAN))
            )
        ),
        np.int64,
    ).reshape(-1, 2)
    if not len(pairs):
        return NO_CONFLICTS
    # Velocities of the whole path: at the edge of the view they are known, too.
    whole = np.stack([a.sample(time_s)[0] for a in scene.scenario.agents], 1)
    velocity = np.gradient(whole, 1 / FPS, axis=0)
    found = measure_encounters(pair_samples(time_s, xy, velocity, pairs, CONFLICT_S), CONFLICT_S)
    there = ~np.isnan(xy[..., 0])
    which = np.flatnonzero(~np.isnan(found.conflict_s))
    at_s = found.conflict_s[which]
    in_view_s = np.zeros(len(which))
    for i, (pair, t) in enumerate(zip(pairs[which], at_s, strict=True)):
        frame = round(float(t) * FPS)
        together = there[: frame + 1, pair].all(axis=1)
        absent = np.flatnonzero(~together)
        in_view_s[i] = (frame - (absent[-1] if len(absent) else -1)) / FPS
    ids = np.asarray([a.id for a in scene.scenario.agents])
    order = np.argsort(at_s, kind="stable")
    return Conflicts(at_s[order], in_view_s[order], ids[pairs[which]][order])
