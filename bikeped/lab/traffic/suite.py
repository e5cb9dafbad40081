"""Scenes of traffic before their cameras: truth, conflicts, perception, tracks and states, cached.

The same functions as for scenarios (`lab.simulation`); only who is in the camera's view counts.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from bikeped.config.build import ground_camera
from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.decision.rules import is_remembered, resolve_state
from bikeped.decision.shown import ShownSettings, shown_alert
from bikeped.encounters import CONFLICT_S, measure_encounters, pair_samples
from bikeped.geometry.camera import GroundCamera
from bikeped.lab.scenarios.scenario import Scenario
from bikeped.lab.simulation.camera_pose import CameraView
from bikeped.lab.simulation.light_record import Conflicts, LightRecord
from bikeped.lab.simulation.perception import (
    SIMULATION_POSE,
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
    SimulatedTracker,
    TrackerName,
    build_rule_input,
    outcome,
    track,
)
from bikeped.lab.simulation.truth import KIND_OF, GroundTruth, compute_ground_truth
from bikeped.lab.traffic.readers import TrafficScene
from bikeped.types import BoolArray, FloatArray, Kind, State

#: `located`: localisation error, and no detection missed.
Noise = Literal["none", "located", "realistic", "bursts"]
#: Who is farther from the camera, or beside and behind it, does not count, metres.
VIEW_M = 25.0
#: The detector finds people this far, so that tracks are there when they begin to count, metres.
SEEN_M = 30.0
#: Mean length of a burst of missed detections, frames.
BURST_FRAMES = 5.0


@dataclass(frozen=True)
class TrafficSuite:
    """Scenes, the camera that every pole carries, its tracker, and how the detector errs.

    `view_m` and `seen_m`: how far people count, and are found; None: everywhere. Detections reach
    the tracker `delay_frames` late.
    """

    scenes: tuple[TrafficScene, ...]
    camera: GroundCamera
    tracker: SimulatedTracker
    noise: Noise = "realistic"
    seed: int = 0
    view_m: float | None = VIEW_M
    seen_m: float | None = SEEN_M
    delay_frames: int = 0

    @staticmethod
    def load(
        scenes: Sequence[TrafficScene],
        loaded: LoadedConfig,
        noise: Noise,
        seed: int,
        tracker: TrackerName = "deployed",
    ) -> TrafficSuite:
        """The scenes before the configured camera, with the configuration's tracker."""
        use = SimulatedTracker.of(loaded, tracker)
        return TrafficSuite(tuple(scenes), ground_camera(loaded), use, noise, seed)

    @staticmethod
    def of_scenarios(
        scenarios: Iterable[Scenario],
        loaded: LoadedConfig,
        noise: Noise,
        seed: int,
        tracker: TrackerName = "deployed",
    ) -> TrafficSuite:
        """Scripted or random scenarios as the conformance simulation has them, seen everywhere."""
        scenes = [TrafficScene(scenario, SIMULATION_POSE) for scenario in scenarios]
        suite = TrafficSuite.load(scenes, loaded, noise, seed, tracker)
        return replace(suite, view_m=None, seen_m=None)

    def with_noise(self, noise: Noise, seed: int, delay_frames: int = 0) -> TrafficSuite:
        """The same scenes under other noise; what does not depend on it is kept."""
        other = replace(self, noise=noise, seed=seed, delay_frames=delay_frames)
        for name in ("truths", "_in_view", "present", "conflicts", "perception_results"):
            if name in self.__dict__:
                other.__dict__[name] = self.__dict__[name]
        return other

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(s.scenario.name for s in self.scenes)

    @cached_property
    def truths(self) -> tuple[GroundTruth, ...]:
        return tuple(compute_ground_truth(s.scenario, view=self._view(s)) for s in self.scenes)

    def _view(self, scene: TrafficScene) -> CameraView | None:
        return None if self.view_m is None else CameraView(scene.pose, self.view_m)

    @cached_property
    def _in_view(self) -> tuple[FloatArray, ...]:
        """By scene: world positions [f, a, 2]; NaN where one is absent or out of view."""
        found = []
        for scene in self.scenes:
            xy, view = _positions(scene.scenario), self._view(scene)
            found.append(xy if view is None else np.where(view.sees(xy)[..., None], xy, np.nan))
        return tuple(found)

    @cached_property
    def present(self) -> tuple[tuple[BoolArray, BoolArray], ...]:
        """By scene: frames [f] with a cyclist in view, and with a pedestrian."""
        found = []
        for scene, xy in zip(self.scenes, self._in_view, strict=True):
            there = ~np.isnan(xy[..., 0])
            kinds = (_of_kind(scene.scenario, k) for k in (Kind.CYCLIST, Kind.PEDESTRIAN))
            cyclist, pedestrian = (np.asarray(there[:, who].any(axis=1)) for who in kinds)
            found.append((cyclist, pedestrian))
        return tuple(found)

    @cached_property
    def conflicts(self) -> tuple[Conflicts, ...]:
        scenes = zip(self.scenes, self._in_view, strict=True)
        return tuple(_real_conflicts(scene.scenario, xy) for scene, xy in scenes)

    @cached_property
    def perception_results(self) -> tuple[PerceptionResult, ...]:
        return tuple(
            simulate_perception(s.scenario, self.camera, s.pose, self.seen_m) for s in self.scenes
        )

    @cached_property
    def detections(self) -> tuple[DetectionSequence, ...]:
        """What the tracker gets, scene by scene."""
        found = zip(self.names, self.perception_results, strict=True)
        return tuple(self._detections(*item) for item in found)

    def _detections(self, name: str, seen: PerceptionResult) -> DetectionSequence:
        place = seen.true_m if self.noise == "none" else seen.observed_m
        found = seen.present
        if self.noise in {"realistic", "bursts"}:
            found = found & ~missed_detections(
                trial_generator(self.seed, name, 0).random(found.shape),
                seen.recall(RecallModel("size")),
                found,
                BURST_FRAMES if self.noise == "bursts" else None,
            )
        return DetectionSequence(place, found, seen.kind, self.delay_frames)

    @cached_property
    def rule_input(self) -> RuleInput:
        """Track rows of all scenes, of the detections with this suite's noise."""
        return build_rule_input(track(self.detections, self.tracker))

    def lights(self, decision: DecisionConfig) -> list[LightRecord]:
        """What the light does in every scene under a decision."""
        settings = self.tracker.rule(decision)
        return self.records(outcome(self.rule_input, settings).raw, settings.shown)

    def foresight(self, decision: DecisionConfig) -> list[LightRecord]:
        """The light that knows danger itself, with the decision's window, hold and memory."""
        settings = self.tracker.rule(decision)
        raw = []
        for truth, (cyclist, pedestrian) in zip(self.truths, self.present, strict=True):
            last_s = np.maximum.accumulate(np.where(cyclist, truth.time_s, -np.inf))
            memory = is_remembered(truth.time_s, last_s, settings.memory_s)
            raw.append(resolve_state(pedestrian, memory, truth.danger))
        return self.records(np.concatenate(raw), settings.shown)

    def records(self, raw: npt.NDArray[np.int8], shown: ShownSettings) -> list[LightRecord]:
        """The light of every scene from the raw state codes of all frames, scene after scene."""
        parts = np.split(raw, np.cumsum([len(t.time_s) for t in self.truths])[:-1])
        scenes = zip(parts, self.truths, self.present, self.conflicts, strict=True)
        return [
            LightRecord(
                truth,
                cyclist & pedestrian,
                conflicts,
                own,
                shown_alert(truth.time_s, own == int(State.ALERT), shown),
            )
            for own, truth, (cyclist, pedestrian), conflicts in scenes
        ]


def _positions(scenario: Scenario) -> FloatArray:
    """World positions [f, a, 2] of all road users; NaN where one is absent."""
    time_s = scenario.frame_times(FPS)
    return np.stack([agent.sample(time_s)[0] for agent in scenario.agents], 1)


def _of_kind(scenario: Scenario, kind: Kind) -> list[int]:
    return [i for i, a in enumerate(scenario.agents) if KIND_OF[a.kind] is kind]


def _real_conflicts(scenario: Scenario, xy: FloatArray) -> Conflicts:
    """Real conflicts of those in view at `xy` [f, a, 2], and how long each pair had been there."""
    cyclists, pedestrians = (_of_kind(scenario, k) for k in (Kind.CYCLIST, Kind.PEDESTRIAN))
    pairs = np.asarray([[c, p] for c in cyclists for p in pedestrians], np.int64).reshape(-1, 2)
    time_s = scenario.frame_times(FPS)
    # Velocities of the whole paths: where somebody enters the view they are known, too.
    velocity = np.gradient(_positions(scenario), 1 / FPS, axis=0)
    found = measure_encounters(pair_samples(time_s, xy, velocity, pairs, CONFLICT_S), CONFLICT_S)
    which = np.flatnonzero(~np.isnan(found.conflict_s))
    which = which[np.argsort(found.conflict_s[which], kind="stable")]
    there = ~np.isnan(xy[..., 0])
    at_s, in_view_s = found.conflict_s[which], np.zeros(len(which))
    for i, (pair, frame) in enumerate(zip(pairs[which], np.rint(at_s * FPS), strict=True)):
        absent = np.flatnonzero(~there[: int(frame) + 1, pair].all(axis=1))
        in_view_s[i] = (frame - absent[-1] if len(absent) else frame + 1) / FPS
    ids = np.asarray([agent.id for agent in scenario.agents])
    return Conflicts(at_s, in_view_s, ids[pairs[which]])
