"""Which signal the light and the speaker show: FAULT, recovery and ALERT beside a fault. Pure.

The table of states is the paper's table 2; FAULT is bikeped's addition.

| name    | light                          | sound                |
| ------- | ------------------------------ | -------------------- |
| IDLE    | blue, steady                   | none                 |
| SAFE    | green, steady                  | chime, once on entry |
| WARNING | orange, steady                 | none                 |
| ALERT   | red, blinking at `blink_hz`    | bell                 |
| FAULT   | orange, blinking slowly        | none                 |
| OFF     | dark (the service has stopped) | none                 |

The machine counts good frames: new decisions without a fault, in a row. It starts at 0.

| count              | a fault        | a good frame | a tick without a decision | shows         |
| ------------------ | -------------- | ------------ | ------------------------- | ------------- |
| < `recover_frames` | becomes 0      | one more     | stays                     | FAULT         |
| `recover_frames`   | becomes 0      | stays        | stays                     | last decision |

* A new ALERT shows red at once: at the start, during recovery and beside a fault too. Early red
  reassures no one. A decision that cannot be trusted is passed as None.
* A held ALERT (`Decision.held`) stays red until a fault, which ends the hold: beside it red lasts
  `FRESH_S` after the last frame in which the rule itself said ALERT.
* Blue, green and steady orange need the full count: a light never shows them before frames came.
* FAULT that comes and goes is waited out: from the third within `FLICKER_S` on that ends another
  light, the light leaves it only after `UNSTEADY_S` without a fault, doubled with each more.
* A fault that only withholds (people may be missed) shows FAULT where blue or green would show; it
  leaves the count, WARNING and ALERT alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from bikeped.config.output_sections import FeedbackConfig
from bikeped.faults import Effect, Fault
from bikeped.types import Colour, Signal, Sound, State

#: The fault shown before the first `recover_frames` good frames.
STARTING = Fault("starting", "service.starting", "not enough good frames yet")

#: Within this time so many falls into FAULT are flicker, and the first wait for a steady light.
FLICKER_S, FLICKERS, UNSTEADY_S, LONGEST_WAIT_S = 30.0, 3, 5.0, 30.0

#: Beside a fault an ALERT is fresh for so long: longer than from one frame to the next.
FRESH_S = 0.2

OFF = Signal("OFF", Colour.OFF)

_STEADY = {State.IDLE: Colour.BLUE, State.SAFE: Colour.GREEN, State.WARNING: Colour.ORANGE}


def fault_signal(faults: tuple[Fault, ...], blink_hz: float) -> Signal:
    """FAULT as the light shows it: orange, slowly blinking, never a steady colour.

    Raises ValueError when `blink_hz` is not above zero, for steady orange would say WARNING.
    """
    if not blink_hz > 0:
        raise ValueError(f"FAULT must blink: expected blink_hz > 0, got {blink_hz}")
    return Signal("FAULT", Colour.ORANGE, blink_hz, Sound.NONE, faults)


@dataclass
class SignalLogic:
    """Turns decisions and faults into signals; one instance a light.

    ValueError for a light that would not blink.
    """

    blink_hz: float = 2.0  #: of ALERT, flashes a second
    fault_blink_hz: float = 0.5  #: of FAULT
    recover_frames: int = 5

    def __post_init__(self) -> None:
        if not self.blink_hz > 0:
            raise ValueError(f"ALERT must blink: expected blink_hz > 0, got {self.blink_hz}")
        fault_signal((), self.fault_blink_hz)
        self._good_frames = 0
        self._recovering_from: tuple[Fault, ...] = (STARTING,)
        self._decided: State | None = None  # by the newest good frame
        self._alert_s = -math.inf  # time of the newest ALERT that is not held
        self._falls_s: list[float] = []  # when FAULT followed a light that was trusted
        self._steady_from_s = -math.inf  # until then the light stays in FAULT
        self._unsteady: tuple[Fault, ...] = ()
        self._shown = "FAULT"

    @classmethod
    def from_config(cls, feedback: FeedbackConfig) -> SignalLogic:
        """The logic with the timings of the configuration's `feedback` section."""
        return cls(
            blink_hz=feedback.blink_hz,
            fault_blink_hz=feedback.fault_blink_hz,
            recover_frames=feedback.recover_frames,
        )

    def next_signal(
        self,
        now_s: float,
        decided: State | None,
        faults: tuple[Fault, ...] = (),
        held: bool = False,
    ) -> Signal:
        """The signal at `now_s`, in seconds of one monotonic clock.

        `decided` is the state of a new frame, None on a tick of the clock or when the decision
        cannot be trusted; `held`: it is an ALERT that is held. `faults` are those present now
        whose effect on the light is FAULT or WITHHELD. The chime is in the one signal in which SAFE
        begins.
        """
        stopping = tuple(fault for fault in faults if fault.kind.effect is Effect.FAULT)
        if decided is State.ALERT and not held:
            self._alert_s = now_s
        if stopping:
            self._count_falls(now_s)
            self._good_frames, self._decided = 0, None
            self._recovering_from = tuple(
                Fault("recovering", "service.recovering", str(fault)) for fault in stopping
            )
        elif decided is not None:
            # A hold that a fault has ended does not come back.
            ended = held and self._shown != "ALERT"
            self._decided = State.WARNING if ended else decided
            if decided is not State.ALERT:
                self._alert_s = -math.inf
            self._good_frames = min(self._good_frames + 1, self.recover_frames)
        if now_s < self._steady_from_s and not stopping:
            faults = (*self._unsteady, *faults)
        trusted = self._decided if self._good_frames >= self.recover_frames else None
        trusted = None if now_s < self._steady_from_s else trusted

        # A clock that stepped back (a recording that loops) does not prolong an ALERT.
        fresh = 0 <= now_s - self._alert_s <= FRESH_S
        holding = self._shown == "ALERT" and self._decided is State.ALERT and not stopping
        if fresh or holding or trusted is State.ALERT:
            # The faults travel with the red light, so that telemetry sees them.
            signal = Signal("ALERT", Colour.RED, self.blink_hz, Sound.BELL, faults)
        elif trusted is None:
            signal = fault_signal(faults or self._recovering_from, self.fault_blink_hz)
        elif faults and trusted is not State.WARNING:
            signal = fault_signal(faults, self.fault_blink_hz)
        else:
            begins = trusted is State.SAFE and self._shown != "SAFE"
            sound = Sound.CHIME if begins else Sound.NONE
            signal = Signal(trusted.name, _STEADY[trusted], sound=sound, faults=faults)
        self._shown = signal.name
        return signal

    def _count_falls(self, now_s: float) -> None:
        """A fault is here: counts a fall from a trusted light, and sets the wait that follows."""
        trusted = self._good_frames >= self.recover_frames and now_s >= self._steady_from_s
        self._falls_s = [at_s for at_s in self._falls_s if 0 <= now_s - at_s < FLICKER_S]
        if trusted:
            self._falls_s.append(now_s)
        more = len(self._falls_s) - FLICKERS
        if more >= 0:
            wait_s = min(UNSTEADY_S * 2.0**more, LONGEST_WAIT_S)
            self._steady_from_s = now_s + wait_s
            text = f"FAULT came {len(self._falls_s)} times in {FLICKER_S:g} s: waiting for "
            text += f"{wait_s:g} s without a fault"
            self._unsteady = (Fault("service", "service.unsteady", text),)
