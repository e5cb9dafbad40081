"""Random encounters: varied, half of them harmless frames, people who move as people do."""

import numpy as np
import pytest

from bikeped.lab.scenarios.random_encounters import RIDE_MPS, WALK_MPS, random_encounters
from bikeped.lab.scenarios.scenario import dump_scenario, parse_scenario
from bikeped.lab.simulation.perception import SIMULATION_POSE
from bikeped.lab.simulation.truth import compute_ground_truth


@pytest.fixture(scope="module")
def scenarios():
    return random_encounters(11, 100)


def legs_mps(agent):
    step = np.diff(agent.path, axis=0)
    return np.hypot(step[:, 1], step[:, 2]) / step[:, 0]


def of_kind(scenario, kind):
    return [agent for agent in scenario.agents if agent.kind == kind]


def test_they_are_read_back_as_they_were(scenarios):
    for scenario in scenarios:
        text = dump_scenario(scenario)
        assert dump_scenario(parse_scenario(text, "")) == text


def test_speeds_are_those_of_people(scenarios):
    for scenario in scenarios:
        for agent in scenario.agents:
            fastest = (WALK_MPS if agent.kind == "pedestrian" else RIDE_MPS)[1]
            # A leg as short as 0.1 s carries the rounding to centimetres.
            assert legs_mps(agent).max() <= fastest + 0.25, (scenario.name, agent.id)


def test_they_are_varied(scenarios):
    assert {len(of_kind(s, "pedestrian")) for s in scenarios} == {1, 2, 3}
    assert {len(of_kind(s, "cyclist")) for s in scenarios} == {1, 2, 3}
    assert {s.vehicle for s in scenarios} == {"bicycle", "ebike"}
    for words in ("crossing", "same way", "opposite", "late turn", "stands", "stops", "turns away"):
        assert any(words in s.story for s in scenarios), words
    least_m = [compute_ground_truth(s).nearest_m.min() for s in scenarios]
    assert np.histogram(least_m, [0, 1, 2, 4, 6, 9])[0].min() >= 5


def test_many_are_harmless_and_many_are_not(scenarios):
    truths = [compute_ground_truth(s) for s in scenarios]
    dangerous = np.mean([t.danger.any() for t in truths])
    assert 0.5 < dangerous < 0.9
    assert np.mean([t.actionable.any() for t in truths]) > 0.4


def test_the_camera_sees_the_meeting(scenarios):
    for scenario in scenarios:
        truth = compute_ground_truth(scenario)
        at = truth.time_s[np.argmin(truth.nearest_m)]
        places = [found[0] for a in scenario.agents if (found := a.at(at)) is not None]
        ahead_m = SIMULATION_POSE.world_to_ground(np.asarray(places))
        assert np.hypot(*ahead_m.T).min() < 25
