"""The conformance simulation: all configurations, against frame by frame."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from benchmarks.figures import Figures
    from bikeped.config import LoadedConfig
    from bikeped.lab.simulation.suite import Suite


def run(figures: Figures) -> None:
    """Seven configurations over the bundled scenarios, with and without localisation error."""
    from benchmarks.figures import in_turns
    from bikeped.config import load_config, rule_settings
    from bikeped.decision import Decider
    from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
    from bikeped.lab.simulation.simulate import SIMULATION_TRACKER
    from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite, compare
    from bikeped.tracking import BatchTracker

    loaded = load_config()
    scenarios = load_scenarios(bundled_folder())

    def ours() -> None:
        compare(Suite.load(scenarios, loaded))

    def obvious_part() -> None:
        """One configuration with localisation error, frame by frame: 1/14 of the comparison."""
        suite = Suite.load(scenarios, loaded)
        for scene in suite.detection_sequences():
            tracker = BatchTracker(SIMULATION_TRACKER)
            decider = Decider(rule_settings(CONFIGURATIONS["selected"]))
            for i in range(len(scene.xy_m)):
                there = scene.detected[i]
                xy, kind = scene.xy_m[i][there], scene.kind[there]
                tracker.update(i / 30, xy[None], kind[None])
                at = tracker.reported[0]
                order = tracker.id[0][at].argsort()
                decider.decide(
                    i / 30,
                    tracker.id[0][at][order],
                    tracker.kind[0][at][order],
                    tracker.xy_m[0][at][order],
                )

    a, b = in_turns(ours, obvious_part, 3)
    _searches(figures, Suite.load(scenarios, loaded), loaded, b)
    figures.add(
        f"compare {len(CONFIGURATIONS)} configurations, {len(scenarios)} scenarios, twice",
        a,
        b * 2 * len(CONFIGURATIONS),
        "s",
        "0.5",
    )


def _searches(figures: Figures, suite: Suite, loaded: LoadedConfig, one_pass_s: float) -> None:
    """The optimiser and the whole reproduction; the obvious way is so many passes frame by frame.

    It is not run for half an hour: one pass was measured, the rest is arithmetic.
    """
    from bikeped.cores import cores
    from bikeped.lab.experiments import optimizer
    from bikeped.lab.experiments.reproduce import ReproduceSettings, reproduce

    count = optimizer.evaluations()
    began = time.perf_counter()
    optimizer.optimize(suite, loaded.config.decision)
    took = time.perf_counter() - began
    figures.add(f"optimise, {count} evaluations", took, count * one_pass_s, "s", "60")
    trials = ReproduceSettings().trials
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        reproduce(suite, loaded, Path(folder), processes=cores())
        took = time.perf_counter() - began
    figures.add(f"reproduce everything, {trials} trials, with figures", took, None, "s", "60")
