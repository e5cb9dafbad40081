"""The 24 scenarios themselves: plausible, named as documented, with the dangers they promise."""

from dataclasses import replace

import numpy as np
import pytest

from bikeped.config.build import rule_settings
from bikeped.lab.scenarios.scenario import HAZARDS, SIZES_M, bundled_folder, load_scenarios
from bikeped.lab.simulation.perception import SIMULATION_POSE
from bikeped.lab.simulation.simulate import PAPER
from bikeped.lab.simulation.suite import CONFIGURATIONS, compare
from bikeped.types import State

SET = {
    "safe": {"Safe Crossing", "Parallel Paths", "Bikes Only"},
    "standard": {
        "Bike Approaches Ped",
        "Cross-Street Cyclist",
        "Overtake from Behind",
        "Stopped Pedestrian",
        "Speed Variant",
    },
    "high-speed": {"High-Speed Near Miss", "Fast Approach", "Accelerating E-Bike"},
    "accessibility": {"Wheelchair User", "Child Pedestrian"},
    "multi-agent": {"Multiple VRUs", "Multi-Speed Converging", "Dense Pedestrian Group"},
    "edge": {
        "Counter-Flow on Crosswalk",
        "Cyclist Abort",
        "Occluded Emergence",
        "E-Scooter",
        "Diagonal Jaywalker",
    },
    "non-linear": {"Swerving Cyclist", "Late Turn Toward Ped", "U-Turn Cyclist"},
}
IMMINENT_ONLY = {"Fast Approach", "Occluded Emergence"}
PAIRWISE = [name for name, config in CONFIGURATIONS.items() if config.rule == "pairwise"]
SCENARIOS = {s.name: s for s in load_scenarios(bundled_folder())}
STEP_S = 0.2


def speeds(agent):
    """Velocity over 0.2 s [n, 2] and acceleration between two such steps [m], on a fine grid."""
    t = np.arange(agent.start_s, agent.end_s - STEP_S, 1 / 60)
    velocity = (agent.sample(t + STEP_S)[0] - agent.sample(t)[0]) / STEP_S
    lag = round(60 * STEP_S)
    return np.hypot(*velocity.T), np.hypot(*(velocity[lag:] - velocity[:-lag]).T) / STEP_S


@pytest.fixture(scope="module")
def paper(suite):
    """The suite as the paper simulates it: the raw state, by its own tracker."""
    return replace(suite, tracker=PAPER)


def of(suite, name, values):
    return values[suite.truth_frames.scenario == suite.names.index(name)]


def alerts(suite, name, configuration, error=True):
    states = suite.states(CONFIGURATIONS[configuration], error)
    return of(suite, name, states) == int(State.ALERT)


def test_24_scenarios_named_as_documented(suite):
    assert len(suite.scenarios) == 24
    assert set(SET) == set(HAZARDS)
    assert {h: {s.name for s in suite.scenarios if s.hazard == h} for h in HAZARDS} == SET


def test_a_file_is_called_as_its_scenario():
    for path in bundled_folder().glob("*"):
        scenario = next(s for s in SCENARIOS.values() if s.source == str(path))
        assert path.name == scenario.name.lower().replace(" ", "-") + ".yaml"


def test_21_hold_danger_19_actionable(suite):
    truths = dict(zip(suite.names, suite.truths, strict=True))
    dangerous = {name for name, t in truths.items() if t.danger.any()}
    actionable = {name for name, t in truths.items() if t.actionable.any()}
    assert dangerous == set(truths) - SET["safe"]
    assert len(dangerous) == 21
    assert actionable == dangerous - IMMINENT_ONLY
    assert len(actionable) == 19


@pytest.mark.parametrize("name", SCENARIOS)
def test_movements_are_plausible(name):
    scenario = SCENARIOS[name]
    assert 6.0 <= scenario.duration_s <= 14.1
    assert len(scenario.story) > 60
    assert scenario.story.endswith(".")
    for agent in scenario.agents:
        speed, acceleration = speeds(agent)
        runs = name == "Parallel Paths"  # its pedestrian is a runner, the only one
        limit = {"pedestrian": 2.6 if runs else 2.0, "cyclist": 13.0}.get(agent.kind, 14.0)
        assert speed.max() <= limit
        bound = {"pedestrian": 4.0, "cyclist": 6.0}.get(agent.kind, 3.0)
        assert acceleration.size == 0 or acceleration.max() <= bound
        xy, _, there = agent.sample(scenario.frame_times())
        away = np.hypot(*SIMULATION_POSE.world_to_ground(xy[there]).T)
        assert (away <= 25.0).mean() > 0.9
        assert away.min() > 2.0


def test_those_on_small_wheels_and_short_legs_are_that_size_and_that_slow():
    for name, speed, limit in (("Wheelchair User", 0.6, 1.4), ("Child Pedestrian", 0.9, 1.2)):
        agent = next(a for a in SCENARIOS[name].agents if a.kind == "pedestrian")
        assert agent.size_m != SIZES_M["pedestrian"]
        assert agent.size_m[2] <= limit
        assert speeds(agent)[0] == pytest.approx(speed, abs=0.01)


def test_vehicles_and_speeds_that_names_promise():
    ebikes = {name for name, s in SCENARIOS.items() if s.vehicle == "ebike"}
    assert ebikes == SET["high-speed"] | {"E-Scooter"}
    rider = {n: next(a for a in s.agents if a.kind == "cyclist") for n, s in SCENARIOS.items()
             if n != "Safe Crossing"}  # fmt: skip
    assert speeds(rider["Fast Approach"])[0].min() > 40 / 3.6
    assert np.ptp(speeds(rider["Accelerating E-Bike"])[0]) > 4.0
    assert speeds(rider["Cyclist Abort"])[0][-1] == 0
    slow, fast = (speeds(a)[0].max() for a in SCENARIOS["Speed Variant"].agents[1:])
    assert fast > 2 * slow
    walker = SCENARIOS["Stopped Pedestrian"].agents[0]
    still = speeds(walker)[0] < 1e-9
    assert still.sum() / 60 == pytest.approx(4.0 - STEP_S, abs=0.1)


def test_occluded_emergence_appears_within_nine_metres(suite):
    truth = suite.truths[suite.names.index("Occluded Emergence")]
    assert truth.distance_m[np.isfinite(truth.distance_m)][0] < 9.0
    assert truth.danger[np.isfinite(truth.distance_m)][0]


@pytest.mark.parametrize("error", [True, False])
def test_parallel_paths_never_alert_under_the_pairwise_rule(paper, error):
    runner, rider = (a.path for a in SCENARIOS["Parallel Paths"].agents)
    assert np.ptp(runner[:, 1:] - rider[:, 1:], axis=0) == pytest.approx([0, 0], abs=1e-12)
    for configuration in PAIRWISE:
        assert not alerts(paper, "Parallel Paths", configuration, error).any()
    # And not for want of movement, or of a distance within the bounds: the naive rule alerts.
    assert alerts(paper, "Parallel Paths", "naive_closing", error).mean() > 0.85


@pytest.mark.parametrize("error", [True, False])
def test_swerving_cyclist_shows_an_onset_at_the_closest_approach(paper, error):
    alert = alerts(paper, "Swerving Cyclist", "selected", error)
    onset = np.nonzero(alert[1:] & ~alert[:-1])[0] + 1
    budget = of(paper, "Swerving Cyclist", paper.truth_frames.budget_s)[onset]
    assert budget.min() <= 0.1
    assert budget[0] > 2.0  # the straight approach is warned of in time


def test_nobody_but_the_swerving_cyclist_gets_less_than_an_attentive_walker_needs(paper):
    metrics = paper.measure(CONFIGURATIONS["selected"])
    short = metrics.by_scenario["min_warning_budget_s"] < 0.84
    assert {n for n, s in zip(paper.names, short, strict=True) if s} == {"Swerving Cyclist"}


def test_the_expected_state_dominates(suite):
    """All frames of a safe scenario; of the others those in danger."""
    states = suite.states(CONFIGURATIONS["selected"])
    for scenario, truth in zip(suite.scenarios, suite.truths, strict=True):
        own = of(suite, scenario.name, states)
        asked = own[truth.danger] if truth.danger.any() else own
        assert State(np.bincount(asked, minlength=4).argmax()).name.lower() == scenario.expected


def test_the_selected_configuration_may_be_deployed(suite):
    metrics = suite.measure(CONFIGURATIONS["selected"])
    assert metrics.sensitivity >= 0.90
    assert metrics.specificity >= 0.90
    assert metrics.mean_warning_budget_s > 1.87


def test_the_rules_differ_as_the_paper_says(suite):
    found = compare(suite)["configurations"]
    selected = found["selected"]
    assert set(found) == set(CONFIGURATIONS)
    assert found["naive_closing"].specificity < selected.specificity
    assert found["distance_only"].specificity == min(m.specificity for m in found.values())
    assert found["ttc"].specificity > selected.specificity
    assert found["ttc"].sensitivity < selected.sensitivity
    order = ["narrow", "conservative", "selected"]
    assert sorted(order, key=lambda n: found[n].sensitivity) == order


def test_rules_read_the_configurations_as_defined():
    selected = rule_settings(CONFIGURATIONS["selected"])
    assert (selected.memory_s, selected.lookback_s) == (58 / 30, 2 / 30)
    rows = {
        n: (c.memory_frames, c.d_min_m, c.d_max_m, c.min_displacement_m, c.lookback_frames,
            c.speed_adaptive, c.rule)
        for n, c in CONFIGURATIONS.items() if n != "predictive"
    }  # fmt: skip
    assert rows == {
        "selected": (58, 1.9, 24.8, 0.147, 2, True, "pairwise"),
        "conservative": (60, 1.5, 15, 0.05, 3, False, "pairwise"),
        "narrow": (0, 2.0, 10, 0.1, 3, False, "pairwise"),
        "speed_adaptive": (60, 1.0, 20, 0.05, 2, True, "pairwise"),
        "distance_only": (58, 1.9, 10, 0, 2, False, "distance"),
        "naive_closing": (58, 1.9, 24.8, 0.147, 2, True, "naive"),
        "ttc": (58, 1.9, 24.8, 0, 2, True, "ttc"),
    }
