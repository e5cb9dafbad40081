"""A suite of scenarios seen by one camera: ground truth, perception and decisions, cached."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped import __version__
from bikeped.config.build import ground_camera
from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.geometry.camera import GroundCamera
from bikeped.lab.scenarios.scenario import Scenario, dump_scenario
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.lab.simulation.metrics import GroundTruthFrames, Metrics, measure
from bikeped.lab.simulation.perception import SIMULATION_POSE, PerceptionResult, simulate_perception
from bikeped.lab.simulation.simulate import (
    DetectionSequence,
    Outcome,
    RuleInput,
    SimulatedTracker,
    TrackerName,
    TrackHistory,
    build_rule_input,
    outcome,
    track,
)
from bikeped.lab.simulation.truth import GroundTruth, GroundTruthSettings, compute_ground_truth

DEFAULT_GROUND_TRUTH = GroundTruthSettings()


def _closing(
    memory: int, d_min_m: float, d_max_m: float, displacement_m: float, k: int, *, adaptive: bool
) -> DecisionConfig:
    return DecisionConfig(
        memory_frames=memory,
        d_min_m=d_min_m,
        d_max_m=d_max_m,
        min_displacement_m=displacement_m,
        lookback_frames=k,
        speed_adaptive=adaptive,
    )


#: The configurations and rules that are compared (definitions, section 8).
CONFIGURATIONS: dict[str, DecisionConfig] = {
    "selected": DecisionConfig(),
    "conservative": _closing(60, 1.5, 15, 0.05, 3, adaptive=False),
    "narrow": _closing(0, 2.0, 10, 0.1, 3, adaptive=False),
    "speed_adaptive": _closing(60, 1.0, 20, 0.05, 2, adaptive=True),
    "distance_only": DecisionConfig(
        rule="distance", d_max_m=10, min_displacement_m=0, speed_adaptive=False
    ),
    "naive_closing": DecisionConfig(rule="naive"),
    "ttc": DecisionConfig(rule="ttc", min_displacement_m=0),
    "predictive": DecisionConfig(rule="predictive", max_range_m=27.0),
}


@dataclass(frozen=True)
class Suite:
    """Scenarios, the camera and its pose, and the ground-truth thresholds."""

    scenarios: tuple[Scenario, ...]
    camera: GroundCamera
    tracker: SimulatedTracker
    pose: CameraPose = SIMULATION_POSE
    truth_settings: GroundTruthSettings = DEFAULT_GROUND_TRUTH

    @staticmethod
    def load(
        scenarios: Sequence[Scenario], loaded: LoadedConfig, tracker: TrackerName = "deployed"
    ) -> Suite:
        return Suite(tuple(scenarios), ground_camera(loaded), SimulatedTracker.of(loaded, tracker))

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(s.name for s in self.scenarios)

    @cached_property
    def truths(self) -> tuple[GroundTruth, ...]:
        return tuple(compute_ground_truth(s, self.truth_settings) for s in self.scenarios)

    @cached_property
    def truth_frames(self) -> GroundTruthFrames:
        return GroundTruthFrames.join(self.truths)

    @cached_property
    def perception_results(self) -> tuple[PerceptionResult, ...]:
        return tuple(simulate_perception(s, self.camera, self.pose) for s in self.scenarios)

    @cached_property
    def hash(self) -> str:
        """SHA-256 over the scenarios' contents, in order of name."""
        digest = hashlib.sha256()
        for scenario in sorted(self.scenarios, key=lambda s: s.name):
            digest.update(dump_scenario(scenario).encode())
        return digest.hexdigest()

    def detection_sequences(
        self, localisation_error: bool = True, delay_frames: int = 0
    ) -> list[DetectionSequence]:
        """Every scenario's detections without misses."""
        return [
            DetectionSequence(
                s.observed_m if localisation_error else s.true_m, s.present, s.kind, delay_frames
            )
            for s in self.perception_results
        ]

    @cached_property
    def rule_input(self) -> RuleInput:
        """Track rows with localisation error, no misses, no latency."""
        return self._rule_inputs[0]

    @cached_property
    def _histories(self) -> tuple[TrackHistory, TrackHistory]:
        """With and without localisation error, in one pass of the tracker."""
        count = len(self.scenarios)
        sequences = [*self.detection_sequences(True), *self.detection_sequences(False)]
        history = track(sequences, self.tracker)
        return history.select(slice(0, count)), history.select(slice(count, 2 * count))

    @cached_property
    def _rule_inputs(self) -> tuple[RuleInput, RuleInput]:
        settings = self.tracker.rule(DecisionConfig())
        first, second = (build_rule_input(part, 0, settings) for part in self._histories)
        return first, second

    def outcome(self, decision: DecisionConfig, localisation_error: bool = True) -> Outcome:
        """Raw and shown states of every frame, scenario after scenario."""
        rows = self.rule_input if localisation_error else self._rule_inputs[1]
        settings = self.tracker.rule(decision)
        if decision.max_unseen_s != DecisionConfig().max_unseen_s:  # others count
            rows = build_rule_input(self._histories[not localisation_error], 0, settings)
        return outcome(rows, settings)

    def states(
        self, decision: DecisionConfig, localisation_error: bool = True
    ) -> npt.NDArray[np.int8]:
        """State codes that the light shows in every frame, scenario after scenario."""
        return self.outcome(decision, localisation_error).states

    def measure(
        self,
        decision: DecisionConfig,
        localisation_error: bool = True,
        truth: GroundTruthFrames | None = None,
    ) -> Metrics:
        """The decision's metrics; `truth`: the same frames under other thresholds."""
        found = self.outcome(decision, localisation_error)
        return measure(truth or self.truth_frames, found.states, found.raw)

    def with_truth(self, settings: GroundTruthSettings) -> Suite:
        """The same suite under other thresholds; perception is not computed again."""
        other = replace(self, truth_settings=settings)
        for name in ("perception_results", "rule_input", "_histories", "_rule_inputs", "hash"):
            if name in self.__dict__:
                other.__dict__[name] = self.__dict__[name]
        return other


def compare(
    suite: Suite, configurations: Mapping[str, DecisionConfig] = CONFIGURATIONS
) -> dict[str, dict[str, Metrics]]:
    """Metrics of every configuration, with and without localisation error."""
    return {
        "configurations": {name: suite.measure(c) for name, c in configurations.items()},
        "without_localisation_error": {
            name: suite.measure(c, localisation_error=False) for name, c in configurations.items()
        },
    }


def compare_json(
    suite: Suite, results: Mapping[str, Mapping[str, Metrics]], loaded: LoadedConfig, seed: int = 0
) -> dict[str, Any]:
    """The documented JSON of `conformance compare`."""

    def block(metrics: Metrics) -> dict[str, Any]:
        return {
            **metrics.as_dict(),
            "by_scenario": {name: metrics.scenario_dict(i) for i, name in enumerate(suite.names)},
        }

    parts = {
        part: {name: block(metrics) for name, metrics in found.items()}
        for part, found in results.items()
    }
    return {**result_provenance(suite, loaded, seed), **parts}


def result_provenance(suite: Suite, loaded: LoadedConfig, seed: int) -> dict[str, Any]:
    """Version, hashes, camera and seed: what a result depends on."""
    return {
        "version": __version__,
        "scenarios": len(suite.scenarios),
        "suite_hash": suite.hash,
        "tracker": suite.tracker.name,
        "config_hash": loaded.hash,
        "calibration_hash": loaded.calibration_hash,
        "camera": camera_json(suite),
        "seed": seed,
    }


def camera_json(suite: Suite) -> dict[str, Any]:
    """The camera as the JSON records it."""
    camera, pose = suite.camera, suite.pose
    return {
        "projection": camera.lens.projection,
        "focal_length_px": camera.lens.focal_px,
        "k": list(camera.lens.k),
        "fov_deg": float(np.degrees(2 * camera.lens.max_theta_rad)),
        "cx": camera.cx,
        "cy": camera.cy,
        "height_m": camera.height_m,
        "pitch_deg": camera.pitch_deg,
        "x_m": pose.x_m,
        "y_m": pose.y_m,
        "heading_deg": pose.heading_deg,
    }
