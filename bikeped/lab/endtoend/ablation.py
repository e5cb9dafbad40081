"""Ablation from scripted positions to the whole loop: which stage loses what.

Each step hands the deployed tracker and decision a little more of what the pixels do; what changes
between two steps is lost (or gained) at that stage.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.lab.endtoend.measures import MIN_VISIBLE, match_detections
from bikeped.lab.endtoend.run import EndToEndRun
from bikeped.lab.rendering import DrawnObject
from bikeped.lab.simulation.metrics import Metrics, measure
from bikeped.lab.simulation.perception import PerceptionResult
from bikeped.lab.simulation.simulate import FPS
from bikeped.lab.simulation.suite import Suite
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.types import Decision, Detections, GroundPoints

#: Shown and raw state codes [2, f].
States = npt.NDArray[np.int8]


@dataclass(frozen=True)
class AblationStep:
    """One step: its name, what it adds to the one before, its states and metrics."""

    name: str
    adds: str
    states: States
    metrics: Metrics


def run_ablation(
    suite: Suite, runs: Sequence[EndToEndRun], loaded: LoadedConfig, decision: DecisionConfig
) -> list[AblationStep]:
    """The steps from scripted positions to the deployed loop, over all scenarios of `suite`."""
    tracker = TrackAndDecide(
        loaded, cyclist_box_includes_rider=all(run.cyclist_box_includes_rider for run in runs)
    )

    def points(in_frame: bool) -> States:
        pairs = zip(runs, suite.perception_results, strict=True)
        return np.hstack([states_from_points(tracker, run, seen, in_frame) for run, seen in pairs])

    def boxes(detections: Callable[[EndToEndRun, int], Detections]) -> States:
        return np.hstack([states_from_boxes(tracker, run, detections) for run in runs])

    scripted = suite.outcome(decision)
    steps: list[tuple[str, str, States]] = [
        (
            "scripted",
            "positions with the box model's error",
            np.stack([scripted.states, scripted.raw]),
        ),
        ("picture", "objects outside the picture are not seen", points(in_frame=True)),
        ("outline", "boxes around what was drawn", boxes(_whole)),
        ("occlusion", "hidden parts are not seen", boxes(_visible)),
        ("misses", "only what the detector found", boxes(_found_exact)),
        ("boxes", "the detector's boxes", boxes(_found_true_kind)),
        ("kinds", "the detector's kinds", boxes(_found)),
        (
            "false detections",
            "all detections: the deployed loop",
            np.hstack([[run.state, run.raw_state] for run in runs]),
        ),
    ]
    return [
        AblationStep(name, adds, states, measure(suite.truth_frames, *states))
        for name, adds, states in steps
    ]


def states_from_points(
    tracker: TrackAndDecide, run: EndToEndRun, seen: PerceptionResult, in_frame: bool
) -> States:
    """States [2, f] from the simulation's positions; `in_frame`: of agents that were drawn."""
    tracker.reset()
    decisions = []
    for frame in range(len(seen.present)):
        drawn = {o.id for o in run.objects[frame]}
        index = np.asarray(
            [
                a
                for a in np.nonzero(seen.present[frame])[0].tolist()
                if not in_frame or run.scenario.agents[a].id in drawn
            ],
            np.int64,
        )
        points = GroundPoints(seen.kind[index], seen.observed_m[frame, index], index)
        decisions.append(tracker.update_from_points(points, frame / FPS).decision)
    return _codes(decisions)


def states_from_boxes(
    tracker: TrackAndDecide, run: EndToEndRun, detections: Callable[[EndToEndRun, int], Detections]
) -> States:
    """States [2, f] from `detections(run, frame)`."""
    tracker.reset()
    results = (
        tracker.update(detections(run, frame), run.width, run.height, frame / FPS, 0.0)
        for frame in range(len(run.state))
    )
    return _codes([result.decision for result in results])


def _codes(decisions: Sequence[Decision]) -> States:
    raw = [int(d.state if d.raw is None else d.raw) for d in decisions]
    return np.asarray([[int(d.state) for d in decisions], raw], np.int8)


def _exact(objects: Sequence[DrawnObject], whole: bool) -> Detections:
    """Detections with the boxes that were drawn; `whole`: as if nothing were hidden."""
    if not objects:
        return Detections.empty()
    return Detections(
        np.asarray([int(o.label) for o in objects], np.int8),
        np.ones(len(objects), np.float32),
        np.asarray([o.full_box_px if whole else o.box_px for o in objects], np.float32),
    )


def _whole(run: EndToEndRun, frame: int) -> Detections:
    return _exact(run.objects[frame], whole=True)


def _visible(run: EndToEndRun, frame: int) -> Detections:
    return _exact([o for o in run.objects[frame] if o.visible >= MIN_VISIBLE], whole=False)


def _found_exact(run: EndToEndRun, frame: int) -> Detections:
    objects = run.objects[frame]
    found = match_detections(run.detections[frame], objects).found
    return _exact([o for o, d in zip(objects, found, strict=True) if d >= 0], whole=False)


def _found(run: EndToEndRun, frame: int) -> Detections:
    detections = run.detections[frame]
    return detections.take(match_detections(detections, run.objects[frame]).object >= 0)


def _found_true_kind(run: EndToEndRun, frame: int) -> Detections:
    detections, objects = run.detections[frame], run.objects[frame]
    which = match_detections(detections, objects).object
    kept = detections.take(which >= 0)
    kind = np.asarray([int(objects[o].label) for o in which[which >= 0]], np.int8)
    return Detections(kind, kept.confidence, kept.box_px)
