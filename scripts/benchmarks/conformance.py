"""The conformance simulation: all configurations, against frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench import Figures


def run(figures: Figures) -> None:
    """Seven configurations over the bundled scenarios, with and without localisation error."""
    from bench import in_turns

    from bikeped.config import load_config, rule_settings
    from bikeped.conformance.scenario import bundled_folder, load_scenarios
    from bikeped.conformance.simulate import SIMULATION_TRACKER
    from bikeped.conformance.suite import CONFIGURATIONS, Suite, compare
    from bikeped.decision import Decider
    from bikeped.tracking import LaneTracker

    loaded = load_config()
    scenarios = load_scenarios(bundled_folder())

    def ours() -> None:
        compare(Suite.load(scenarios, loaded))

    def obvious_part() -> None:
        """One configuration with localisation error, frame by frame: 1/14 of the comparison."""
        suite = Suite.load(scenarios, loaded)
        for scene in suite.scenes():
            tracker = LaneTracker(SIMULATION_TRACKER)
            decider = Decider(rule_settings(CONFIGURATIONS["selected"]))
            for i in range(len(scene.xy_m)):
                there = scene.detected[i]
                xy, kind = scene.xy_m[i][there], scene.kind[there]
                tracker.update(i / 30, xy[None], kind[None])
                at = tracker.reported[0]
                order = tracker.id[0][at].argsort()
                decider.step(
                    i / 30,
                    tracker.id[0][at][order],
                    tracker.kind[0][at][order],
                    tracker.xy_m[0][at][order],
                )

    a, b = in_turns(ours, obvious_part, 3)
    figures.add(
        f"compare {len(CONFIGURATIONS)} configurations, {len(scenarios)} scenarios, twice",
        a,
        b * 2 * len(CONFIGURATIONS),
        "s",
        "0.5",
    )
