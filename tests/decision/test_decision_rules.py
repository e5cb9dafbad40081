"""The four rules by hand-made cases, each at its boundaries."""

from dataclasses import replace

import numpy as np
import pytest

from bikeped.decision.decider import Decider
from bikeped.decision.rules import RuleSettings, evaluate_rule
from bikeped.decision.shown import AS_RAW
from bikeped.decision.track_rows import TrackRows, pair_rows
from bikeped.types import State

PEDESTRIAN, CYCLIST, VEHICLE = 0, 1, 2
SELECTED = RuleSettings(shown=AS_RAW)
RULES = ("pairwise", "naive", "ttc", "distance")
#: Plain bounds for cases that are about something else.
PLAIN = replace(SELECTED, d_min_m=1.0, d_max_m=20.0, min_displacement_m=0.1, speed_adaptive=False)


def run(settings, frames):
    """Decisions of a Decider; `frames` are (time in s, {id: (kind, x, y)})."""
    decider = Decider(settings)
    return [step(decider, t, tracks) for t, tracks in frames]


def step(decider, t, tracks):
    ids = sorted(tracks)
    return decider.decide(
        t,
        np.array(ids, np.int64),
        np.array([tracks[i][0] for i in ids], np.int8),
        np.array([tracks[i][1:] for i in ids], np.float64).reshape(-1, 2),
    )


def pair(cyclist, pedestrian, frames, t0=0.0):
    """Frames at i / 30 of one cyclist (id 1) and one pedestrian (id 2) given as functions of t."""
    return [
        (t0 + i / 30, {1: (CYCLIST, *cyclist(i / 30)), 2: (PEDESTRIAN, *pedestrian(i / 30))})
        for i in range(frames)
    ]


def still(x, y):
    return lambda t: (x, y)


def last_state(settings, frames):
    return run(settings, frames)[-1].state


# ---- bounds


@pytest.mark.parametrize(
    ("distance", "fires"), [(1.899, False), (1.901, True), (24.799, True), (24.801, False)]
)
def test_bounds_of_the_selected_configuration(distance, fires):
    # The cyclist ends exactly `distance` from the pedestrian, after 0.4 m of approach; the
    # pedestrian at x = 5 and the cyclist beside it stay within 25 m of the camera.
    settings = replace(SELECTED, speed_adaptive=False)
    end = 5 / 30
    frames = pair(lambda t: (5.0, 12.4 - distance - 6 * (end - t)), still(5.0, 12.4), 6)
    assert last_state(settings, frames) is (State.ALERT if fires else State.WARNING)


@pytest.mark.parametrize("rule", RULES)
def test_bounds_are_inclusive(rule):
    settings = replace(PLAIN, rule=rule, d_min_m=2.0, d_max_m=8.0, ttc_s=60.0)
    for distance, fires in ((2.0, True), (8.0, True), (1.75, False), (8.25, False)):
        frames = [
            (0.0, {1: (CYCLIST, 3.0 + distance + 0.5, 0.0), 2: (PEDESTRIAN, 3.0, 0.0)}),
            (0.125, {1: (CYCLIST, 3.0 + distance, 0.0), 2: (PEDESTRIAN, 3.0, 0.0)}),
        ]
        assert last_state(settings, frames) is (State.ALERT if fires else State.WARNING)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("who", ["cyclist", "pedestrian"])
def test_both_must_be_within_25_m_of_the_camera(rule, who):
    settings = replace(PLAIN, rule=rule, ttc_s=60.0)
    for x, fires in ((25.0, True), (25.25, False)):
        far, near = x, x - 4.0
        c, p = (far, near) if who == "cyclist" else (near, far)
        way = 0.5 if c > p else -0.5
        frames = [
            (0.0, {1: (CYCLIST, c + way, 0.0), 2: (PEDESTRIAN, p, 0.0)}),
            (0.125, {1: (CYCLIST, c, 0.0), 2: (PEDESTRIAN, p, 0.0)}),
        ]
        assert last_state(settings, frames) is (State.ALERT if fires else State.WARNING)


def test_speed_raises_d_max_to_the_stopping_distance():
    # 8 m/s: 8 * 0.84 + 64 / 3.92 = 23.05 m.
    settings = replace(SELECTED, d_max_m=10.0)
    stop = 8 * 0.84 + 64 / (2 * 1.96)
    for distance, fires in ((stop - 0.01, True), (stop + 0.01, False)):
        frames = pair(lambda t, d=distance: (0.0, d - 12 - 8 * (t - 1 / 3)), still(0.0, -12.0), 11)
        decision = run(settings, frames)[-1]
        assert decision.state is (State.ALERT if fires else State.WARNING)
        assert decision.pair.d_max_m == pytest.approx(stop, abs=1e-6)
        assert decision.pair.speed_mps == pytest.approx(8.0)
        assert last_state(replace(settings, speed_adaptive=False), frames) is State.WARNING
    ebike = replace(settings, deceleration_mps2=6.0)
    stop = 8 * 0.84 + 64 / 12
    frames = pair(lambda t: (0.0, stop + 0.01 - 12 - 8 * (t - 1 / 3)), still(0.0, -12.0), 11)
    assert last_state(ebike, frames) is State.WARNING


def test_a_slow_cyclist_does_not_lower_d_max():
    frames = pair(lambda t: (0.0, 15.0 - 3.0 * t), still(0.0, -5.0), 6)
    assert run(SELECTED, frames)[-1].pair.d_max_m == 24.8
    assert last_state(SELECTED, frames) is State.ALERT


def test_speed_is_between_positions_four_frames_apart():
    # At rest, then 9 m/s for one frame: a quarter of it over four frames (definitions, section 8).
    ys = [0.0] * 6 + [0.3]
    frames = pair(lambda t: (0.0, ys[round(t * 30)]), still(5.0, 5.0), 7)
    assert run(SELECTED, frames)[-1].pair.speed_mps == pytest.approx(2.25)


# ---- displacement


@pytest.mark.parametrize("rule", ["pairwise", "naive"])
def test_the_cyclist_must_have_moved_more_than_the_threshold(rule):
    settings = replace(PLAIN, rule=rule, min_displacement_m=0.25, lookback_s=0.25)
    for way, fires in ((0.25, False), (0.375, True)):
        frames = [
            (0.0, {1: (CYCLIST, 8.0 + way, 0.0), 2: (PEDESTRIAN, 3.0, 0.0)}),
            (0.25, {1: (CYCLIST, 8.0, 0.0), 2: (PEDESTRIAN, 3.0, 0.0)}),
        ]
        assert last_state(settings, frames) is (State.ALERT if fires else State.WARNING)


def test_a_pedestrian_who_walks_into_a_standing_cyclist_is_not_an_alert():
    frames = pair(still(0.0, 5.0), lambda t: (0.0, 1.4 * t), 30)
    for rule in ("pairwise", "naive"):
        assert last_state(replace(SELECTED, rule=rule), frames) is State.WARNING


# ---- pairwise against naive


def test_parallel_paths_at_a_constant_gap_fool_the_naive_rule_only():
    # Both go north at 3 m/s, the cyclist 6 m behind: its old place is farther than its new one
    # from where the pedestrian is now, though the gap never changes.
    behind = pair(lambda t: (2.0, -8 + 3 * t), lambda t: (0.0, -2 + 3 * t), 60)
    ahead = pair(lambda t: (2.0, -2 + 3 * t), lambda t: (0.0, -8 + 3 * t), 60)
    for frames in (behind, ahead):
        states = {d.state for d in run(SELECTED, frames)}
        assert states == {State.WARNING}
    naive = replace(SELECTED, rule="naive")
    assert {d.state for d in run(naive, behind)[2:]} == {State.ALERT}
    assert {d.state for d in run(naive, ahead)} == {State.WARNING}


def test_rounding_does_not_look_like_closing():
    rng = np.random.default_rng(2)
    for _ in range(50):
        c, p = rng.uniform(-8, 8, 2), rng.uniform(-8, 8, 2)
        v = rng.uniform(-3, 3, 2) + np.array([4.0, 0.0])
        frames = pair(lambda t, c=c, v=v: c + v * t, lambda t, p=p, v=v: p + v * t, 20)
        assert {d.state for d in run(replace(SELECTED, d_min_m=0.0), frames)} == {State.WARNING}


def test_a_real_approach_fires_both_and_a_real_retreat_neither():
    towards = pair(lambda t: (0.0, 20 - 5 * t), still(1.0, 2.0), 60)
    away = pair(lambda t: (0.0, 6 + 5 * t), still(1.0, 2.0), 60)
    for rule in ("pairwise", "naive", "ttc"):
        settings = replace(SELECTED, rule=rule, ttc_s=10.0)
        assert {d.state for d in run(settings, towards)[1:]} == {State.ALERT}
        assert {d.state for d in run(settings, away)} == {State.WARNING}


@pytest.mark.parametrize("rule", ["pairwise", "ttc"])
def test_never_an_alert_while_a_pair_draws_apart(rule):
    rng = np.random.default_rng(11)
    settings = replace(SELECTED, rule=rule, d_min_m=0.0, min_displacement_m=0.0)
    for _ in range(60):
        p, c = rng.uniform(-8, 8, 2), rng.uniform(-8, 8, 2)
        vp, vc = rng.uniform(-2, 2, 2), rng.uniform(-8, 8, 2)
        if (c - p) @ (vc - vp) < 0:  # turn it round: from here on the distance only grows
            vp, vc = -vp, -vc
        frames = pair(lambda t, c=c, v=vc: c + v * t, lambda t, p=p, v=vp: p + v * t, 12)
        assert State.ALERT not in {d.state for d in run(settings, frames)}


def test_naive_does_not_fire_when_the_cyclist_leaves_a_standing_pedestrian():
    frames = pair(lambda t: (0.0, 4 + 4 * t), still(0.0, 0.0), 30)
    assert {d.state for d in run(replace(SELECTED, rule="naive"), frames)} == {State.WARNING}


# ---- ttc and distance


@pytest.mark.parametrize(("closing", "fires"), [(2.0, False), (1.9, False), (2.1, True)])
def test_ttc_is_less_than_three_seconds(closing, fires):
    settings = replace(PLAIN, rule="ttc", lookback_s=0.25)
    frames = [
        (0.0, {1: (CYCLIST, 7.0 + closing * 0.25, 0.0), 2: (PEDESTRIAN, 1.0, 0.0)}),
        (0.25, {1: (CYCLIST, 7.0, 0.0), 2: (PEDESTRIAN, 1.0, 0.0)}),
    ]
    assert last_state(settings, frames) is (State.ALERT if fires else State.WARNING)


@pytest.mark.parametrize(("closing", "fires"), [(0.09, False), (0.11, True)])
def test_ttc_needs_a_closing_speed_above_a_tenth(closing, fires):
    settings = replace(PLAIN, rule="ttc", lookback_s=0.25, ttc_s=60.0)
    frames = [
        (0.0, {1: (CYCLIST, 2.5 + closing * 0.25, 0.0), 2: (PEDESTRIAN, 1.0, 0.0)}),
        (0.25, {1: (CYCLIST, 2.5, 0.0), 2: (PEDESTRIAN, 1.0, 0.0)}),
    ]
    assert last_state(settings, frames) is (State.ALERT if fires else State.WARNING)


def test_distance_asks_for_the_bounds_only_and_for_no_history():
    frames = pair(still(0.0, 5.0), still(0.0, 0.0), 3)
    states = [d.state for d in run(replace(SELECTED, rule="distance"), frames)]
    assert states == [State.ALERT] * 3


# ---- looking back


def test_lookback_is_two_frames_even_when_a_frame_is_missing():
    # y of the cyclist at frame: 0, 1, (2 is missing), 3. Two frames before 3 is frame 1, exactly.
    frames = pair(lambda t: (0.0, 12 - 6 * t), still(0.0, 0.0), 4)
    numbers = run(SELECTED, [frames[0], frames[1], frames[3]])[-1].pair
    assert numbers.lookback_s == pytest.approx(2 / 30)
    assert numbers.displacement_m == pytest.approx(0.4)
    # Frames 1 and 2 missing: between frames 0 and 3, a third of the way, in both agents.
    frames = pair(lambda t: (0.0, 12 - 6 * t), lambda t: (0.0, 3 * t), 4)
    numbers = run(SELECTED, [frames[0], frames[3]])[-1].pair
    assert numbers.lookback_s == pytest.approx(2 / 30)
    assert numbers.displacement_m == pytest.approx(0.4)
    assert numbers.distance_then_m == pytest.approx(numbers.distance_m + 9 * 2 / 30)


@pytest.mark.parametrize("k", [1, 2, 3, 10])
def test_lookback_of_k_frames_at_every_clock(k):
    settings = replace(SELECTED, lookback_s=k / 30)
    for t0 in (0.0, 0.123456, 7.7, 86_400.0):
        frames = pair(lambda t: (0.0, 12 - 6 * t), still(0.0, 0.0), 16, t0)
        for i, decision in enumerate(run(settings, frames)):
            back = min(i, k)
            assert decision.pair.lookback_s == pytest.approx(back / 30, abs=1e-9)
            assert decision.pair.displacement_m == pytest.approx(0.2 * back, abs=1e-9)


def test_a_young_pair_is_judged_over_the_time_that_it_has():
    settings = replace(SELECTED, lookback_s=5 / 30, min_displacement_m=0.3)
    frames = pair(lambda t: (0.0, 12 - 6 * t), still(0.0, 0.0), 4)
    states = [d.state for d in run(settings, frames)]
    # 0.2 m after one frame, 0.4 m after two.
    assert states == [State.WARNING, State.WARNING, State.ALERT, State.ALERT]


def test_a_pair_is_as_old_as_its_younger_half():
    frames = pair(lambda t: (0.0, 12 - 6 * t), still(0.0, 0.0), 6)
    del frames[0][1][2], frames[1][1][2], frames[2][1][2]  # the pedestrian comes at frame 3
    decisions = run(replace(SELECTED, lookback_s=4 / 30), frames)
    assert [d.state for d in decisions[:4]] == [State.IDLE] * 3 + [State.WARNING]
    assert [d.pair.lookback_s for d in decisions[3:]] == pytest.approx([0, 1 / 30, 2 / 30])
    # but the cyclist's speed is its own, of its three steps so far, over four frames
    assert decisions[3].pair.speed_mps == pytest.approx(4.5)


def test_a_track_that_was_away_begins_anew():
    frames = pair(lambda t: (0.0, 12 - 6 * t), still(0.0, 0.0), 6)
    del frames[3][1][1]
    assert run(SELECTED, frames)[4].pair.lookback_s == 0


# ---- numpy level: nobody there


def test_no_rows_and_no_pairs():
    none = np.zeros(0, np.intp)
    rows = TrackRows(
        none,
        np.zeros(0),
        none,
        np.zeros(0, np.int8),
        np.zeros((0, 2)),
        np.zeros((0, 2)),
        np.zeros(0, np.bool_),
        none,
    )
    for rule in RULES:
        verdicts = evaluate_rule(rows, pair_rows(rows), replace(SELECTED, rule=rule))
        assert len(verdicts.fires) == 0
    one = TrackRows(
        np.zeros(1, np.intp), np.zeros(1), np.ones(1, np.intp), np.ones(1, np.int8),
        np.zeros((1, 2)), np.zeros((1, 2)), np.ones(1, np.bool_), np.full(1, -1),
    )  # fmt: skip
    assert len(pair_rows(one)) == 0


def test_vehicles_are_no_cyclists_and_no_pedestrians():
    frames = [
        (i / 30, {1: (VEHICLE, 0.0, 12 - 0.2 * i), 2: (PEDESTRIAN, 0.0, 0.0)}) for i in range(5)
    ]
    assert {d.state for d in run(SELECTED, frames)} == {State.SAFE}
    frames = [(i / 30, {1: (CYCLIST, 0.0, 12 - 0.2 * i), 2: (VEHICLE, 0.0, 0.0)}) for i in range(5)]
    assert {d.state for d in run(SELECTED, frames)} == {State.IDLE}


def test_many_at_once_the_first_pair_in_track_order_is_named():
    frames = [
        (
            i / 30,
            {
                1: (PEDESTRIAN, 0.0, 8.0),
                2: (PEDESTRIAN, 0.0, 0.0),
                3: (CYCLIST, 0.0, -14 + 0.2 * i),
                4: (CYCLIST, 0.0, 18 - 0.2 * i),
                5: (PEDESTRIAN, 9.0, 3.0),
            },
        )
        for i in range(4)
    ]
    decision = run(SELECTED, frames)[-1]
    assert decision.state is State.ALERT
    assert (decision.pair.cyclist_id, decision.pair.pedestrian_id) == (3, 1)
