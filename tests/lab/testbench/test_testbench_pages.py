"""The test bench's numbers are the conformance commands' numbers, and its sentences the pole's."""

import hashlib
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from aiohttp.test_utils import TestClient, TestServer
from testbench_fakes import BASE, LOADED, OWN, SCENARIOS, bench, pages

from bikeped.config.build import rule_settings
from bikeped.config.schema import DecisionConfig
from bikeped.decision.decider import Decider
from bikeped.lab.experiments.latency import sweep
from bikeped.lab.experiments.trials import (
    LossModel,
    simulate_suite_trials,
    sorted_suite,
    summarize_metrics,
)
from bikeped.lab.scenarios.scenario import dump_scenario, load_scenarios, parse_scenario
from bikeped.lab.simulation.perception import RecallModel
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite, compare, compare_json
from bikeped.lab.testbench.pages import script
from bikeped.lab.testbench.playback import TESTS, coverage, playback
from bikeped.lab.testbench.runner import BenchRunner, trial_summaries
from bikeped.lab.testbench.settings import Pose
from bikeped.types import State


@pytest.fixture(scope="module")
def work():
    return BenchRunner(LOADED, SCENARIOS)


@pytest.fixture(scope="module")
def suite():
    return Suite.load(SCENARIOS, LOADED)


@pytest.fixture(scope="module")
def compared(suite):
    # Through JSON and back, as a reader of the command's file gets it: repr is the last digit.
    return json.loads(json.dumps(compare_json(suite, compare(suite), LOADED)))


async def ask(client, path, asked, status=200):
    answer = await client.post(f"/testbench/{path}", json={"bench": msgspec.to_builtins(asked)})
    assert answer.status == status, await answer.text()
    return await answer.json()


async def test_every_scenario_under_every_rule_agrees_with_compare(compared):
    names = list(CONFIGURATIONS)
    async with TestClient(TestServer(pages())) as client:
        for scenario in SCENARIOS:
            for first in range(0, len(names), 3):
                here = names[first : first + 3]
                asked = msgspec.structs.replace(
                    BASE,
                    scenario=scenario.name,
                    decision=CONFIGURATIONS[here[0]],
                    beside=tuple(here[1:]),
                )
                play = await ask(client, "scenario", asked)
                assert [side["name"] for side in play["sides"]] == here
                for side in play["sides"]:
                    told = compared["configurations"][side["name"]]["by_scenario"][scenario.name]
                    assert side["metrics"] == told


@pytest.mark.parametrize("error", [True, False])
async def test_the_suite_agrees_with_compare(compared, error):
    part = compared["configurations" if error else "without_localisation_error"]
    async with TestClient(TestServer(pages())) as client:
        for name, decision in CONFIGURATIONS.items():
            asked = msgspec.structs.replace(
                bench(perception={"localisation_error": error}), decision=decision
            )
            data = await ask(client, "suite", asked)
            told = dict(part[name])
            by_scenario = told.pop("by_scenario")
            assert data["after"]["totals"] == told
            for scenario, row in data["after"]["by_scenario"].items():
                row.pop("states")
                assert row == by_scenario[scenario]


@pytest.mark.parametrize("order", [0, 1, 2])
def test_latency_and_prediction_agree_with_the_sweep(work, suite, order):
    data = sweep(suite, BASE.decision, (198,)).data
    lists = data[("none", "first", "second")[order]]
    one = work.full_suite(bench(delay={"delay_ms": 198.0, "order": order}))
    figures = one.measure(BASE.decision).as_dict()
    assert {key: [figures[key]] for key in lists} == lists


@pytest.mark.parametrize(("recall", "mode"), [("size", "size"), ("kind", "flat")])
def test_trials_agree_with_monte_carlo(work, suite, recall, mode):
    asked = bench(
        perception={"recall": recall, "burst_frames": 5.0, "seed": 3, "trials": 2},
        delay={"delay_ms": 66.0, "order": 1},
    )
    plan = LossModel(RecallModel(mode), 5.0, ((2, 1),))
    found = simulate_suite_trials(sorted_suite(suite), plan, {"": BASE.decision}, range(2), 3)
    assert trial_summaries(work.full_suite(asked), asked) == {
        "trials": 2,
        **summarize_metrics(found[2, 1][""]),
    }


def test_a_fixed_share_of_everybody_is_seen(work):
    asked = bench("Bike Approaches Ped", perception={"recall": "fixed", "recall_value": 1.0})
    all_seen = work.shown_suite(asked)
    assert (
        all_seen.shown_detections[0].detected.tolist()
        == all_seen.perception_results[0].present.tolist()
    )
    half = work.shown_suite(
        bench("Bike Approaches Ped", perception={"recall": "fixed", "recall_value": 0.5})
    )
    share = half.shown_detections[0].detected.sum() / half.perception_results[0].present.sum()
    assert 0.4 < share < 0.6
    play = playback(half, 0, {"": BASE.decision})
    assert sum(play["agents"][0]["missed"]) > 50


@pytest.mark.parametrize("name", ["Swerving Cyclist", "Safe Crossing", "Multiple VRUs"])
@pytest.mark.parametrize("rule", ["selected", "ttc", "distance_only", "narrow"])
def test_sentences_and_states_are_the_pole_s_own(work, name, rule):
    decision = CONFIGURATIONS[rule]
    one = work.shown_suite(bench(name))
    play = playback(one, 0, {rule: decision})
    side = play["sides"][0]
    decider = Decider(rule_settings(decision))
    rows = one.rule_input.rows
    for frame in range(play["frames"]):
        at = rows.frame == frame
        told = decider.decide(
            frame / 30,
            rows.id[at],
            rows.kind[at],
            rows.xy_m[at],
            rows.velocity_mps[at],
            rows.counts[at],
        )
        assert side["sentence"][frame] == told.detail
        assert State(side["state"][frame]) is told.state
        chosen = side["chosen"][frame]
        pairs = side["pairs"]
        if told.held:
            continue  # the pair is that of an earlier frame
        if told.pair is None:
            assert chosen == -1
        else:
            assert pairs["start"][frame] <= chosen < pairs["start"][frame + 1]
            assert pairs["cyclist"][chosen] == told.pair.cyclist_id
            assert pairs["pedestrian"][chosen] == told.pair.pedestrian_id
            assert pairs["distance_m"][chosen] == pytest.approx(told.pair.distance_m, abs=6e-4)


def test_a_pair_fires_when_all_its_tests_pass(work):
    play = playback(work.shown_suite(bench("Multi-Speed Converging")), 0, {"": DecisionConfig()})
    pairs = play["sides"][0]["pairs"]
    bits = {test: 1 << i for i, test in enumerate(TESTS)}
    fired = 0
    for passes in pairs["passes"]:
        every = all(passes & bits[t] for t in TESTS if t != "fires")
        assert bool(passes & bits["fires"]) == every
        fired += every
    assert 0 < fired < len(pairs["passes"])


def test_a_second_camera_sees_what_the_first_cannot(work):
    asked = bench("Bike Approaches Ped", camera={"height_m": 2.0, "pitch_deg": -60.0})
    both = msgspec.structs.replace(asked, second_camera=Pose(x_m=5.0, y_m=13.0, heading_deg=270.0))
    one, two = work.shown_suite(asked), work.shown_suite(both)
    lossy = bench(base=both, scenario=both.scenario, perception={"recall": "size"})
    assert len(two.poses) == 2
    assert (work.shown_suite(lossy).observed[0].recall >= 0.5).all()
    assert not np.array_equal(one.observed[0].xy_m, two.observed[0].xy_m, equal_nan=True)


def test_the_camera_is_hung_as_the_command_line_hangs_it(work):
    from bikeped.config.build import ground_camera
    from bikeped.config.load import load_config

    by_hand = load_config(
        overrides=("camera.height_m=5.5", "camera.pitch_deg=-30", "camera.fov_deg=150")
    )
    asked = bench("", camera={"height_m": 5.5, "pitch_deg": -30.0, "fov_deg": 150.0})
    assert work.shown_suite(asked).camera == ground_camera(by_hand)


def test_coverage_is_the_ground_that_the_camera_projects(work):
    one = work.shown_suite(bench("", camera={"pitch_deg": -40.0, "fov_deg": 90.0}))
    told = coverage(one.camera, one.pose)
    far = np.asarray(told["far"], float).reshape(-1, 2)
    near = np.asarray(told["near"], float).reshape(-1, 2)
    some = ~np.isnan(far[:, 0])
    assert 5 < some.sum() < 60
    for edge in (near[some], far[some]):
        assert one.camera.project(one.pose.world_to_ground(edge))[1].all()
    middle = (near[some] + far[some]) / 2
    assert one.camera.project(one.pose.world_to_ground(middle))[1].all()


def test_own_scenarios_join_the_suite_or_take_a_place(work):
    joined = msgspec.structs.replace(BASE, scripts=(OWN,), scenario="My crossing")
    assert work.full_suite(joined).names[-1] == "My crossing"
    assert work.shown_suite(joined).names == ("My crossing",)
    instead = msgspec.structs.replace(
        BASE, scripts=(OWN.replace("My crossing", "Safe Crossing"),), scenario="Safe Crossing"
    )
    assert len(work.full_suite(instead).names) == len(SCENARIOS)
    assert len(work.shown_suite(instead).scenarios[0].agents) == 2


def test_what_was_kept_is_not_mistaken_for_something_else(work):
    """Asked in any order, a warm workbench answers as a fresh one."""
    asked = [
        BASE,
        bench(danger={"cpa_radius_m": 1.0}),
        bench(camera={"height_m": 6.0}),
        bench(perception={"localisation_error": False}),
        bench(perception={"recall": "size", "trial": 1}),
        bench(perception={"recall": "size", "trial": 2}),
        bench(delay={"delay_ms": 99.0}),
        bench(camera={"x_m": 0.0}),
    ]
    few = [s for s in SCENARIOS if s.name == "Swerving Cyclist"]

    def figures(workbench, one):
        suite = workbench.full_suite(one)
        tracks = hashlib.sha256(suite.rule_input.rows.xy_m.tobytes()).hexdigest()
        return tracks, suite.truths[0].danger.sum(), repr(suite.measure(one.decision).as_dict())

    fresh = [figures(BenchRunner(LOADED, few), one) for one in asked]
    warm = BenchRunner(LOADED, few)
    assert [figures(warm, one) for one in asked] == fresh
    assert [figures(warm, one) for one in reversed(asked)] == fresh[::-1]
    assert len(set(fresh)) == len(asked)


@pytest.mark.parametrize("scenarios", [SCENARIOS, load_scenarios(Path("street"))])
def test_the_editor_holds_all_of_a_scenario(scenarios):
    for scenario in scenarios:
        again = parse_scenario(json.dumps(script(scenario)), scenario.source)
        assert dump_scenario(again) == dump_scenario(scenario)
