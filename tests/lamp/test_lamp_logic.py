"""What the lamp shows, by heartbeats alone."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bikeped.lamp.colours import Colour
from bikeped.lamp.logic import (
    CONFLICT_S,
    GAP_S,
    REASSURING,
    RECOVER_S,
    SILENCE_S,
    Heartbeat,
    LampLogic,
    hold_s,
)


def beat(logic: LampLogic, now_s: float, colour: Colour = Colour.GREEN, hz: float = 0.0) -> None:
    logic.heartbeat(Heartbeat(now_s, colour, hz), now_s)


def steady(logic: LampLogic, from_s: float, to_s: float, colour: Colour = Colour.GREEN) -> float:
    now_s = from_s
    while now_s <= to_s:
        beat(logic, now_s, colour)
        now_s += 0.05
    return now_s


def test_fault_blinks_slowly_before_the_first_heartbeat() -> None:
    logic = LampLogic()
    shown = [logic.shows(t)[0] for t in (100.0, 100.9, 101.1, 101.9, 102.1)]
    assert shown == [Colour.ORANGE, Colour.ORANGE, Colour.OFF, Colour.OFF, Colour.ORANGE]
    assert logic.fault(100.0) == "no heartbeat"


def test_green_comes_only_after_a_second_of_heartbeats_and_red_at_once() -> None:
    logic = LampLogic()
    steady(logic, 10.0, 10.0 + RECOVER_S - 0.05)
    assert logic.shows(10.9)[0] is Colour.ORANGE
    steady(logic, 10.95, 11.2)
    assert logic.shows(11.2)[0] is Colour.GREEN
    fresh = LampLogic()
    beat(fresh, 10.0, Colour.RED, 2.0)
    assert fresh.shows(10.0)[0] is Colour.RED
    assert fresh.shows(10.26)[0] is Colour.OFF


def test_silence_is_fault_when_it_was_said_to_be() -> None:
    logic = LampLogic()
    last_s = steady(logic, 10.0, 12.0) - 0.05
    colour, due_s = logic.shows(last_s)
    assert (colour, due_s) == (Colour.GREEN, last_s + SILENCE_S)
    assert logic.shows(last_s + SILENCE_S)[0] is Colour.ORANGE
    assert logic.latched is None  # one silence is a restart


def test_off_needs_no_further_heartbeats() -> None:
    logic = LampLogic()
    beat(logic, 10.0, Colour.OFF)
    assert logic.shows(12.0)[0] is Colour.OFF
    assert logic.fault(1e6) is None
    beat(logic, 20.0)  # a service that is started later, however often, is no flicker
    assert not logic._gaps
    assert logic.shows(20.0)[0] is Colour.ORANGE


@pytest.mark.parametrize("on_s", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("off_s", [0.2, 0.3])
def test_heartbeats_that_come_and_go_latch_within_three_seconds(on_s: float, off_s: float) -> None:
    logic = LampLogic()
    now_s = steady(logic, 0.0, 5.0)
    began_s = now_s
    while logic.latched is None:
        now_s = steady(logic, now_s + off_s, now_s + off_s + on_s)
        assert now_s - began_s <= 3.0
    assert "flicker" in logic.latched
    now_s = steady(logic, now_s, now_s + 10.0)
    assert logic.shows(now_s)[0] in (Colour.ORANGE, Colour.OFF)
    logic.reset()
    now_s = steady(logic, now_s, now_s + RECOVER_S + 0.2)
    assert logic.shows(now_s)[0] is Colour.GREEN


def test_a_service_that_stutters_while_it_loads_is_no_flicker() -> None:
    logic = LampLogic()
    for step in range(50):
        beat(logic, step * 0.3, Colour.ORANGE, 0.5)
    assert logic.latched is None


def test_a_lamp_that_is_late_itself_sees_no_flicker() -> None:
    logic = LampLogic()
    now_s = steady(logic, 0.0, 2.0)
    for step in range(100):  # three heartbeats at a time, each 0.3 s
        for late_s in (0.2, 0.1, 0.0):
            at_s = now_s + step * 0.3
            logic.heartbeat(Heartbeat(at_s - late_s, Colour.GREEN, 0.0), at_s)
    assert logic.latched is None
    assert logic.shows(at_s)[0] is Colour.GREEN


def test_each_further_silence_holds_green_back_longer() -> None:
    logic = LampLogic()
    now_s = steady(logic, 0.0, 2.0)
    assert [hold_s(count) for count in range(5)] == [1.0, 3.0, 30.0, 300.0, 300.0]
    for silences in (1, 2, 3):
        began_s = now_s + 1.0
        now_s = steady(logic, began_s, began_s + hold_s(silences) - 0.2)
        assert logic.fault(now_s - 0.05) == "no blue or green yet: the service fell silent before"
        assert logic.shows(now_s - 0.05)[0] is not Colour.GREEN
        beat(logic, now_s, Colour.RED)  # warnings do not wait
        assert logic.shows(now_s)[0] is Colour.RED
        now_s = steady(logic, now_s + 0.05, now_s + 0.4)
        assert logic.shows(now_s - 0.05)[0] is Colour.GREEN


def test_old_silences_are_forgotten_and_a_reset_forgets_all() -> None:
    logic = LampLogic()
    steady(logic, 0.0, 2.0)
    steady(logic, 10.0, 40.0)
    now_s = steady(logic, 700.0, 702.0)
    assert logic.shows(now_s)[0] is not Colour.GREEN  # of this one silence, 3 s
    now_s = steady(logic, now_s, 703.2)
    assert logic.shows(now_s)[0] is Colour.GREEN
    steady(logic, 710.0, 712.0)
    logic.reset()
    now_s = steady(logic, 712.1, 713.3)
    assert logic.shows(now_s)[0] is Colour.GREEN


def test_a_crash_loop_shows_green_in_its_first_life_only() -> None:
    logic, now_s, green = LampLogic(), 0.0, 0
    for _ in range(10):  # lives of 2.5 s, and 5 s to start again
        end_s = now_s + 2.5
        while now_s < end_s:
            beat(logic, now_s)
            shown = logic.shows(now_s)[0]
            now_s += 0.05
        green += shown is Colour.GREEN
        now_s += 5.0
    assert green == 1


def test_jitter_is_no_flicker() -> None:
    logic = LampLogic()
    now_s = 0.0
    for step in range(2000):
        now_s += (0.1, 0.03, GAP_S - 0.001)[step % 3]
        beat(logic, now_s)
    assert logic.latched is None
    assert logic.shows(now_s)[0] is Colour.GREEN


def test_two_colours_latch_and_a_short_difference_does_not() -> None:
    logic = LampLogic()
    now_s = steady(logic, 0.0, 2.0)
    logic.readback("red and green", now_s)
    logic.readback(None, now_s + CONFLICT_S)
    logic.readback("red and green", now_s + 1.0)
    logic.readback("red and green", now_s + 1.0 + CONFLICT_S - 0.01)
    assert logic.latched is None
    logic.readback("red and green", now_s + 1.0 + CONFLICT_S + 0.01)
    assert logic.latched == "conflict: red and green"
    logic.readback(None, now_s + 5)
    beat(logic, now_s + 5, Colour.RED)
    assert logic.shows(now_s + 5)[0] in (Colour.ORANGE, Colour.OFF)


@pytest.mark.parametrize("sent_s", [9.0, 11.5, 12.1, -1.0])
def test_old_repeated_and_future_heartbeats_are_no_sign_of_life(sent_s: float) -> None:
    logic = LampLogic()
    last_s = steady(logic, 10.0, 11.96) - 0.05
    logic.heartbeat(Heartbeat(sent_s, Colour.BLUE, 0.0), 12.0)
    assert logic._heard_s == last_s
    assert logic.shows(12.0)[0] is Colour.GREEN


@given(
    st.one_of(
        st.none(),
        st.lists(st.integers()),
        st.dictionaries(st.text(), st.integers()),
        st.fixed_dictionaries(
            {
                "sent_s": st.one_of(st.floats(), st.just(10**400), st.text(), st.booleans()),
                "colour": st.one_of(st.text(), st.integers(), st.lists(st.integers())),
                "blink_hz": st.one_of(st.floats(), st.none()),
            }
        ),
    )
)
def test_what_is_no_heartbeat_is_refused(message: object) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - any of them
        Heartbeat.decode(message)


@given(st.floats(0, 1e9), st.sampled_from(Colour), st.floats(0, 10))
def test_heartbeats_survive_the_wire(sent_s: float, colour: Colour, blink_hz: float) -> None:
    one = Heartbeat(sent_s, colour, blink_hz)
    assert Heartbeat.decode(json.loads(one.encode())) == one


def test_a_malformed_heartbeat_is_fault_at_once() -> None:
    logic = LampLogic()
    now_s = steady(logic, 0.0, 2.0)
    logic.heartbeat(None, now_s)
    assert logic.shows(now_s)[0] is Colour.ORANGE


EVENTS = st.lists(
    st.tuples(
        st.floats(0.001, 0.8), st.sampled_from(["beat", "beat", "beat", "bad", "read", "reset"])
    ),
    max_size=120,
)


@given(EVENTS)
def test_green_only_while_the_service_says_so_afresh(events: list[tuple[float, str]]) -> None:
    logic, now_s, told_s, run_s = LampLogic(), 100.0, -1.0, None
    for wait_s, event in events:
        now_s += wait_s
        if now_s - told_s >= SILENCE_S:
            run_s = None
        if event == "beat":
            beat(logic, now_s)
            told_s, run_s = now_s, now_s if run_s is None else run_s
        elif event == "read":
            logic.readback("two", now_s)
        elif event == "bad":
            logic.heartbeat(None, now_s)
            run_s = None
        else:
            logic.reset()
            run_s = None
        for later_s in (now_s, now_s + 0.3, now_s + 0.6):
            colour, due_s = logic.shows(later_s)
            assert due_s > later_s
            fresh = later_s - told_s < SILENCE_S and run_s is not None
            proven = run_s is not None and later_s - run_s >= RECOVER_S - 1e-9
            if colour in REASSURING:
                assert fresh
                assert proven
                assert logic.latched is None
