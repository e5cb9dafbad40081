"""Signals: the table of states, the hold of ALERT, and what it takes to leave FAULT."""

from __future__ import annotations

import copy
import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.config.output_sections import FeedbackConfig
from bikeped.faults import Fault
from bikeped.feedback.signal_logic import FRESH_S, OFF, STARTING, SignalLogic, fault_signal
from bikeped.types import Colour, Signal, Sound, State

FRAME_S = 1 / 30
CAMERA = (Fault("camera", "camera.no_frame", "no frame for more than 0.5 s"),)
BLIND = (Fault("detector", "detector.blind", "the check picture's bicycle is not found"),)


def recovered(**timings: float) -> tuple[SignalLogic, float]:
    """Logic that has left FAULT showing IDLE, and the time."""
    logic = SignalLogic(**{"recover_frames": 5, **timings})  # type: ignore[arg-type]
    now_s = 100.0
    for _ in range(5):
        signal = logic.next_signal(now_s, State.IDLE)
        now_s += FRAME_S
    assert signal.name == "IDLE"
    return logic, now_s


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (State.IDLE, Signal("IDLE", Colour.BLUE)),
        (State.SAFE, Signal("SAFE", Colour.GREEN, sound=Sound.CHIME)),
        (State.WARNING, Signal("WARNING", Colour.ORANGE)),
        (State.ALERT, Signal("ALERT", Colour.RED, 2.0, Sound.BELL)),
    ],
)
def test_each_state_shows_as_in_the_papers_table(state: State, expected: Signal) -> None:
    logic, now_s = recovered()
    assert logic.next_signal(now_s, state) == expected


def test_off_is_dark_and_silent() -> None:
    assert Signal("OFF", Colour.OFF) == OFF


def test_configuration_sets_the_timings() -> None:
    config = FeedbackConfig(blink_hz=3.0, fault_blink_hz=0.25, recover_frames=1)
    logic = SignalLogic.from_config(config)
    assert logic.next_signal(0.0, None) == Signal("FAULT", Colour.ORANGE, 0.25, faults=(STARTING,))
    assert logic.next_signal(0.1, State.ALERT) == Signal("ALERT", Colour.RED, 3.0, Sound.BELL)
    assert logic.next_signal(0.2, State.IDLE).name == "IDLE"


def test_chime_sounds_once_when_safe_begins() -> None:
    logic, now_s = recovered()
    states = [State.SAFE, State.SAFE, State.IDLE, State.SAFE, State.SAFE]
    sounds = [logic.next_signal(now_s + i * FRAME_S, state).sound for i, state in enumerate(states)]
    assert sounds == [Sound.CHIME, Sound.NONE, Sound.NONE, Sound.CHIME, Sound.NONE]


def test_a_tick_without_a_decision_keeps_the_state() -> None:
    logic, now_s = recovered()
    logic.next_signal(now_s, State.WARNING)
    assert logic.next_signal(now_s + 0.3, None).name == "WARNING"


def test_an_alert_gives_way_with_the_decision() -> None:
    logic, now_s = recovered()
    logic.next_signal(now_s, State.ALERT)
    assert logic.next_signal(now_s + FRAME_S, State.ALERT, held=True).name == "ALERT"
    assert logic.next_signal(now_s + 2 * FRAME_S, State.IDLE).name == "IDLE"


def test_a_clock_that_steps_back_does_not_prolong_an_alert() -> None:
    logic, now_s = recovered()
    logic.next_signal(now_s, State.ALERT)
    assert logic.next_signal(now_s - 50, None, CAMERA).name == "FAULT"


def test_starts_in_fault_and_needs_good_frames_in_a_row() -> None:
    logic = SignalLogic(recover_frames=3)
    names = [
        logic.next_signal(0.0, None),
        logic.next_signal(0.1, State.IDLE),
        logic.next_signal(0.2, State.IDLE),
        logic.next_signal(0.3, None),  # a tick is no evidence, and does not undo any
        logic.next_signal(0.4, State.SAFE),
    ]
    assert [signal.name for signal in names] == ["FAULT"] * 4 + ["SAFE"]
    assert names[0].faults == (STARTING,)


def test_a_fault_shows_at_once_and_counting_starts_again() -> None:
    logic, now_s = recovered()
    fault = logic.next_signal(now_s, None, CAMERA)
    assert fault == Signal("FAULT", Colour.ORANGE, 0.5, faults=CAMERA)
    good = [logic.next_signal(now_s + i * FRAME_S, State.IDLE) for i in range(1, 5)]
    assert {signal.name for signal in good} == {"FAULT"}
    assert good[0].faults == (Fault("recovering", "service.recovering", str(CAMERA[0])),)
    logic.next_signal(now_s + 0.2, None, CAMERA)
    later = [logic.next_signal(now_s + 1 + i * FRAME_S, State.IDLE).name for i in range(5)]
    assert later == ["FAULT"] * 4 + ["IDLE"]


def test_the_state_before_a_fault_is_forgotten() -> None:
    logic, now_s = recovered(recover_frames=1)
    logic.next_signal(now_s, State.SAFE)
    logic.next_signal(now_s + 0.1, None, CAMERA)
    assert logic.next_signal(now_s + 0.2, None).name == "FAULT"


def test_a_withheld_decision_shows_fault_only_for_blue_and_green() -> None:
    logic, now_s = recovered()
    shown = [logic.next_signal(now_s + i, state, BLIND) for i, state in enumerate(State)]
    assert {state.name: signal.name for state, signal in zip(State, shown, strict=True)} == {
        "IDLE": "FAULT",
        "SAFE": "FAULT",
        "WARNING": "WARNING",
        "ALERT": "ALERT",
    }
    assert all(signal.faults == BLIND for signal in shown)
    # It costs no good frames: green is back with the first frame after it.
    assert logic.next_signal(now_s + 9, State.SAFE).name == "SAFE"


def test_a_fault_ends_a_hold_for_good() -> None:
    logic, now_s = recovered()
    logic.next_signal(now_s, State.ALERT)
    logic.next_signal(now_s + 0.1, State.ALERT, held=True)
    during = logic.next_signal(now_s + 0.15, State.ALERT, CAMERA, held=True)
    assert (during.name, during.faults) == ("ALERT", CAMERA)  # of two frames ago: still fresh
    assert logic.next_signal(now_s + 0.3, State.ALERT, CAMERA, held=True).name == "FAULT"
    later = [
        logic.next_signal(now_s + 0.4 + i * FRAME_S, State.ALERT, held=True).name for i in range(6)
    ]
    assert later == ["FAULT"] * 4 + ["WARNING"] * 2


def test_a_fresh_alert_shows_during_recovery_and_falls_back_to_fault() -> None:
    logic = SignalLogic(recover_frames=50)
    assert logic.next_signal(0.0, State.ALERT).name == "ALERT"
    assert logic.next_signal(0.1, State.ALERT, held=True).name == "ALERT"
    assert logic.next_signal(1.0, State.WARNING).name == "FAULT"


def test_a_fresh_alert_shows_beside_a_fault_but_is_no_good_frame() -> None:
    logic = SignalLogic(recover_frames=1)
    assert logic.next_signal(0.0, State.ALERT, CAMERA).name == "ALERT"
    assert logic.next_signal(0.1, None, CAMERA).name == "ALERT"  # a tick before the next frame
    assert logic.next_signal(0.6, None).name == "FAULT"


@given(
    steps=st.lists(
        st.tuples(st.floats(0, 0.4), st.none() | st.sampled_from(State), st.booleans()), max_size=60
    ),
    recover=st.integers(1, 6),
)
@settings(deadline=None)
def test_reassuring_colours_need_fresh_evidence(
    steps: list[tuple[float, State | None, bool]], recover: int
) -> None:
    logic = SignalLogic(recover_frames=recover)
    now_s, good = 0.0, 0
    for pause_s, state, faulty in steps:
        now_s += pause_s
        signal = logic.next_signal(now_s, state, CAMERA if faulty else ())
        good = 0 if faulty else good + (state is not None)
        if signal.name in ("IDLE", "SAFE", "WARNING"):
            assert not faulty
            assert good >= recover
            assert signal.blink_hz == 0
        if signal.name == "FAULT":
            assert (signal.colour, signal.sound) == (Colour.ORANGE, Sound.NONE)
            assert signal.blink_hz > 0
            assert signal.faults
        if state is State.ALERT:
            assert signal.name == "ALERT"


@pytest.mark.parametrize("blink_hz", [0.0, -1.0, math.nan])
def test_fault_and_alert_refuse_to_be_steady(blink_hz: float) -> None:
    with pytest.raises(ValueError, match="must blink"):
        fault_signal((), blink_hz)
    with pytest.raises(ValueError, match="must blink"):
        SignalLogic(blink_hz=blink_hz)


Call = tuple[float, "State | None", bool, "tuple[Fault, ...]"]


def expected(calls: list[Call], recover_frames: int) -> str:
    """What must show after all calls: the rules, not the way they are coded."""
    shown, good, alert_s = "FAULT", [], -math.inf
    for now_s, state, held, faults in calls:
        stopped = CAMERA[0] in faults
        if state is State.ALERT and not held:
            alert_s = now_s
        elif state not in (None, State.ALERT) and not stopped:
            alert_s = -math.inf
        if stopped:
            good = []
        elif state is not None:
            good.append(State.WARNING if held and shown != "ALERT" else state)
        sure = len(good) >= recover_frames
        alert = good[-1:] == [State.ALERT] and (sure or shown == "ALERT")
        if alert or now_s - alert_s <= FRESH_S:
            shown = "ALERT"
        elif not sure or (faults and good[-1] in (State.IDLE, State.SAFE)):
            shown = "FAULT"
        else:
            shown = good[-1].name
    return shown


def test_all_states_and_inputs() -> None:
    """Every input in every state of the machine: four states, a held one and a tick; no fault, one
    that stops, one that withholds, both; while an ALERT is fresh and after it."""
    recover, reached, walked = 2, set(), set()
    causes = ((), CAMERA, BLIND, CAMERA + BLIND)
    decided = [(None, False), (State.ALERT, True), *((state, False) for state in State)]
    inputs = list(itertools.product(decided, causes, (0.1, 0.4)))
    colours = {
        "IDLE": Colour.BLUE,
        "SAFE": Colour.GREEN,
        "WARNING": Colour.ORANGE,
        "ALERT": Colour.RED,
        "FAULT": Colour.ORANGE,
    }

    def walk(logic: SignalLogic, calls: list[Call], shown: str) -> None:
        for (state, held), faults, pause_s in inputs:
            now_s = (calls[-1][0] if calls else 0.0) + pause_s
            made: list[Call] = [*calls, (now_s, state, held, faults)]
            after = copy.copy(logic)
            after._falls_s = list(logic._falls_s)
            after._steady_from_s = -math.inf  # flicker has tests of its own
            signal = after.next_signal(now_s, state, faults, held)
            after._falls_s = []
            after._steady_from_s = -math.inf
            assert signal.name == expected(made, recover), made
            assert signal.colour is colours[signal.name]
            assert (signal.blink_hz > 0) == (signal.name in ("ALERT", "FAULT"))
            assert not (faults and signal.colour in (Colour.BLUE, Colour.GREEN))
            chimes = signal.name == "SAFE" and shown != "SAFE"
            bell = signal.name == "ALERT"
            assert signal.sound is (Sound.CHIME if chimes else Sound.BELL if bell else Sound.NONE)
            assert bool(signal.faults) == (signal.name == "FAULT" or bool(faults))
            if faults:
                assert signal.faults == faults
            reached.add((shown, state, held, faults, signal.name))
            alert_s = min(now_s - after._alert_s, 2 * FRESH_S)
            kept = (after._good_frames, after._decided, after._recovering_from, after._shown)
            machine = (*kept, round(alert_s, 3))
            if machine not in walked:
                walked.add(machine)
                walk(after, made, signal.name)

    walk(SignalLogic(recover_frames=recover), [], "FAULT")
    shown_before = {before for before, *_ in reached}
    assert shown_before == set(colours)
    # From every shown state, every input was tried.
    tried = len({(b, s, h, f) for b, s, h, f, _ in reached})
    assert tried == len(colours) * len(decided) * len(causes)


def test_every_pair_of_states_follows_at_once_outside_alert() -> None:
    calm = [State.IDLE, State.SAFE, State.WARNING]
    for first, second in itertools.permutations(calm, 2):
        logic, now_s = recovered()
        logic.next_signal(now_s, first)
        assert logic.next_signal(now_s + FRAME_S, second).name == second.name


def _fall(logic, now_s, *, frames=5):
    """Good frames from `now_s` on, and then a fault; returns the last signal before the fault."""
    for number in range(frames):
        signal = logic.next_signal(now_s + number / 30, State.SAFE)
    logic.next_signal(now_s + frames / 30, None, (NO_FRAME,))
    return signal.name


NO_FRAME = Fault("camera", "camera.no_frame", "no frame for more than 0.5 s")


def test_from_the_third_fall_on_a_steady_time_is_awaited_and_said():
    logic = SignalLogic()
    assert [_fall(logic, at_s) for at_s in (0.0, 2.0, 4.0)] == ["SAFE"] * 3
    last_s = 4.0 + 5 / 30
    for tick in range(49):
        signal = logic.next_signal(last_s + (tick + 1) / 10, State.SAFE)
        assert signal.name == "FAULT"
        assert [fault.code for fault in signal.faults] == ["service.unsteady"]
    assert "3 times in 30 s: waiting for 5 s" in signal.faults[0].detail
    assert logic.next_signal(last_s + 5.0, State.SAFE).name == "SAFE"


def test_the_wait_begins_anew_with_a_fault_and_doubles_with_the_next_fall():
    logic = SignalLogic()
    for at_s in (0.0, 1.0, 2.0):
        _fall(logic, at_s)
    assert _fall(logic, 6.0) == "FAULT"  # within the wait: it is not a fall, but begins it anew
    again_s = 6.0 + 5 / 30
    assert logic.next_signal(again_s + 4.9, State.SAFE).name == "FAULT"
    assert _fall(logic, again_s + 5.0) == "SAFE"
    assert logic.next_signal(again_s + 14.9, State.SAFE).name == "FAULT"


def test_an_alert_shows_while_a_steady_time_is_awaited():
    logic = SignalLogic()
    for at_s in (0.0, 1.0, 2.0):
        _fall(logic, at_s)
    assert logic.next_signal(3.0, State.ALERT).name == "ALERT"
    assert logic.next_signal(4.5, State.SAFE).name == "FAULT"


def test_falls_that_are_far_apart_cost_no_wait():
    logic = SignalLogic()
    assert [_fall(logic, at_s) for at_s in (0.0, 20.0, 40.0, 60.0)] == ["SAFE"] * 4
    assert _fall(logic, 61.0) == "SAFE"
