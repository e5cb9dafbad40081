"""TTC, PET, DRAC and real conflicts against the definitions, written out by brute force."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.encounters import (
    PairSamples,
    deceleration_needed,
    measure_encounters,
    pair_samples,
    time_to_collision,
)
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.truth import KIND_OF
from bikeped.types import Kind

BUNDLED = {s.name: s for s in load_scenarios(bundled_folder())}
QUICK = settings(derandomize=True, deadline=None, max_examples=60)
HZ = 10


def tracks(scenario, hz=HZ):
    """Times, positions and velocities [f, a, 2] of a scenario, and its pairs [p, 2]."""
    time_s = np.arange(int(scenario.duration_s * hz) + 1) / hz
    xy = np.stack([a.sample(time_s)[0] for a in scenario.agents], 1)
    later = np.stack([a.sample(time_s + 0.05)[0] for a in scenario.agents], 1)
    of_kind = {
        kind: [i for i, a in enumerate(scenario.agents) if KIND_OF[a.kind] is kind]
        for kind in (Kind.CYCLIST, Kind.PEDESTRIAN)
    }
    pairs = list(itertools.product(of_kind[Kind.CYCLIST], of_kind[Kind.PEDESTRIAN]))
    return time_s, xy, (later - xy) / 0.05, np.asarray(pairs, np.int64).reshape(-1, 2)


def brute_ttc(r, v):
    """Steps along the straight lines, 5 ms at a time, for 30 s."""
    if r @ v >= -1e-6:
        return math.inf
    t = np.arange(0, 30, 0.005)
    hit = np.hypot(r[0] + t * v[0], r[1] + t * v[1]) < 1.0
    return t[hit.argmax()] if hit.any() else math.inf


def brute(time_s, xy, velocity, cyclist, pedestrian):
    """One pair, sample by sample and moment by moment."""
    c, p = xy[:, cyclist], xy[:, pedestrian]
    vc, vp = velocity[:, cyclist], velocity[:, pedestrian]
    least, ttc, drac, pet, conflicts = math.inf, math.inf, 0.0, math.inf, []
    for i, t in enumerate(time_s):
        if not np.isnan(c[i]).any() and not np.isnan(p[i]).any():
            r, v = c[i] - p[i], vc[i] - vp[i]
            d = math.hypot(*r)
            least = min(least, d)
            now = brute_ttc(r, v)
            ttc = min(ttc, now)
            s = -(r @ v) / d
            if s > 0:
                drac = max(drac, s * s / (2 * max(d - 1, 0.1)))
            touch = d < 1 and math.hypot(*v) > 1.5
            if math.hypot(*vc[i]) > 1 and (now < 1.5 or touch):
                conflicts.append(t)
        for j, u in enumerate(time_s):
            if abs(t - u) > 5 + 1e-9 or not math.hypot(*vc[i]) > 1 or not math.hypot(*vp[j]) > 0.3:
                continue
            if math.hypot(*(c[i] - p[j])) < 0.75:
                pet = min(pet, abs(t - u))
                first = min(i, j)
                if abs(t - u) < 1.5 and not np.isnan(c[first] + p[first]).any():
                    conflicts.append(min(t, u))
    return least, ttc, pet, drac, min(conflicts, default=math.nan)


@pytest.mark.parametrize("name", sorted(BUNDLED))
def test_measures_are_the_definitions(name):
    time_s, xy, velocity, pairs = tracks(BUNDLED[name])
    found = measure_encounters(pair_samples(time_s, xy, velocity, pairs))
    expected = [brute(time_s, xy, velocity, *pair) for pair in pairs]
    for i, (least, ttc, pet, drac, conflict_s) in enumerate(expected):
        assert found.least_distance_m[i] == pytest.approx(least)
        assert found.ttc_s[i] == pytest.approx(ttc, abs=0.006)
        assert found.pet_s[i] == pytest.approx(pet)
        assert found.drac_mps2[i] == pytest.approx(drac)
        # The stepped TTC is up to 5 ms late: the next sample may be the first.
        assert found.conflict_s[i] == pytest.approx(conflict_s, abs=1 / HZ + 1e-9, nan_ok=True)
    assert len(found.pet_s) == len(pairs)


def test_the_suite_has_every_kind_of_conflict():
    """So that the comparison above compares something."""
    found = []
    for scenario in BUNDLED.values():
        time_s, xy, velocity, pairs = tracks(scenario)
        found.append(measure_encounters(pair_samples(time_s, xy, velocity, pairs)))
    joined = {k: np.concatenate([getattr(f, k) for f in found]) for k in vars(found[0])}
    assert (joined["pet_s"] < 1.5).sum() >= 5
    assert (joined["ttc_s"] < 1.5).sum() >= 5
    assert np.isnan(joined["conflict_s"]).sum() >= 5
    assert (joined["drac_mps2"] > 2).sum() >= 5


place = st.tuples(st.floats(-30, 30), st.floats(-30, 30))
pace = st.tuples(st.floats(-8, 8), st.floats(-8, 8))


@QUICK
@given(place, pace)
def test_ttc_is_the_first_moment_under_a_metre(r, v):
    r, v = np.array([r]), np.array([v])
    ttc = time_to_collision(r, v)[0]
    if np.isfinite(ttc):
        assert ttc >= 0
        assert np.hypot(*(r + v * ttc)[0]) <= 1 + 1e-6
        before = r + v * ttc * np.linspace(0, 0.999, 50)[:, None]
        assert ttc == 0 or np.hypot(*before.T).min() > 1 - 1e-6
    else:
        closing = (r * v).sum() < 0
        t = np.linspace(0, 60, 2000)[:, None]
        assert not closing or np.hypot(*(r + v * t).T).min() > 1 - 1e-3


@QUICK
@given(place, pace)
def test_drac_just_ends_the_closing_speed_in_the_gap(r, v):
    r, v = np.array([r]), np.array([v])
    drac = deceleration_needed(r, v)[0]
    d = float(np.hypot(*r[0]))
    closing = -(r * v).sum() / d if d > 1e-6 else 0.0
    if closing <= 1e-6 or d <= 1e-6:
        return
    assert closing**2 / (2 * drac) == pytest.approx(max(d - 1, 0.1))


@QUICK
@given(
    st.floats(-math.pi, math.pi), st.tuples(st.floats(-99, 99), st.floats(-99, 99)), st.floats(0, 9)
)
def test_measures_do_not_know_place_direction_or_clock(angle, shift, later):
    time_s, xy, velocity, pairs = tracks(BUNDLED["Swerving Cyclist"])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    one = measure_encounters(pair_samples(time_s, xy, velocity, pairs))
    moved = xy @ turn.T + np.array(shift)
    other = measure_encounters(pair_samples(time_s + later, moved, velocity @ turn.T, pairs))
    for name, values in vars(one).items():
        shifted = later if name == "conflict_s" else 0.0
        np.testing.assert_allclose(getattr(other, name), values + shifted, rtol=1e-6, atol=1e-6)


def test_pairs_do_not_know_one_another():
    time_s, xy, velocity, pairs = tracks(BUNDLED["Multiple VRUs"])
    together = measure_encounters(pair_samples(time_s, xy, velocity, pairs))
    for i in range(len(pairs)):
        alone = measure_encounters(pair_samples(time_s, xy, velocity, pairs[i : i + 1]))
        for name, values in vars(alone).items():
            np.testing.assert_array_equal(values, getattr(together, name)[i : i + 1])


@pytest.mark.parametrize("cyclist_first", [True, False])
def test_pet_of_two_who_are_never_there_together(cyclist_first):
    """One leaves the crossing point 2 s before the other reaches it."""
    t = np.arange(61) / 10
    ride = np.stack([5 * (t - 2), 0 * t], -1)
    walk = np.stack([0 * t, 1.5 * (t - 4)], -1)
    if not cyclist_first:
        ride, walk = ride - np.array([10, 0]), walk + np.array([0, 3])
    early, late = (ride, walk) if cyclist_first else (walk, ride)
    early[t > 2.5] = np.nan
    late[t < 3] = np.nan
    speed = [np.broadcast_to(v, ride.shape).copy() for v in ([5.0, 0], [0, 1.5])]
    samples = PairSamples(np.zeros(len(t), np.int64), t, ride, walk, *speed)
    found = measure_encounters(samples)
    # Within 0.75 m of one place: 0.1 or 0.5 s nearer in time than the two middles.
    assert 1.4 <= found.pet_s[0] <= 1.9
    assert found.least_distance_m[0] == math.inf
    assert measure_encounters(samples, window_s=1.0).pet_s[0] == math.inf


def test_a_standing_bicycle_is_no_conflict():
    t = np.arange(50) / 10
    stand = np.zeros((50, 2))
    walk = np.stack([1.4 * (t - 2.5), 0 * t], -1)
    speed = [np.broadcast_to(v, stand.shape).copy() for v in ([0.0, 0], [1.4, 0])]
    found = measure_encounters(PairSamples(np.zeros(50, np.int64), t, stand, walk, *speed))
    assert found.ttc_s[0] == 0
    assert math.isnan(found.conflict_s[0])


def test_no_pairs():
    nothing = pair_samples(
        np.arange(5.0), np.zeros((5, 2, 2)), np.zeros((5, 2, 2)), np.zeros((0, 2), int)
    )
    assert all(len(values) == 0 for values in vars(measure_encounters(nothing)).values())
