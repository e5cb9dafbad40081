"""What must not change a decision: where the pole looks, when its clock began, who is first."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.lab.scenarios.scenario import SIZES_M, Agent, Scenario
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.lab.simulation.perception import SIMULATION_POSE
from bikeped.lab.simulation.simulate import (
    PAPER,
    DetectionSequence,
    build_rule_input,
    outcome,
    track,
)
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite
from bikeped.lab.simulation.truth import compute_ground_truth
from bikeped.types import State

ALERT = int(State.ALERT)
RULE = PAPER.rule(CONFIGURATIONS["selected"])
PAIRWISE = [n for n, c in CONFIGURATIONS.items() if c.rule == "pairwise"]
AT = np.array([SIMULATION_POSE.x_m, SIMULATION_POSE.y_m])
QUICK = settings(derandomize=True, deadline=None, max_examples=30)


def with_paths(scenario, change):
    agents = tuple(replace(a, path=change(a.path)) for a in scenario.agents)
    return replace(scenario, agents=agents)


def turned(scenario, angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    return with_paths(
        scenario, lambda path: np.column_stack([path[:, 0], (path[:, 1:] - AT) @ turn.T + AT])
    )


def mirrored(scenario):
    """East for west, about the camera."""
    return with_paths(
        scenario, lambda path: np.column_stack([path[:, 0], 2 * AT[0] - path[:, 1], path[:, 2]])
    )


def later(scenario, frames):
    return with_paths(scenario, lambda path: path + np.array([frames / 30, 0, 0]))


def lanes(scenarios):
    """Scenarios without localisation error in one tracker."""
    scenes = []
    for scenario in scenarios:
        t = scenario.frame_times()
        sampled = [a.sample(t) for a in scenario.agents]
        xy = np.stack([SIMULATION_POSE.world_to_ground(p) for p, _, _ in sampled], 1)
        there = np.stack([p for _, _, p in sampled], 1)
        codes = {"pedestrian": 0, "cyclist": 1}
        kind = np.array([codes.get(a.kind, 2) for a in scenario.agents], np.int8)
        scenes.append(DetectionSequence(xy, there, kind))
    return build_rule_input(track(scenes, PAPER), 0, RULE)


def decided(scenarios, configuration="selected"):
    run = lanes(scenarios)
    found = outcome(run, PAPER.rule(CONFIGURATIONS[configuration])).raw
    return [found[run.frame_slice(i)].tolist() for i in range(len(scenarios))]


@pytest.mark.parametrize("degrees", [37.0, 90.0, 180.0, -123.4])
def test_turning_the_street_about_the_camera_changes_nothing(suite, degrees):
    other = [turned(s, np.radians(degrees)) for s in suite.scenarios]
    assert decided(other) == decided(suite.scenarios)


def test_the_mirrored_street_is_as_dangerous_and_decided_alike(suite):
    other = [mirrored(s) for s in suite.scenarios]
    assert decided(other) == decided(suite.scenarios)
    for scenario, truth in zip(other, suite.truths, strict=True):
        assert compute_ground_truth(scenario).danger.tolist() == truth.danger.tolist()


@pytest.mark.parametrize("frames", [1, 17, 300])
def test_a_clock_that_began_earlier_shifts_states_and_truth(suite, frames):
    moved = Suite(tuple(later(s, frames) for s in suite.scenarios), suite.camera, suite.tracker)
    for error in (True, False):
        config = CONFIGURATIONS["selected"]
        before, after = suite.states(config, error), moved.states(config, error)
        for i in range(len(suite.scenarios)):
            own = before[suite.truth_frames.scenario == i].tolist()
            assert after[moved.truth_frames.scenario == i].tolist() == [0] * frames + own
    for early, late in zip(suite.truths, moved.truths, strict=True):
        assert late.danger[frames:].tolist() == early.danger.tolist()
        assert late.actionable[frames:].tolist() == early.actionable.tolist()
        assert not late.danger[:frames].any()


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_agents_in_a_file_changes_no_state(suite, seed):
    rng = np.random.default_rng(seed)
    shuffled = tuple(
        replace(s, agents=tuple(s.agents[i] for i in rng.permutation(len(s.agents))))
        for s in suite.scenarios
    )
    other = Suite(shuffled, suite.camera, suite.tracker)
    for config in CONFIGURATIONS.values():
        assert other.states(config).tolist() == suite.states(config).tolist()
    for a, b in zip(suite.truths, other.truths, strict=True):
        assert a.danger.tolist() == b.danger.tolist()
        # Which of two equal severities a frame takes does hang on it, and so do TTC and budget.
        np.testing.assert_allclose(a.severity, b.severity, atol=1e-12)


def test_the_order_of_scenarios_changes_no_state(suite):
    reverse = Suite(suite.scenarios[::-1], suite.camera, suite.tracker)
    config = CONFIGURATIONS["selected"]
    parts = [
        reverse.states(config)[reverse.truth_frames.scenario == i] for i in range(len(suite.names))
    ]
    assert np.concatenate(parts[::-1]).tolist() == suite.states(config).tolist()


@pytest.mark.parametrize("configuration", PAIRWISE)
def test_every_alert_has_a_pair_that_came_nearer(suite, configuration):
    """On true positions: some pair within the bounds is nearer than k frames ago."""
    config = CONFIGURATIONS[configuration]
    found = decided(suite.scenarios, configuration)
    for scenario, own in zip(suite.scenarios, found, strict=True):
        t = scenario.frame_times()
        place = {a.id: a.sample(t)[0] for a in scenario.agents}
        pairs = [
            np.hypot(*(place[c.id] - place[p.id]).T)
            for c in scenario.agents
            for p in scenario.agents
            if (c.kind, p.kind) == ("cyclist", "pedestrian")
        ]
        last = min(int(np.floor(a.end_s * 30)) for a in scenario.agents)  # nobody coasts before
        for f in [f for f in range(last) if own[f] == ALERT]:
            k = config.lookback_frames
            assert any(
                config.d_min_m <= d[f] and d[f] < max(d[max(f - j, 0)] for j in range(1, k + 1))
                for d in pairs
                if np.isfinite(d[f])
            )


def receding(px, py, bearing, gap, v_walker, faster, side):
    """A cyclist that rides away from a walker: ahead of them, same way or aslant, and faster."""
    u = np.array([np.cos(bearing), np.sin(bearing)])
    n = np.array([-u[1], u[0]])
    walker = np.array([px, py])
    rider = walker + gap * u + side * n
    ways = v_walker * u, (v_walker + faster) * u
    paths = [
        np.array([[0.0, *p], [3.0, *(p + 3.0 * way)]])
        for p, way in zip((walker, rider), ways, strict=True)
    ]
    return Scenario(
        "Away", "safe", "warning", "bicycle",
        (Agent(1, "pedestrian", paths[0], SIZES_M["pedestrian"]),
         Agent(2, "cyclist", paths[1], SIZES_M["cyclist"])),
    )  # fmt: skip


@QUICK
@given(
    st.tuples(
        st.floats(-8, 18),
        st.floats(-8, 8),
        st.floats(0, 6.3),
        st.floats(0.0, 12.0),
        st.floats(0.0, 2.0),
        st.floats(0.0, 8.0),
        st.floats(-5, 5),
    )
)
def test_a_pair_that_moves_apart_or_keeps_its_gap_never_alerts(drawn):
    away = receding(*drawn)
    for configuration in (*PAIRWISE, "ttc"):
        assert ALERT not in decided([away], configuration)[0]
    assert not compute_ground_truth(away).danger.any()


@QUICK
@given(st.integers(0, 23), st.floats(-3.2, 3.2), st.integers(0, 40))
def test_turned_and_later_at_once(suite, index, angle, frames):
    scenario = suite.scenarios[index]
    plain, moved = decided([scenario, later(turned(scenario, angle), frames)])
    assert moved == [0] * frames + plain


@QUICK
@given(
    st.floats(-50, 50), st.floats(-50, 50), st.floats(-360, 360), st.floats(-40, 40),
    st.floats(-40, 40),
)  # fmt: skip
def test_world_pose_round_trip_and_written_out(cx, cy, heading, x, y):
    pose = CameraPose(cx, cy, heading)
    ground = pose.world_to_ground([[x, y]])
    h = np.radians(heading)
    forward = (x - cx) * np.cos(h) + (y - cy) * np.sin(h)
    right = (x - cx) * np.sin(h) - (y - cy) * np.cos(h)
    np.testing.assert_allclose(ground[0], (forward, right), atol=1e-9)
    np.testing.assert_allclose(pose.ground_to_world(ground)[0], (x, y), atol=1e-9)


def test_the_simulations_camera_looks_north():
    pose = CameraPose(5.0, -13.0, 90.0)
    # North of the camera is forward; east of it is to its right.
    np.testing.assert_allclose(pose.world_to_ground([5.0, -3.0]), (10.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(pose.world_to_ground([8.0, -13.0]), (0.0, 3.0), atol=1e-12)
