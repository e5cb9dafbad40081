"""The nuisance gate: a light that is mostly right holds it, one that is mostly red does not."""

from pathlib import Path

import msgspec
import pytest
from traffic_scenes import BUNDLED, write_traffic

from bikeped.config.load import load_config
from bikeped.config.schema import DecisionConfig
from bikeped.lab.governance.gates import Gate, all_hold
from bikeped.lab.governance.nuisance import grouped, nuisance_gates, quiet_scenarios
from bikeped.lab.simulation.suite import CONFIGURATIONS

LOADED = load_config(Path(__file__).parents[3] / "config.yaml")
#: Red whenever a cyclist and a pedestrian are in view.
ALWAYS_RED = DecisionConfig(
    rule="distance", d_min_m=0, d_max_m=100, speed_adaptive=False, alert_hold_s=2.0
)


def gates_of(decision, traffic=None):
    return nuisance_gates(LOADED, decision, traffic=traffic, encounters=24)


def test_quiet_scenarios_hold_no_danger_and_are_of_both_folders():
    names = {s.name for s in quiet_scenarios()}
    assert {"Safe Crossing", "Parallel Paths", "Bikes Only"} <= names
    assert len(names) > 5


def test_the_configured_rule_is_calmer_than_a_light_that_is_always_red():
    own, red = gates_of(LOADED.config.decision), gates_of(ALWAYS_RED)
    assert [g.name for g in own] == [g.name for g in red]
    assert {g.kind for g in own} == {"nuisance"}
    assert own[1].measured < red[1].measured
    assert not red[1].holds
    assert not all_hold(red)


def test_scenes_of_ones_own_are_a_gate_of_their_own(tmp_path):
    folder = write_traffic(tmp_path, sorted(BUNDLED)[:3])
    with_traffic = gates_of(CONFIGURATIONS["selected"], folder)
    assert len(with_traffic) == 5
    assert str(folder) in with_traffic[-1].name
    assert with_traffic[:3] == gates_of(CONFIGURATIONS["selected"])


def test_a_longer_hold_than_allowed_does_not_hold():
    gate = nuisance_gates(
        LOADED, msgspec.structs.replace(ALWAYS_RED, alert_hold_s=2.5), encounters=1
    )[0]
    assert not gate.holds


@pytest.mark.parametrize(
    ("measured", "text"), [(1.8, "1.80 x"), (1.8004, "1.801 x"), (1.2, "1.20 x")]
)
def test_what_fails_never_reads_like_what_holds(measured, text):
    gate = Gate("Red", 1.8, False, "x", measured, measured <= 1.8, "nuisance", at_most=True)
    assert gate.format_value(measured) == text
    assert gate.rule == "at most 1.80 x"
    assert grouped([gate]) == {"nuisance": measured <= 1.8}
