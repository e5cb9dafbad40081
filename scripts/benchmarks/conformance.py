"""The conformance simulation: all configurations, against frame by frame."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.figures import Figures, in_turns, seconds
from bikeped.config.build import rule_settings
from bikeped.config.load import LoadedConfig, load_config
from bikeped.cores import cores
from bikeped.decision.decider import Decider
from bikeped.lab.experiments import optimizer
from bikeped.lab.experiments.reproduce import ReproduceSettings, reproduce
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.simulate import SimulatedTracker
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite, compare
from bikeped.tracking.batch_tracker import BatchTracker


def run(figures: Figures) -> None:
    """Seven configurations over the bundled scenarios, with and without localisation error."""
    loaded = load_config()
    scenarios = load_scenarios(bundled_folder())

    def ours() -> None:
        compare(Suite.load(scenarios, loaded))

    def obvious_part() -> None:
        """One configuration with localisation error, frame by frame: 1/14 of the comparison."""
        suite = Suite.load(scenarios, loaded)
        for scene in suite.detection_sequences():
            tracker = BatchTracker(SimulatedTracker.of(loaded).settings)
            decider = Decider(rule_settings(CONFIGURATIONS["selected"]))
            for i in range(len(scene.xy_m)):
                there = scene.detected[i]
                xy, kind = scene.xy_m[i][there], scene.kind[there]
                tracker.update(i / 30, xy[None], kind[None])
                at = tracker.reported[0]
                order = tracker.id[0][at].argsort()
                tracks = (tracker.id, tracker.kind, tracker.xy_m)
                decider.decide(i / 30, *(values[0][at][order] for values in tracks))

    a, b = in_turns(ours, obvious_part, 3)
    _searches(figures, Suite.load(scenarios, loaded), loaded, b)
    what = f"compare {len(CONFIGURATIONS)} configurations, {len(scenarios)} scenarios, twice"
    figures.add(what, a, b * 2 * len(CONFIGURATIONS), "s", "0.5")


def _searches(figures: Figures, suite: Suite, loaded: LoadedConfig, one_pass_s: float) -> None:
    """The optimiser and the whole reproduction; the obvious way is so many passes frame by frame.

    It is not run for half an hour: one pass was measured, the rest is arithmetic.
    """
    count = optimizer.evaluations()
    took = seconds(lambda: optimizer.optimize(suite, loaded.config.decision))
    figures.add(f"optimise, {count} evaluations", took, count * one_pass_s, "s", "60")
    trials = ReproduceSettings().trials
    with tempfile.TemporaryDirectory() as folder:
        took = seconds(lambda: reproduce(suite, loaded, Path(folder), processes=cores()))
    figures.add(f"reproduce everything, {trials} trials, with figures", took, None, "s", "60")
