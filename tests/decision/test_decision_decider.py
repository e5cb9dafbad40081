"""The decider over time: states, memory, sentences; all of it against a plain second writing."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.decision.decider import Decider
from bikeped.decision.rules import RuleSettings, evaluate_rule, is_remembered, resolve_state
from bikeped.decision.shown import AS_RAW
from bikeped.decision.track_rows import TrackRows, pair_rows
from bikeped.types import State

PEDESTRIAN, CYCLIST = 0, 1
SELECTED = RuleSettings(shown=AS_RAW)


def step(decider, t, tracks):
    ids = sorted(tracks)
    return decider.decide(
        t,
        np.array(ids, np.int64),
        np.array([tracks[i][0] for i in ids], np.int8),
        np.array([tracks[i][1:] for i in ids], np.float64).reshape(-1, 2),
    )


def run(rule, frames):
    decider = Decider(rule)
    return [step(decider, t, tracks) for t, tracks in frames]


# ---- states and memory


def test_the_four_states():
    walker, rider = (PEDESTRIAN, 0.0, 0.0), (CYCLIST, 0.0, 12.0)
    frames = [
        (0.0, {}),
        (1.0, {1: walker}),
        (2.0, {1: walker, 2: rider}),
        (2.05, {1: walker, 2: (CYCLIST, 0.0, 11.5)}),
        (3.0, {1: walker}),
        (3.5, {2: rider}),
    ]
    states = [d.state for d in run(SELECTED, frames)]
    assert states == [
        State.IDLE, State.SAFE, State.WARNING, State.ALERT, State.WARNING, State.IDLE,
    ]  # fmt: skip


@pytest.mark.parametrize(("memory", "warned"), [(0, 0), (1, 1), (58, 58)])
@pytest.mark.parametrize("first", [0, 1, 7, 100, 3601])
def test_a_cyclist_is_remembered_exactly_n_frames(memory, warned, first):
    decider = Decider(replace(SELECTED, memory_s=memory / 30))
    walker = {1: (PEDESTRIAN, 0.0, 0.0)}
    assert step(decider, first / 30, walker).state is State.SAFE
    there = step(decider, (first + 1) / 30, {**walker, 2: (CYCLIST, 0.0, 40.0)})
    assert there.state is State.WARNING  # any cyclist track counts, however far
    states = [step(decider, (first + 1 + i) / 30, walker).state for i in range(1, 62)]
    assert states == [State.WARNING] * warned + [State.SAFE] * (61 - warned)


def test_the_memory_is_in_seconds_whatever_the_frame_rate():
    for fps in (5, 15, 60):
        decider = Decider(replace(SELECTED, memory_s=1.0))
        step(decider, 0.0, {1: (PEDESTRIAN, 0.0, 0.0), 2: (CYCLIST, 0.0, 40.0)})
        states = [
            step(decider, i / fps, {1: (PEDESTRIAN, 0.0, 0.0)}).state for i in range(1, 2 * fps)
        ]
        assert states == [State.WARNING] * fps + [State.SAFE] * (fps - 1)


def test_a_cyclist_is_remembered_while_no_pedestrian_is_there():
    frames = [(0.0, {2: (CYCLIST, 0.0, 5.0)}), (1.0, {1: (PEDESTRIAN, 0.0, 0.0)})]
    assert [d.state for d in run(SELECTED, frames)] == [State.IDLE, State.WARNING]


def test_stages():
    flags = np.array([False, True])
    for ped in flags:
        for cyc in flags:
            for near in flags:
                (code,) = resolve_state(np.array([ped]), np.array([cyc]), np.array([near]))
                if not ped:
                    expected = State.IDLE
                elif not cyc:
                    expected = State.SAFE
                else:
                    expected = State.ALERT if near else State.WARNING
                assert code == expected
    assert is_remembered(np.array([1.0]), np.array([-math.inf]), 100.0).tolist() == [False]


def test_times_must_increase():
    decider = Decider(SELECTED)
    step(decider, 1.0, {})
    for again in (1.0, 0.5):
        with pytest.raises(ValueError, match="is not after the last frame's"):
            step(decider, again, {})


def test_only_a_moment_of_the_past_is_held():
    decider = Decider(SELECTED)
    for i in range(5000):
        step(decider, i / 30, {1: (PEDESTRIAN, 0.0, 0.0)})
    assert len(decider._buffer._rows) <= 17


def test_a_night_without_anybody_is_not_remembered():
    decider = Decider(SELECTED)
    for i in range(5000):
        step(decider, i / 30, {})
    assert len(decider._buffer._rows) == 0
    near = {1: (PEDESTRIAN, 8.0, 0.0), 2: (CYCLIST, 8.0, 9.0)}
    nearer = {1: (PEDESTRIAN, 8.0, 0.0), 2: (CYCLIST, 8.0, 8.8)}
    step(decider, 5000 / 30, near)
    assert step(decider, 5001 / 30, nearer).state is State.ALERT


# ---- sentences


def sentence_of(rule, frames):
    decision = run(rule, frames)[-1]
    assert "\n" not in decision.sentence
    assert decision.sentence.startswith(f"{decision.state.name}: ")
    assert decision.sentence.endswith(".")
    return decision


def ride(ys, walker=(0.0, 0.0)):
    return [(i / 30, {3: (PEDESTRIAN, *walker), 7: (CYCLIST, 0.0, y)}) for i, y in enumerate(ys)]


@pytest.mark.parametrize("rule", ["pairwise", "naive", "ttc"])
def test_an_alert_says_who_how_far_and_since_when(rule):
    decision = sentence_of(replace(SELECTED, rule=rule), ride([12.0, 11.8, 11.6, 11.4, 11.2]))
    assert decision.state is State.ALERT
    for part in (
        "cyclist 7", "pedestrian 3", "11.20 m", "11.60 m 0.07 s ago", "moved 0.40 m", "6.0 m/s",
        "1.9 to 24.8 m", f"rule {rule}",
    ):  # fmt: skip
        assert part in decision.detail
    assert decision.sentence == (
        "ALERT: a cyclist and a pedestrian are 11 m apart and closing; together in 1.7 s."
        if decision.pair.contact_s < 9
        else "ALERT: a cyclist and a pedestrian are 11 m apart and not closing."
    )


def test_other_states_say_why():
    alert = sentence_of(replace(SELECTED, rule="distance"), ride([5.0, 5.0]))
    assert "5.00 m apart, within 1.9 to 24.8 m (rule distance)" in alert.detail
    cases = [
        ([1.5, 1.0], {}, "1.00 m apart, nearer than the 1.9 m"),
        ([9.0, 9.0], {"d_max_m": 5.0}, "9.00 m apart, farther than 5.0 m"),
        ([5.0], {}, "just appeared"),
        ([24.9, 24.7], {"max_range_m": 20.0}, "more than 20 m from the camera"),
        ([9.0, 9.0, 9.1], {}, "9.10 m apart, were 9.00 m 0.07 s ago: not closing"),
        ([9.1, 9.1, 9.0], {}, "closing, but the cyclist moved only 0.10 m in 0.07 s"),
        ([9.1, 9.1, 9.0], {"rule": "ttc"}, "were 9.10 m 0.07 s ago: not soon together"),
    ]
    for ys, changes, part in cases:
        decision = sentence_of(
            replace(SELECTED, speed_adaptive=False, count_all=True, **changes), ride(ys)
        )
        assert decision.state is State.WARNING
        assert part in decision.detail
    gone = sentence_of(
        SELECTED, [*ride([9.0]), (1.5, {3: (PEDESTRIAN, 0, 0), 4: (PEDESTRIAN, 1, 0)})]
    )
    assert "2 pedestrians are tracked" in gone.detail
    assert "a cyclist was 1.5 s ago" in gone.detail
    assert gone.pair is None
    safe = sentence_of(SELECTED, [(0.0, {3: (PEDESTRIAN, 0.0, 0.0)})])
    assert "1 pedestrian is tracked" in safe.detail
    assert "last 1.9 s" in safe.detail
    assert sentence_of(SELECTED, [(0.0, {})]).detail == "IDLE: no pedestrian is tracked."


def test_a_warning_names_the_nearest_pair():
    frames = [
        (i / 30, {1: (CYCLIST, 0.0, 0.0), 2: (PEDESTRIAN, 9.0, 0.0), 5: (PEDESTRIAN, 4.0, 0.0)})
        for i in range(3)
    ]
    decision = run(SELECTED, frames)[-1]
    assert decision.state is State.WARNING
    assert decision.pair.pedestrian_id == 5


# ---- against a second, plain writing, and all frames at once

rules = st.builds(
    RuleSettings,
    rule=st.sampled_from(["pairwise", "naive", "ttc", "distance"]),
    memory_s=st.sampled_from([0.0, 0.1, 58 / 30]),
    d_min_m=st.sampled_from([0.0, 1.9]),
    d_max_m=st.sampled_from([4.0, 24.8]),
    min_displacement_m=st.sampled_from([0.0, 0.147]),
    lookback_s=st.sampled_from([1 / 30, 2 / 30, 7 / 30]),
    max_range_m=st.sampled_from([8.0, 25.0]),
    speed_adaptive=st.booleans(),
    shown=st.just(AS_RAW),
    count_all=st.just(True),
)


@st.composite
def sequences(draw):
    """Frames with gaps, of agents who come, go and wander."""
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    agents, count = draw(st.integers(0, 5)), draw(st.integers(1, 24))
    drop, away = draw(st.sampled_from([0.0, 0.3])), draw(st.sampled_from([0.0, 0.1]))
    jitter = draw(st.sampled_from([0.0, 0.02]))
    kinds = rng.integers(0, 3, agents)
    xy, v = rng.uniform(-9, 9, (agents, 2)), rng.uniform(-7, 7, (agents, 2))
    number, frames = 0, []
    ids = rng.permutation(agents) + 1
    for _ in range(count):
        number += 1 + int(rng.geometric(1 - drop)) - 1 if drop else 1
        t = number / 30 + jitter * rng.random()
        here = rng.random(agents) >= away
        at = xy + v * t + rng.normal(0, 0.02, xy.shape)
        frames.append(
            (t, {int(ids[a]): (int(kinds[a]), *at[a].tolist()) for a in range(agents) if here[a]})
        )
    return frames


def plain_states(rule, frames):
    """Definitions, section 8, as one would write it without arrays."""
    out, last_cyclist = [], -math.inf
    for i, (now, tracks) in enumerate(frames):
        cyclists = [n for n in sorted(tracks) if tracks[n][0] == CYCLIST]
        walkers = [n for n in sorted(tracks) if tracks[n][0] == PEDESTRIAN]
        if cyclists:
            last_cyclist = now
        fires = any(plain_fires(rule, frames, i, c, p) for c in cyclists for p in walkers)
        if not walkers:
            out.append(State.IDLE)
        elif now - last_cyclist > rule.memory_s + 1e-6:
            out.append(State.SAFE)
        else:
            out.append(State.ALERT if fires else State.WARNING)
    return out


def plain_fires(rule, frames, i, c, p):
    now, tracks = frames[i]
    cx, px = tracks[c][1:], tracks[p][1:]
    d = math.dist(cx, px)
    j = i
    while j > 0 and c in frames[j - 1][1] and frames[j][0] > now - rule.speed_window_s + 1e-6:
        j -= 1
    speed = math.dist(cx, frames[j][1][c][1:]) / (now - frames[j][0]) if j < i else 0.0
    d_max = rule.d_max_m
    if rule.speed_adaptive:
        stop = speed * rule.reaction_s + speed**2 / (2 * rule.deceleration_mps2)
        d_max = max(d_max, stop)
    if not rule.d_min_m <= d <= d_max or max(math.hypot(*cx), math.hypot(*px)) > rule.max_range_m:
        return False
    target = now - rule.lookback_s
    j = i
    while j > 0 and {c, p} <= set(frames[j - 1][1]) and frames[j][0] > target + 1e-6:
        j -= 1
    if rule.rule == "distance":
        return True
    if j == i:
        return False
    then, (c_old, p_old) = frames[j][0], (frames[j][1][c][1:], frames[j][1][p][1:])
    if target - then > 1e-6:
        part = (target - then) / (frames[j + 1][0] - then)
        c_old, p_old = (
            [a + part * (b - a) for a, b in zip(old, frames[j + 1][1][n][1:], strict=True)]
            for n, old in ((c, c_old), (p, p_old))
        )
        then = target
    moved, before = math.dist(cx, c_old), math.dist(c_old, p_old)
    if rule.rule == "pairwise":
        return d < before - 1e-9 and moved > rule.min_displacement_m
    if rule.rule == "naive":
        return d < math.dist(c_old, px) - 1e-9 and moved > rule.min_displacement_m
    if rule.rule == "ttc":
        closing = (before - d) / (now - then)
        return closing > 0.1 and d / closing < rule.ttc_s
    return True


def rows_of(frames):
    """All frames as rows."""
    frame, time_s, number, kind, xy, previous = [], [], [], [], [], []
    before = {}
    for f, (t, tracks) in enumerate(frames):
        here = {}
        for n in sorted(tracks):
            here[n] = len(frame)
            previous.append(before.get(n, -1))
            frame.append(f)
            time_s.append(t)
            number.append(n)
            kind.append(tracks[n][0])
            xy.append(tracks[n][1:])
        before = here
    return TrackRows(
        np.array(frame, np.intp),
        np.array(time_s, np.float64),
        np.array(number, np.int64),
        np.array(kind, np.int8),
        np.array(xy, np.float64).reshape(-1, 2),
        np.zeros((len(xy), 2)),
        np.ones(len(xy), np.bool_),
        np.array(previous, np.intp),
    )


def states_at_once(rule, frames):
    rows, count = rows_of(frames), len(frames)
    pairs = pair_rows(rows)
    fires = evaluate_rule(rows, pairs, rule).fires
    times = np.array([t for t, _ in frames])
    cyclist = np.bincount(rows.frame[rows.kind == CYCLIST], minlength=count) > 0
    last = np.maximum.accumulate(np.where(cyclist, times, -np.inf))
    return resolve_state(
        np.bincount(rows.frame[rows.kind == PEDESTRIAN], minlength=count) > 0,
        is_remembered(times, last, rule.memory_s),
        np.bincount(rows.frame[pairs.pedestrian_row[fires]], minlength=count) > 0,
    ).tolist()


@settings(derandomize=True, deadline=None, max_examples=250)
@given(rules, sequences())
def test_frame_by_frame_equals_all_at_once_equals_the_plain_writing(rule, frames):
    states = [d.state for d in run(rule, frames)]
    assert states == states_at_once(rule, frames)
    assert states == plain_states(rule, frames)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(rules, sequences())
def test_the_numbers_are_the_same_too(rule, frames):
    rows = rows_of(frames)
    pairs = pair_rows(rows)
    verdicts = evaluate_rule(rows, pairs, rule)
    frame = rows.frame[pairs.pedestrian_row]
    for f, decision in enumerate(run(rule, frames)):
        if decision.pair is None:
            continue
        mine = np.nonzero(frame == f)[0]
        alert = decision.state is State.ALERT
        pick = mine[
            int(np.argmax(verdicts.fires[mine]))
            if alert
            else int(np.argmin(verdicts.distance_m[mine]))
        ]
        assert decision.pair.cyclist_id == rows.id[pairs.cyclist_row[pairs.cyclist[pick]]]
        assert decision.pair.pedestrian_id == rows.id[pairs.pedestrian_row[pick]]
        for name in ("distance_m", "distance_then_m", "lookback_s", "displacement_m", "speed_mps",
                     "d_max_m"):  # fmt: skip
            assert getattr(decision.pair, name) == getattr(verdicts, name)[pick]


@settings(derandomize=True, deadline=None, max_examples=80)
@given(rules, sequences(), st.floats(-math.pi, math.pi), st.booleans())
def test_the_camera_may_be_turned_and_mirrored(rule, frames, angle, mirrored):
    c, s = math.cos(angle), math.sin(angle)
    flip = -1 if mirrored else 1
    turned = [
        (t, {n: (k, c * x - s * y, flip * (s * x + c * y)) for n, (k, x, y) in tracks.items()})
        for t, tracks in frames
    ]
    assert [d.state for d in run(rule, turned)] == [d.state for d in run(rule, frames)]


@settings(derandomize=True, deadline=None, max_examples=80)
@given(rules, sequences(), st.integers(0, 10**6))
def test_the_clock_may_start_anywhere(rule, frames, offset):
    later = [(t + offset / 30, tracks) for t, tracks in frames]
    assert [d.state for d in run(rule, later)] == [d.state for d in run(rule, frames)]


@settings(derandomize=True, deadline=None, max_examples=80)
@given(rules, sequences(), st.randoms(use_true_random=False))
def test_the_order_of_agents_does_not_matter(rule, frames, random):
    numbers = sorted({n for _, tracks in frames for n in tracks})
    shuffled = list(numbers)
    random.shuffle(shuffled)
    renamed = dict(zip(numbers, shuffled, strict=True))
    other = [(t, {renamed[n]: v for n, v in tracks.items()}) for t, tracks in frames]
    assert [d.state for d in run(rule, other)] == [d.state for d in run(rule, frames)]
