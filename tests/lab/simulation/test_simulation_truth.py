"""Kinematic truth against definitions, section 5, written out once more: scalar, frame by frame."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bikeped.lab.scenarios.scenario import SIZES_M, Agent, Scenario, bundled_folder, load_scenarios
from bikeped.lab.simulation.truth import GroundTruthSettings, compute_ground_truth

INF = math.inf
BUNDLED = {s.name: s for s in load_scenarios(bundled_folder())}
PROFILES = {"bicycle": (0.84, 1.96), "ebike": (0.84, 6.0), "aashto": (2.5, 3.4)}
TINY = 1e-9


class Path:
    """Where an agent is at whole sixtieths of a second; None while it does not exist."""

    def __init__(self, agent):
        self.points = agent.path.tolist()
        self.known = {}

    def at(self, sixtieth):
        if sixtieth not in self.known:
            self.known[sixtieth] = self._find(sixtieth / 60)
        return self.known[sixtieth]

    def _find(self, t):
        first, last = self.points[0], self.points[-1]
        if t < first[0] - TINY or t > last[0] + TINY:
            return None
        for (t0, x0, y0), (t1, x1, y1) in zip(self.points, self.points[1:], strict=False):
            if t <= t1 or t1 == last[0]:
                part = min(max((t - t0) / (t1 - t0), 0.0), 1.0)
                return x0 + part * (x1 - x0), y0 + part * (y1 - y0)
        raise AssertionError


def distance(a, b, sixtieth):
    p, q = a.at(sixtieth), b.at(sixtieth)
    return None if p is None or q is None else math.hypot(p[0] - q[0], p[1] - q[1])


def speed(path, sixtieth):
    now, then = path.at(sixtieth), path.at(sixtieth + 3)
    if now is None or then is None:
        return 0.0
    return math.hypot(then[0] - now[0], then[1] - now[1]) / 0.05


def pair_frame(cyclist, pedestrian, now, profile, settings):
    """One pair at one moment: a dict of the definition's quantities, or None when ignored."""
    d = distance(cyclist, pedestrian, now)
    if d is None or d > 25:
        return None
    later = distance(cyclist, pedestrian, now + 3)
    closing = 0.0 if later is None else (d - later) / 0.05
    ahead = []
    for sample in range(100):  # t, t + 0.05, ... < t + 5
        value = distance(cyclist, pedestrian, now + 3 * sample)
        if value is None:
            break
        ahead.append(value)
    d_min = min(ahead)
    ttc = next((i * 0.05 for i, v in enumerate(ahead) if v < 1.0), INF)
    budget = next((i * 0.05 for i, v in enumerate(ahead) if v <= d_min + 0.05), INF)
    v = speed(cyclist, now)
    reaction, braking = PROFILES[profile]
    stopping = v * reaction + v * v / (2 * braking)
    walking = speed(pedestrian, now)
    clearance = 30.0 if walking < 0.1 else 2.0 / walking
    bound = 1.87 + clearance if settings.ttc_bound_s is None else settings.ttc_bound_s
    danger = (
        closing > 0.3
        and d_min < settings.cpa_radius_m
        and (stopping > settings.stopping_margin * max(d - 1.0, 0.0) or ttc < bound)
    )
    return {
        "danger": danger,
        "severity": min((v / 12) ** 2, 1.0),
        "ttc_s": ttc,
        "d_min_m": d_min,
        "budget_s": budget,
        "distance_m": d,
    }


NOTHING = {
    "danger": False,
    "severity": 0.0,
    "ttc_s": INF,
    "d_min_m": INF,
    "budget_s": INF,
    "distance_m": INF,
    "cyclist": -1,
    "pedestrian": -1,
}


def frames(scenario, settings=GroundTruthSettings()):  # noqa: B008
    profile = settings.braking or scenario.vehicle
    riders = [(a.id, Path(a)) for a in scenario.agents if a.kind in {"cyclist", "motorcycle"}]
    walkers = [(a.id, Path(a)) for a in scenario.agents if a.kind == "pedestrian"]
    end = max(a.path[-1, 0] for a in scenario.agents) + 0.5
    out, number = [], 0
    while number / 30 <= end + 1e-7:
        now = 2 * number
        chosen, nearest = None, INF
        for rider, rider_path in riders:
            for walker, walker_path in walkers:
                d = distance(rider_path, walker_path, now)
                nearest = min(nearest, INF if d is None else d)
                pair = pair_frame(rider_path, walker_path, now, profile, settings)
                if pair is None:
                    continue
                pair.update(cyclist=rider, pedestrian=walker)
                if chosen is None:
                    chosen = pair
                elif pair["danger"]:
                    severer = pair["severity"] > chosen["severity"] + TINY
                    chosen = pair if severer or not chosen["danger"] else chosen
                elif not chosen["danger"] and pair["d_min_m"] < chosen["d_min_m"] - TINY:
                    chosen = pair
        row = dict(chosen or NOTHING, nearest_m=nearest, time_s=number / 30)
        row["severity"] = row["severity"] if row["danger"] else 0.0
        row["actionable"] = row["danger"] and row["ttc_s"] >= 1.87
        row["imminent"] = row["danger"] and row["ttc_s"] < 1.87
        out.append(row)
        number += 1
    return out


def agree(scenario, settings=GroundTruthSettings()):  # noqa: B008
    truth, expected = compute_ground_truth(scenario, settings), frames(scenario, settings)
    assert len(truth.time_s) == len(expected)
    for key in ("danger", "actionable", "imminent", "cyclist", "pedestrian"):
        assert getattr(truth, key).tolist() == [row[key] for row in expected], key
    for key in ("time_s", "severity", "ttc_s", "d_min_m", "budget_s", "distance_m", "nearest_m"):
        expected_values = np.array([row[key] for row in expected])
        np.testing.assert_allclose(getattr(truth, key), expected_values, atol=1e-9, err_msg=key)
    return truth


def agent(number, kind, *path):
    return Agent(number, kind, np.array(path, np.float64), SIZES_M[kind])


def scene(*agents, vehicle="bicycle"):
    return Scenario("Made up", "edge", "alert", vehicle, agents)


@pytest.mark.parametrize("name", BUNDLED)
def test_every_frame_and_field_of_the_24(name):
    agree(BUNDLED[name])


@pytest.mark.parametrize(
    "settings",
    [
        GroundTruthSettings(cpa_radius_m=3.0),
        GroundTruthSettings(cpa_radius_m=7.0, stopping_margin=1.0),
        GroundTruthSettings(stopping_margin=0.6),
        GroundTruthSettings(ttc_bound_s=2.0),
        GroundTruthSettings(ttc_bound_s=4.0),
        GroundTruthSettings(braking="aashto"),
        GroundTruthSettings(braking="ebike"),
    ],
)
def test_free_thresholds_and_braking_profiles(settings):
    for name in ("Multi-Speed Converging", "Cyclist Abort", "Accelerating E-Bike"):
        agree(BUNDLED[name], settings)


def test_the_ebike_profile_is_the_files_and_shortens_the_danger():
    ride = BUNDLED["Overtake from Behind"]  # in danger by its stopping distance alone
    assert ride.vehicle == "bicycle"
    ebike = agree(replace(ride, vehicle="ebike")).danger.sum()
    assert 0 < ebike < agree(ride).danger.sum()


def test_two_equal_cyclists_tie_and_the_first_in_the_file_is_named():
    walker = agent(9, "pedestrian", [0, 0, -3], [6, 0, 3])
    left = agent(5, "cyclist", [0, -20, 0], [6, 22.3, 0])
    right = agent(4, "cyclist", [0, 20, 0], [6, -22.3, 0])
    for order in ((left, right, walker), (right, walker, left), (walker, left, right)):
        truth = agree(scene(*order))
        first = next(a.id for a in order if a.kind == "cyclist")
        assert truth.danger.any()
        assert set(truth.cyclist[truth.danger]) == {first}


def test_two_walkers_at_one_place_tie():
    a = agent(2, "pedestrian", [0, 0, 0], [5, 1, 0])
    b = agent(1, "pedestrian", [0, 0, 0], [5, 1, 0])
    truth = agree(scene(a, b, agent(3, "cyclist", [0, 12, 1], [5, -12, 1])))
    assert set(truth.pedestrian) == {2, -1}


def test_the_severer_danger_wins_over_the_nearer_one():
    walker = agent(1, "pedestrian", [0, 0, -2], [5, 0, 2])
    slow = agent(2, "cyclist", [0, 6, 0.0], [5, -6, 0.0])
    fast = agent(3, "cyclist", [0, -22, 0.5], [5, 22, 0.5])
    truth = agree(scene(walker, slow, fast))
    both = truth.danger & (truth.cyclist == 3)
    assert both.any()
    assert (truth.distance_m[both] > truth.nearest_m[both] + 1).any()


def test_agents_that_appear_and_end_on_the_way():
    walker = agent(1, "pedestrian", [0.55, 0, -2], [2.05, 0, 0])
    rider = agent(2, "cyclist", [0.25, -14, 0], [1.5, -6, 0.5], [4.1, 9, 0.5])
    truth = agree(scene(walker, rider))
    # The contact that would have come never does: the walker is gone.
    assert not np.isfinite(truth.ttc_s).any()
    gone = truth.time_s > 2.05 + 1e-6
    assert (truth.cyclist[gone] == -1).all()
    agree(scene(walker, rider, agent(7, "motorcycle", [1, 9, 1], [3, -9, 1]), vehicle="ebike"))


def test_a_pair_beyond_25_m_is_ignored_until_it_is_nearer():
    walker = agent(1, "pedestrian", [0, 0, 0], [8, 0, 0.01])
    truth = agree(scene(walker, agent(2, "cyclist", [0, 40, 0], [8, -16, 0])))
    ignored = truth.cyclist == -1
    assert ignored[0]
    assert (truth.nearest_m[ignored & np.isfinite(truth.nearest_m)] > 25).all()
    assert np.isinf(truth.distance_m[ignored]).all()


def test_who_stands_needs_thirty_seconds_and_counts_from_afar():
    standing = agent(1, "pedestrian", [0, 0, 0], [10, 0, 0])
    rider = agent(2, "cyclist", [0, 16.01, 0], [8, -2, 0])
    truth = agree(scene(standing, rider))
    walking = agree(scene(agent(1, "pedestrian", [0, 0, -9.3], [10, 0, 4]), rider))
    assert truth.danger.sum() > walking.danger.sum()


def test_no_pair_no_danger():
    truth = agree(scene(agent(1, "pedestrian", [0, 0, 0], [2, 1, 0])))
    assert not truth.danger.any()
    agree(
        scene(agent(1, "car", [0, 0, 0], [2, 1, 0]), agent(2, "pedestrian", [0, 1, 0], [2, 2, 0]))
    )
