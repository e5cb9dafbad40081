"""The nuisance gate (definitions, section 10): how red a light is beside one that knows danger.

Sensitivity can be bought by showing red for longer, so over random encounters and quiet scenarios
the light may be only so much redder, and alert only so much more often, than the light that shows
the danger label itself with the same window and hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.lab.governance.gates import Gate
from bikeped.lab.scenarios.random_encounters import random_encounters
from bikeped.lab.scenarios.scenario import Scenario, bundled_folder, load_scenarios, street_folder
from bikeped.lab.simulation.light_record import light_figures
from bikeped.lab.simulation.simulate import TrackerName
from bikeped.lab.simulation.truth import compute_ground_truth
from bikeped.lab.traffic.readers import read_traffic
from bikeped.lab.traffic.suite import TrafficSuite

SEED, ENCOUNTERS = 0, 200
RED_MOST, ALERTS_MOST, HOLD_MOST_S = 1.8, 1.3, 2.0


def quiet_scenarios() -> list[Scenario]:
    """The bundled scenarios that hold no danger."""
    every = [*load_scenarios(bundled_folder()), *load_scenarios(street_folder())]
    return [s for s in every if not compute_ground_truth(s).danger.any()]


def nuisance_gates(
    loaded: LoadedConfig,
    decision: DecisionConfig,
    tracker: TrackerName = "deployed",
    traffic: Path | None = None,
    encounters: int = ENCOUNTERS,
) -> list[Gate]:
    """The gates of a decision over bundled traffic, and over the scenes in the folder `traffic`."""
    bundled = [*random_encounters(SEED, encounters), *quiet_scenarios()]
    suites = {"": TrafficSuite.of_scenarios(bundled, loaded, "realistic", SEED, tracker)}
    if traffic is not None:
        scenes = read_traffic(traffic)
        suites[f" in {traffic}"] = TrafficSuite.load(scenes, loaded, "realistic", SEED, tracker)
    gates = [_at_most("Hold of ALERT", HOLD_MOST_S, "s", decision.alert_hold_s)]
    for where, suite in suites.items():
        gates += _beside_foresight(suite, decision, where)
    return gates


def _beside_foresight(suite: TrafficSuite, decision: DecisionConfig, where: str) -> list[Gate]:
    own, known = light_figures(suite.lights(decision)), light_figures(suite.foresight(decision))

    def ratio(key: str) -> float:
        return float(own[key] / known[key]) if known[key] else float("nan")

    return [
        _at_most(f"Red beside foresight's{where}", RED_MOST, "x", ratio("red_share")),
        _at_most(f"Alerts beside foresight's{where}", ALERTS_MOST, "x", ratio("alerts_per_hour")),
    ]


def _at_most(name: str, most: float, unit: str, measured: float) -> Gate:
    return Gate(name, most, False, unit, measured, measured <= most, "nuisance", at_most=True)


def grouped(gates: Sequence[Gate]) -> dict[str, Any]:
    """Which of the two kinds of gates hold, for JSON."""
    kinds = {gate.kind for gate in gates}
    return {kind: all(g.holds for g in gates if g.kind == kind) for kind in sorted(kinds)}
