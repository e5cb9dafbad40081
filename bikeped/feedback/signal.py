"""From the decision's state to what the road user sees and hears, FAULT included.

Everything here is pure: no clock, no device, time passed in as seconds of one monotonic clock. The
table of states is the paper's table 2; FAULT is bikeped's addition and is decided only here.

| name    | light                          | sound                |
| ------- | ------------------------------ | -------------------- |
| IDLE    | blue, steady                   | none                 |
| SAFE    | green, steady                  | chime, once on entry |
| WARNING | orange, steady                 | none                 |
| ALERT   | red, blinking at `blink_hz`    | bell                 |
| FAULT   | orange, blinking slowly        | none                 |
| OFF     | dark (the service has stopped) | none                 |

How the states give way to one another, and why:

* A fresh ALERT shows at once, always: also at the start, during recovery and beside a fault. Red
  never reassures anybody, so showing it early can only cost attention. Whoever cannot trust the
  decision (say, the ground table does not fit the frame) passes None in place of a state.
* An ALERT is held for `hold_alert_s`, so that one frame of it can be seen. The hold outlives a
  fault that begins meanwhile, but is not renewed by it: red ends with the hold, then FAULT shows.
* A fault beats every other state, at once: blue, green and steady orange all claim knowledge.
* Leaving FAULT takes `recover_frames` good frames in a row, each a new decision without a fault.
  The logic starts in FAULT, so a light never says blue or green before anything was seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bikeped.faults import Fault
from bikeped.types import Colour, Signal, Sound, State

if TYPE_CHECKING:
    from bikeped.config import FeedbackConfig

#: What `Signal.faults` says before the first good frames came.
STARTING = Fault("starting", "service.starting", "not enough good frames yet")

OFF = Signal("OFF", Colour.OFF)

_STEADY = {State.IDLE: Colour.BLUE, State.SAFE: Colour.GREEN, State.WARNING: Colour.ORANGE}


def fault_signal(faults: tuple[Fault, ...], blink_hz: float) -> Signal:
    """FAULT as the light shows it: orange, slowly blinking, never a steady colour.

    Raises ValueError when `blink_hz` is not above zero, for steady orange would say WARNING.
    """
    if not blink_hz > 0:
        raise ValueError(f"FAULT must blink: expected blink_hz > 0, got {blink_hz}")
    return Signal("FAULT", Colour.ORANGE, blink_hz, Sound.NONE, faults)


class SignalLogic:
    """Turns decisions and faults into signals; one instance a light.

    `blink_hz` and `fault_blink_hz` in flashes per second, `hold_alert_s` in seconds,
    `recover_frames` in frames.
    """

    def __init__(
        self,
        *,
        blink_hz: float = 2.0,
        fault_blink_hz: float = 0.5,
        hold_alert_s: float = 1.0,
        recover_frames: int = 5,
    ) -> None:
        if not blink_hz > 0:
            raise ValueError(f"ALERT must blink: expected blink_hz > 0, got {blink_hz}")
        fault_signal((), fault_blink_hz)
        self._blink_hz = blink_hz
        self._fault_blink_hz = fault_blink_hz
        self._hold_alert_s = hold_alert_s
        self._recover_frames = recover_frames
        self._good_frames = 0
        self._recovered = False
        self._why: tuple[Fault, ...] = (STARTING,)
        self._alert_s: float | None = None
        self._state: State | None = None
        self._shown = "FAULT"

    @classmethod
    def from_config(cls, feedback: FeedbackConfig) -> SignalLogic:
        """The logic with the timings of the configuration's `feedback` section."""
        return cls(
            blink_hz=feedback.blink_hz,
            fault_blink_hz=feedback.fault_blink_hz,
            hold_alert_s=feedback.hold_alert_s,
            recover_frames=feedback.recover_frames,
        )

    def step(
        self, now_s: float, decision_state: State | None, faults: tuple[Fault, ...] = ()
    ) -> Signal:
        """The signal at `now_s`.

        `decision_state` is the state decided from a new frame, or None when this call brings no
        new decision (a mere tick of the clock, or a decision that cannot be trusted); the last
        state then stays. `faults` are those of `assess` at this instant. A chime is asked for only
        in the one signal in which SAFE begins.
        """
        self._learn(now_s, decision_state, faults)
        signal = self._choose(now_s, faults)
        if signal.name == "SAFE" and self._shown != "SAFE":
            signal = Signal("SAFE", Colour.GREEN, sound=Sound.CHIME)
        self._shown = signal.name
        return signal

    def _learn(self, now_s: float, state: State | None, faults: tuple[Fault, ...]) -> None:
        if state is State.ALERT:
            self._alert_s = now_s
        if faults:
            self._recovered = False
            self._good_frames = 0
            self._why = faults
        elif state is not None:
            self._state = state
            self._good_frames = min(self._good_frames + 1, self._recover_frames)
            if self._good_frames >= self._recover_frames:
                self._recovered = True

    def _choose(self, now_s: float, faults: tuple[Fault, ...]) -> Signal:
        if self._alert_holds(now_s) or (
            not faults and self._recovered and self._state is State.ALERT
        ):
            # The faults travel with the red light, so that telemetry sees them all the same.
            return Signal("ALERT", Colour.RED, self._blink_hz, Sound.BELL, faults)
        if faults:
            return fault_signal(faults, self._fault_blink_hz)
        if not self._recovered or self._state is None:
            why = self._why
            if why != (STARTING,):
                why = tuple(Fault("recovering", "service.recovering", str(fault)) for fault in why)
            return fault_signal(why, self._fault_blink_hz)
        return Signal(self._state.name, _STEADY[self._state])

    def _alert_holds(self, now_s: float) -> bool:
        """Whether the last ALERT still keeps the light red.

        A clock that stepped back (a recording that loops) ends the hold and never prolongs it.
        """
        if self._alert_s is None:
            return False
        age_s = now_s - self._alert_s
        # The step that brought the ALERT shows it even with hold_alert_s = 0.
        return age_s == 0 or 0 <= age_s < self._hold_alert_s


def assess(
    now_s: float,
    last_frame_s: float | None,
    last_answer_s: float | None,
    stale_after_s: float,
    silent_after_s: float,
) -> tuple[Fault, ...]:
    """Why nothing that the pipeline says may be believed at `now_s`; empty when all is well.

    `last_frame_s` is the capture time of the newest frame and `last_answer_s` the capture time or
    the arrival of the newest detector answer, both on the clock of `now_s`, None before the first.
    """
    return (
        *_missing("camera", "frame", now_s, last_frame_s, stale_after_s),
        *_missing("detector", "answer", now_s, last_answer_s, silent_after_s),
    )


def _missing(
    source: str, what: str, now_s: float, last_s: float | None, limit_s: float
) -> tuple[Fault, ...]:
    """The fault of the newest `what` being too old, in the future, or not there yet."""
    if last_s is None:
        return (Fault(source, f"{source}.no_{what}", f"no {what} yet"),)
    age_s = now_s - last_s
    # Written so that a NaN age is a fault, too.
    if not age_s <= limit_s:
        detail = f"no {what} for more than {limit_s:g} s"
        return (Fault(source, f"{source}.no_{what}", detail),)
    if age_s < -limit_s:
        detail = f"no {what} with a usable time: the newest lies in the future"
        return (Fault(source, f"{source}.future_time", detail),)
    return ()
