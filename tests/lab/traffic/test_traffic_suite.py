"""Traffic goes the way of scenarios: same truth, tracks and rules; only the view limits it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from traffic_scenes import BUNDLED, write_traffic

from bikeped.config.build import rule_settings
from bikeped.config.load import load_config
from bikeped.lab.simulation.camera_pose import CameraPose, CameraView
from bikeped.lab.simulation.simulate import DetectionSequence, build_rule_input, outcome, track
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite
from bikeped.lab.traffic.readers import TrafficScene, read_scene, read_traffic
from bikeped.lab.traffic.result import with_alert_settings
from bikeped.lab.traffic.suite import VIEW_M, TrafficSuite
from bikeped.types import State

LOADED = load_config(Path(__file__).parents[3] / "config.yaml")
SELECTED = CONFIGURATIONS["selected"]
NAMES = tuple(sorted(BUNDLED))


@pytest.fixture(scope="module")
def traffic(tmp_path_factory):
    scenes = read_traffic(write_traffic(tmp_path_factory.mktemp("traffic"), NAMES))
    return TrafficSuite.load(scenes, LOADED, "none", 0)


@pytest.fixture(scope="module")
def scenarios():
    return Suite.load([BUNDLED[n] for n in NAMES], LOADED)


def test_truth_in_view_is_the_scenarios(traffic, scenarios):
    """Those of a pair that are both in view; the look-ahead ends where one leaves it."""
    danger = 0
    for i, truth in enumerate(scenarios.truths):
        scenario, view = scenarios.scenarios[i], CameraView(scenarios.pose, VIEW_M)
        if min(agent.start_s for agent in scenario.agents) > 0:
            continue  # its first moment is traffic's zero
        if scenario.vehicle != "bicycle" or any(
            not view.sees(agent.path[:, 1:]).all() for agent in scenario.agents
        ):
            continue
        other = traffic.truths[i]
        for name in ("danger", "actionable", "severity", "ttc_s", "nearest_m"):
            np.testing.assert_array_equal(getattr(truth, name), getattr(other, name))
        danger += truth.danger.sum()
    assert danger > 100


def test_out_of_view_there_is_no_danger(traffic):
    """The same street from a pole that looks away, and from one 60 m off."""
    for pose in (CameraPose(5, -13, 270), CameraPose(65, -13, 90)):
        scenes = tuple(replace(scene, pose=pose) for scene in traffic.scenes)
        away = replace(traffic, scenes=scenes)
        counted = [t.danger.sum() for t in away.truths]
        assert sum(counted) < 0.2 * sum(t.danger.sum() for t in traffic.truths)
        assert sum(len(c.time_s) for c in away.conflicts) < 3


def test_states_are_those_of_the_scenario_simulation(traffic):
    """Without noise: of true positions in view, with the configured tracker."""
    seen = traffic.perception_results
    sequences = [DetectionSequence(s.true_m, s.present, s.kind) for s in seen]
    history = track(sequences, traffic.tracker)
    expected = outcome(build_rule_input(history), rule_settings(SELECTED)).raw
    found = np.concatenate([light.raw for light in traffic.lights(SELECTED)])
    np.testing.assert_array_equal(found, expected)
    assert (found == int(State.ALERT)).any()


def test_foresight_shows_danger(traffic):
    for light in traffic.foresight(SELECTED):
        np.testing.assert_array_equal(light.raw == int(State.ALERT), light.truth.danger)


def test_noise_depends_on_the_seed_alone(traffic):
    lights = {}
    for noise in ("realistic", "bursts"):
        for seed in (0, 0, 1):
            other = traffic.with_noise(noise, seed)
            raw = np.concatenate([light.raw for light in other.lights(SELECTED)])
            lights.setdefault((noise, seed), []).append(raw)
    for same in (("realistic", 0), ("bursts", 0)):
        np.testing.assert_array_equal(*lights[same])
    distinct = {raw.tobytes() for found in lights.values() for raw in found}
    assert len(distinct) == 4


def test_window_and_hold_come_from_the_configuration():
    own = with_alert_settings(CONFIGURATIONS["narrow"], LOADED.config.decision)
    assert own.alert_hold_s == LOADED.config.decision.alert_hold_s
    assert own.d_max_m == CONFIGURATIONS["narrow"].d_max_m


@pytest.mark.parametrize(
    ("start_m", "speed_mps", "conflict_s", "in_view_s"),
    [
        # They close at speed + 1 m/s from start - 5 m: 1.5 s before they are 1 m apart.
        (23.0, 2.0, (18 - 1) / 3 - 1.5, (18 - 1) / 3 - 1.5),
        # This one comes into view, 25 m from the camera at the origin, only after (45 - 25) / 9 s.
        (45.0, 9.0, (40 - 1) / 10 - 1.5, (40 - 1) / 10 - 1.5 - 20 / 9),
    ],
)
def test_a_conflict_is_fair_when_the_pair_was_in_view(
    tmp_path, start_m, speed_mps, conflict_s, in_view_s
):
    """A cyclist rides at a walker, head on."""
    rows = ["time_s,id,kind,x_m,y_m"]
    for t in np.arange(60) / 10:
        rows.append(f"{t:.1f},4,pedestrian,0,{5 + t:.4f}")
        rows.append(f"{t:.1f},9,cyclist,0,{start_m - speed_mps * t:.4f}")
    (tmp_path / "a.csv").write_text("\n".join(rows))
    scene = TrafficScene(read_scene(tmp_path / "a.csv"), CameraPose(0, 0, 90))
    found = TrafficSuite.load([scene], LOADED, "none", 0).conflicts[0]
    assert found.time_s == pytest.approx([conflict_s], abs=0.05)
    assert found.in_view_s == pytest.approx([in_view_s], abs=0.08)
    assert found.fair.tolist() == [in_view_s > 2.2]
    assert found.ids.tolist() == [[2, 1]]
