"""The scenes of an ordinary street: hardly a conflict, and what was lost does not make red."""

from pathlib import Path

import numpy as np
import pytest

from bikeped.config.load import load_config
from bikeped.lab.scenarios.scenario import dump_scenario, load_scenarios, parse_scenario
from bikeped.lab.simulation.perception import simulate_perception
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite
from bikeped.lab.traffic.suite import TrafficSuite

LOADED = load_config(Path(__file__).parents[3] / "config.yaml")
SCENARIOS = {s.name: s for s in load_scenarios(Path("street"))}
VANISHING = {
    "Cyclist Vanishes Behind Van": 2,
    "Pedestrian Vanishes Behind Van": 1,
    "Cyclist Leaves the View": 2,
}
RULES = ("selected", "naive_closing", "ttc")


@pytest.fixture(scope="module")
def traffic():
    return TrafficSuite.of_scenarios(SCENARIOS.values(), LOADED, "realistic", 0)


def lights(traffic, rule):
    return dict(zip(SCENARIOS, traffic.lights(CONFIGURATIONS[rule]), strict=True))


def test_what_real_traffic_showed_is_there():
    assert len(SCENARIOS) == 11
    for name, scenario in SCENARIOS.items():
        assert Path(scenario.source).name == name.lower().replace(" ", "-") + ".yaml"
        assert len(scenario.story) > 60
        assert {a.kind for a in scenario.agents} >= {"pedestrian", "cyclist"}


def test_they_are_written_back_as_they_were():
    for scenario in SCENARIOS.values():
        again = parse_scenario(dump_scenario(scenario), scenario.source)
        assert again.duration_s == scenario.duration_s
        assert [a.hidden for a in again.agents] == [a.hidden for a in scenario.agents]
        assert dump_scenario(again) == dump_scenario(scenario)


def test_nothing_happens_in_the_safe_ones(traffic):
    for scenario, conflicts in zip(SCENARIOS.values(), traffic.conflicts, strict=True):
        assert len(conflicts.time_s) == 0 or scenario.hazard == "multi-agent", scenario.name


@pytest.mark.parametrize("name", VANISHING)
def test_a_scene_runs_on_for_12_seconds_after_the_last_sighting(traffic, name):
    seen = traffic.perception_results[list(SCENARIOS).index(name)]
    index = [a.id for a in SCENARIOS[name].agents].index(VANISHING[name])
    # Within 25 m: whoever is farther away is out of the rule's sight.
    near = seen.present[:, index] & (np.hypot(*seen.true_m[:, index].T) <= 25)
    last_s = np.flatnonzero(near)[-1] / 30
    assert SCENARIOS[name].duration_s - last_s >= 12
    assert last_s > 2


@pytest.mark.parametrize("rule", RULES)
def test_nobody_is_warned_of_somebody_who_vanished(traffic, rule):
    """From a second after the last sighting, and the hold."""
    found = lights(traffic, rule)
    for name, who in VANISHING.items():
        index = [a.id for a in SCENARIOS[name].agents].index(who)
        seen = traffic.perception_results[list(SCENARIOS).index(name)].present[:, index]
        last_s = np.flatnonzero(seen)[-1] / 30
        light = found[name]
        assert not light.shown[light.truth.time_s > last_s + 1.0 + 1.5 + 0.1].any(), name


@pytest.mark.parametrize("rule", RULES)
def test_own_and_parked_bicycles_and_followers_are_no_alert(traffic, rule):
    found = lights(traffic, rule)
    for name in ("Pushed Bicycle", "Parked Bicycle"):
        assert not found[name].shown.any(), name


def test_the_queue_is_warned_of_as_it_comes_and_not_while_it_stands(traffic):
    light = lights(traffic, "selected")["Queue at the Signal"]
    assert not light.shown[(light.truth.time_s > 8) & (light.truth.time_s < 13)].any()


def test_conformance_reads_the_street_by_name():
    suite = Suite.load(load_scenarios(Path("street")), LOADED)
    assert set(suite.names) == set(SCENARIOS)


def test_hidden_is_unseen_and_there(traffic):
    text = """
name: Hidden
duration_s: 3
agents:
  - {id: 1, kind: pedestrian, hidden: [[0.5, 1.0]], path: [[0, 5, 0], [2, 5, 2]]}
"""
    scenario = parse_scenario(text, "a.yaml")
    seen = simulate_perception(scenario, traffic.camera)
    t = scenario.frame_times()
    assert t[-1] == pytest.approx(3)
    hidden = (t > 0.5 - 1e-6) & (t < 1 + 1e-6)
    np.testing.assert_array_equal(seen.present[:, 0], (t <= 2 + 1e-6) & ~hidden)
    assert scenario.agents[0].at(0.7) is not None
