"""What is shown of the raw states: 2 of 3 frames, held, at any frame rate."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.decision.shown import AS_RAW, ShownAlert, ShownSettings, shown_alert, shown_states
from bikeped.types import State

SETTINGS = ShownSettings()
FRAME_S = 1 / 30


def shown(raw, fps=30.0, how=SETTINGS):
    return shown_alert(np.arange(len(raw)) / fps, np.array(raw, bool), how).astype(int).tolist()


def test_one_frame_of_three_shows_nothing_and_two_do():
    assert shown([0, 1, 0, 0, 1, 0, 0]) == [0] * 7
    assert shown([0, 1, 0, 1])[-1] == 1
    assert shown([0, 1, 1])[-1] == 1


def test_an_alert_is_held_from_its_last_raw_frame_and_not_longer():
    states = shown([0, 1, 1] + [0] * 60)
    assert states == [0, 0] + [1] * 46 + [0] * 15


def test_a_single_raw_frame_renews_a_hold_but_begins_none():
    raw = [0, 1, 1] + [0] * 40 + [1] + [0] * 50 + [1] + [0] * 3
    states = shown(raw)
    assert states[2 : 44 + 45] == [1] * 87
    assert states[89:] == [0] * (len(raw) - 89)


@pytest.mark.parametrize("fps", [5, 9, 10, 15, 24, 60])
def test_other_frame_rates_show_alerts_as_long(fps):
    raw = [0] * 5 + [1] * 6 + [0] * 3 * fps
    states = shown(raw, fps)
    first = states.index(1)
    assert (first - 5) / fps <= 2 * FRAME_S + 1e-9  # no later than two nominal frames
    assert sum(states) == 11 - first + math.floor(1.5 * fps + 1e-6)


def test_no_hold_and_one_frame_is_the_raw_state():
    raw = np.random.default_rng(0).random(300) < 0.3
    assert (shown_alert(np.arange(300) / 30, raw, AS_RAW) == raw).all()


def test_scenes_are_independent():
    raw = np.array([0, 1, 1, 0, 0, 1, 0, 0], bool)
    times = np.r_[np.arange(4), np.arange(4)] / 30
    states = shown_alert(times, raw, SETTINGS, [0, 4])
    assert states.tolist() == [False, False, True, True, False, False, False, False]


def test_states():
    raw = np.array([State.IDLE, State.ALERT, State.ALERT, State.SAFE, State.SAFE], np.int8)
    on = np.array([False, False, True, True, False])
    expected = [State.IDLE, State.WARNING, State.ALERT, State.ALERT, State.SAFE]
    assert shown_states(raw, on).tolist() == [int(s) for s in expected]


def plain(times, raw, how):
    """The definition, from the whole history at each frame."""
    lit = []
    for now, t in enumerate(times):
        alerts = [i for i in range(now + 1) if raw[i]]
        held = lit[-1:] == [True] and any(t - times[i] <= how.hold_s + 1e-6 for i in alerts)
        held = held and t - max(times[i] for i in alerts if i < now or not raw[now]) <= (
            how.hold_s + 1e-6
        )
        window = [i for i in range(now + 1) if times[i] >= t - how.window_s]
        enough = sum(raw[i] for i in window) >= min(how.on_frames, len(window))
        lit.append(bool(held or (raw[now] and enough)))
    return lit


@settings(derandomize=True, deadline=None, max_examples=200)
@given(
    st.lists(
        st.tuples(st.sampled_from([1 / 60, 1 / 30, 0.1, 0.7, 2.0]), st.booleans()), max_size=40
    ),
    st.integers(1, 4),
    st.sampled_from([0.0, 0.5, 1.5]),
)
def test_as_defined(frames, on_frames, hold_s):
    times = np.cumsum([step for step, _ in frames])
    raw = np.array([alert for _, alert in frames], bool)
    how = ShownSettings(on_frames, 3.5 / 30, hold_s)
    assert shown_alert(times, raw, how).tolist() == plain(times, raw, how)


def test_frame_by_frame_is_the_same():
    raw = np.random.default_rng(1).random(500) < 0.1
    times = np.arange(500) / 30
    alert = ShownAlert(SETTINGS)
    assert [alert.update(t, r) for t, r in zip(times, raw, strict=True)] == shown_alert(
        times, raw, SETTINGS
    ).tolist()
