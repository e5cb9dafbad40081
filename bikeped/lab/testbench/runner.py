"""Runs the suite under the test bench's settings, with the code of the conformance commands.

`BenchSuite` is a `Suite` whose tracks come from the settings' perception: a second camera, missed
detections, latency, prediction. States, ground truth, metrics and gates are those of `Suite`. With
the configuration in force the figures equal those of `bikeped conformance compare`.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from typing import Any, Generic, TypeVar

import msgspec

from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.errors import BikepedError
from bikeped.lab.experiments.deployment import fuse_cameras
from bikeped.lab.experiments.trials import (
    DetectableObjects,
    LossModel,
    simulate_trials,
    summarize_metrics,
)
from bikeped.lab.scenarios.scenario import Scenario, dump_scenario
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.lab.simulation.metrics import GroundTruthFrames
from bikeped.lab.simulation.perception import PerceptionResult, RecallModel, simulate_perception
from bikeped.lab.simulation.simulate import (
    DetectionSequence,
    RuleInput,
    SimulatedTracker,
    TrackerName,
    TrackHistory,
    build_rule_input,
    delay_history,
    track,
)
from bikeped.lab.simulation.suite import Suite
from bikeped.lab.simulation.truth import GroundTruth, GroundTruthSettings, compute_ground_truth
from bikeped.lab.testbench.settings import (
    BenchSettings,
    Delay,
    Perception,
    camera_with_mount,
    custom_scenarios,
    parse_custom_scenario,
)

T = TypeVar("T")

#: Largest frames x scenarios x track slots of one answer: about five seconds on a small computer.
MOST_WORK = 4_000_000


@dataclass(frozen=True)
class BenchSuite(Suite):
    """A suite under the bench's perception and delay; `second` is a camera of the same mount."""

    perception: Perception = field(default_factory=Perception)
    delay: Delay = field(default_factory=Delay)
    second: CameraPose | None = None

    @property
    def poses(self) -> tuple[CameraPose, ...]:
        return (self.pose,) if self.second is None else (self.pose, self.second)

    @cached_property
    def second_perception_results(self) -> tuple[PerceptionResult, ...]:
        """What the second camera makes of every scenario; empty without one."""
        if self.second is None:
            return ()
        return tuple(simulate_perception(s, self.camera, self.second) for s in self.scenarios)

    @cached_property
    def observed(self) -> tuple[DetectableObjects, ...]:
        """What could be detected, by all cameras together, in the first one's ground frame."""
        model = self.perception.model() or RecallModel("size")
        found = []
        for i, scenario in enumerate(self.scenarios):
            views = [self.perception_results[i], *self.second_perception_results[i : i + 1]]
            one = fuse_cameras(scenario.name, views, self.poses, model)
            if not self.perception.localisation_error:
                one = replace(one, xy_m=self.perception_results[i].true_m)
            found.append(one)
        return tuple(found)

    @cached_property
    def shown_detections(self) -> tuple[DetectionSequence, ...]:
        """The detections of each scenario, in the trial that is shown."""
        late, view = self.delay.frames, self.perception
        if view.model() is None:
            return tuple(DetectionSequence(o.xy_m, o.present, o.kind, late) for o in self.observed)
        return tuple(o.trials([view.trial], view.seed, view.burst_frames)[0] for o in self.observed)

    @cached_property
    def track_history(self) -> TrackHistory:
        found = track(self.shown_detections, self.tracker)
        # Without misses the delay is in the scenes, as `conformance latency` has it; with them the
        # trial is tracked once and comes late, as `conformance montecarlo` and the sweep do.
        return found if self.perception.model() is None else delay_history(found, self.delay.frames)

    @cached_property
    def rule_input(self) -> RuleInput:
        """Track rows as the rules read them, under this perception and delay."""
        return build_rule_input(
            self.track_history, self.delay.order, self.tracker.rule(DecisionConfig())
        )

    def with_truth(self, settings: GroundTruthSettings) -> BenchSuite:
        """The same suite under other thresholds; perception is not computed again."""
        other = replace(self, truth_settings=settings)
        other.__dict__.update({key: self.__dict__[key] for key in _KEPT & self.__dict__.keys()})
        return other


#: Cached properties that do not depend on the ground truth's thresholds.
_KEPT = {"names", "hash", "perception_results", "second_perception_results", "observed"}
_KEPT |= {"shown_detections", "track_history", "rule_input"}


def trial_summaries(suite: BenchSuite, bench: BenchSettings) -> dict[str, Any] | None:
    """Means over the bench's trials with their 95 % intervals; None when nobody is missed.

    In order of names, as `conformance montecarlo` counts: the same figures.
    """
    model = bench.perception.model()
    if model is None:
        return None
    order = sorted(range(len(suite.scenarios)), key=lambda i: suite.scenarios[i].name)
    observed = [suite.observed[i] for i in order]
    truth = GroundTruthFrames.join([suite.truths[i] for i in order])
    trials = bench.perception.trials
    check_work(suite.scenarios, trials)
    case = (bench.delay.frames, bench.delay.order)
    plan = LossModel(model, bench.perception.burst_frames, (case,))
    found = simulate_trials(
        observed,
        truth,
        plan,
        {"": bench.decision},
        range(trials),
        bench.perception.seed,
        suite.tracker,
    )
    return {"trials": trials, **summarize_metrics(found[case][""])}


def check_work(scenarios: Sequence[Scenario], repeats: int = 1) -> None:
    """BikepedError when an answer would take too long."""
    frames = max(len(s.frame_times()) for s in scenarios)
    slots = max(2 * max(len(s.agents) for s in scenarios), 4)
    if frames * slots * len(scenarios) * repeats > MOST_WORK:
        raise BikepedError(
            "this is more than the page computes at once; take fewer trials, or fewer and shorter "
            "scenarios, or use bikeped conformance montecarlo"
        )


class BenchRunner:
    """Runs the suite under changing settings and caches what they share. Thread-safe by a lock."""

    def __init__(
        self, loaded: LoadedConfig, scenarios: Sequence[Scenario], tracker: TrackerName = "deployed"
    ) -> None:
        self.loaded, self.scenarios, self.tracker = loaded, tuple(scenarios), tracker
        self._texts = {id(s): dump_scenario(s) for s in self.scenarios}
        self._seen: _LruCache[PerceptionResult] = _LruCache(400)
        self._truths: _LruCache[GroundTruth] = _LruCache(400)
        self._suites: _LruCache[BenchSuite] = _LruCache(12)
        self._parse = lru_cache(60)(parse_custom_scenario)  # parsing YAML is slow
        self._lock = threading.Lock()

    def suite_scenarios(self, bench: BenchSettings) -> tuple[Scenario, ...]:
        """The suite with the custom scenarios, as `conformance contest --scenario` adds them: one
        with the name of a bundled scenario replaces it."""
        custom = custom_scenarios(bench, self._parse)
        bundled = [custom.pop(s.name, s) for s in self.scenarios]
        return (*bundled, *custom.values())

    def full_suite(self, bench: BenchSettings) -> BenchSuite:
        """The suite of all scenarios."""
        return self._suite(bench, self.suite_scenarios(bench))

    def shown_suite(self, bench: BenchSettings) -> BenchSuite:
        """A suite of the scenario shown only."""
        for scenario in self.suite_scenarios(bench):
            if bench.scenario in ("", scenario.name):
                return self._suite(bench, (scenario,))
        raise BikepedError(f"scenario {bench.scenario!r}: does not exist; choose another")

    def _suite(self, bench: BenchSettings, scenarios: tuple[Scenario, ...]) -> BenchSuite:
        check_work(scenarios)
        with self._lock:
            camera = camera_with_mount(self.loaded, bench.camera)
            pose = bench.camera.pose()
            second = None if bench.second_camera is None else bench.second_camera.pose()
            # A scenario's key is its text; ids of bundled ones stay taken.
            texts = [self._texts.get(id(s)) or dump_scenario(s) for s in scenarios]
            where = msgspec.json.encode(bench.camera)
            # The number of trials that are averaged does not change the one that is shown.
            perception = msgspec.structs.replace(bench.perception, trials=1)
            key = (*texts, where, msgspec.json.encode([perception, bench.delay]), str(second))

            def make() -> BenchSuite:
                suite = BenchSuite(
                    scenarios,
                    camera,
                    SimulatedTracker.of(self.loaded, self.tracker),
                    pose,
                    GroundTruthSettings(),
                    perception,
                    bench.delay,
                    second,
                )
                suite.__dict__["perception_results"] = tuple(
                    self._seen.get(
                        (text, where), partial(simulate_perception, scenario, camera, pose)
                    )
                    for text, scenario in zip(texts, scenarios, strict=True)
                )
                return suite

            suite = self._suites.get(key, make)
            suite.rule_input  # noqa: B018 - computed before the copy, which shares it
            settings = bench.danger.settings()
            with_truth = suite.with_truth(settings)
            with_truth.__dict__["truths"] = tuple(
                self._truths.get(
                    (text, settings), partial(compute_ground_truth, scenario, settings)
                )
                for text, scenario in zip(texts, scenarios, strict=True)
            )
            return with_truth


class _LruCache(Generic[T]):
    """The last `most` values by key."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._items: OrderedDict[Any, T] = OrderedDict()

    def get(self, key: Any, make: Callable[[], T]) -> T:
        if key in self._items:
            self._items.move_to_end(key)
            return self._items[key]
        self._items[key] = value = make()
        if len(self._items) > self._most:
            self._items.popitem(last=False)
        return value
