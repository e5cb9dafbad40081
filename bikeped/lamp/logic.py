"""What the lamp shows: heartbeats of the service in, a colour out. Pure; times in seconds.

| situation                                                      | shows                          |
| -------------------------------------------------------------- | ------------------------------ |
| no heartbeat yet, none for `SILENCE_S`, a malformed one        | FAULT                          |
| heartbeats again, without a gap for less than `RECOVER_S`      | red if they say so, else FAULT |
| the same after the n-th silence in ten minutes, for `hold_s`   | FAULT in place of blue, green  |
| `FLICKERS` gaps over `GAP_S` beside them within `WINDOW_S`     | FAULT, latched                 |
| another colour, or two, read back for more than `CONFLICT_S`   | FAULT, latched                 |
| otherwise                                                      | what the heartbeat says        |

FAULT is orange, blinking slowly. A service that crashes again and again shows green once: each
silence lengthens the wait. Gaps count where blue or green was shown, as they were sent: a service
that stutters while it loads, or a lamp that is late itself, is no flicker. What is latched ends by
`reset` or at power-on. The service's last heartbeat may be `off`: dark claims nothing, so it needs
no further heartbeats.
"""

from __future__ import annotations

import json
import math
from collections import deque
from dataclasses import dataclass, field

from bikeped.lamp.colours import Colour, blinked

REASSURING = (Colour.BLUE, Colour.GREEN)

SILENCE_S = 0.5
GAP_S = 0.18  #: the service sends at least every 0.1 s
FLICKERS, WINDOW_S = 5, 3.0
RECOVER_S = 1.0
SILENCES_S = 600.0  #: so long a silence is remembered
CONFLICT_S = 0.3
FAULT_BLINK_HZ = 0.5
MAX_BLINK_HZ = 10.0
MAX_S = 1e12


@dataclass(frozen=True)
class Heartbeat:
    """What the service wants shown. `sent_s` is CLOCK_MONOTONIC, which all processes share."""

    sent_s: float
    colour: Colour
    blink_hz: float  #: 0 is steady

    def encode(self) -> bytes:
        """The datagram."""
        return json.dumps(
            {"sent_s": self.sent_s, "colour": self.colour.value, "blink_hz": self.blink_hz}
        ).encode()

    @staticmethod
    def decode(message: object) -> Heartbeat:
        """A heartbeat from its decoded JSON; ValueError for anything else."""
        if not isinstance(message, dict) or message.keys() != {"sent_s", "colour", "blink_hz"}:
            raise ValueError("not a heartbeat")
        sent_s, blink_hz = message["sent_s"], message["blink_hz"]
        for number in (sent_s, blink_hz):
            if isinstance(number, bool) or not isinstance(number, int | float):
                raise ValueError(f"not a number: {number!r}")
        if not (abs(sent_s) < MAX_S and 0 <= blink_hz <= MAX_BLINK_HZ):
            raise ValueError(f"out of range: sent_s {sent_s}, blink_hz {blink_hz}")
        return Heartbeat(sent_s, Colour(message["colour"]), blink_hz)


FAULT = (Colour.ORANGE, FAULT_BLINK_HZ)


def hold_s(silences: int) -> float:
    """How long heartbeats must come before blue or green, after so many silences."""
    return min(3.0 * 10.0 ** (silences - 1), 300.0) if silences else RECOVER_S


@dataclass
class ReadbackLatch:
    """Latches what the lamps read back in place of the colour that was set, once it lasts."""

    latched: str | None = None
    _since_s: float | None = None

    def update(self, mismatch: str | None, now_s: float) -> None:
        """What is lit instead at `now_s`; None: the lamps agree."""
        if mismatch is None:
            self._since_s = None
        elif self._since_s is None:
            self._since_s = now_s
        elif now_s - self._since_s > CONFLICT_S:
            self.latched = self.latched or f"conflict: {mismatch}"

    def reset(self) -> None:
        """Begins anew."""
        self.latched = self._since_s = None


@dataclass
class LampLogic:
    """The state of one lamp since power-on."""

    latched: str | None = None  #: why FAULT stays until `reset`
    _beat: Heartbeat | None = None
    _sent_s: float = -math.inf  # of the newest heartbeat ever, so that old ones never count again
    _heard_s: float = -math.inf
    _since_s: float = -math.inf  # begin of the unbroken run of heartbeats
    _gaps: deque[float] = field(default_factory=lambda: deque(maxlen=FLICKERS))
    _silences: deque[float] = field(default_factory=lambda: deque(maxlen=4))
    _conflict: ReadbackLatch = field(default_factory=ReadbackLatch)
    _pattern: tuple[Colour, float] = FAULT
    _pattern_s: float = 0.0

    def heartbeat(self, beat: Heartbeat | None, now_s: float) -> None:
        """A heartbeat has come; None stands for a malformed one.

        One that was sent too long ago, before another or in the future is not a sign of life.
        """
        if beat is None:
            self._gap(now_s)
            self._beat = None
        elif beat.sent_s > self._sent_s and 0 <= now_s - beat.sent_s < SILENCE_S:
            before, gap_s = self._beat, beat.sent_s - self._sent_s
            if before is None or now_s - self._heard_s >= SILENCE_S:
                if before is not None and before.colour is not Colour.OFF:
                    self._silences.append(now_s)
                self._since_s = now_s
            if before is not None and before.colour in REASSURING and gap_s > GAP_S:
                self._gap(now_s)
            self._beat, self._sent_s, self._heard_s = beat, beat.sent_s, now_s

    def _gap(self, now_s: float) -> None:
        self._gaps.append(now_s)
        if len(self._gaps) == FLICKERS and now_s - self._gaps[0] <= WINDOW_S:
            self.latched = self.latched or "flicker: the heartbeats come and go"

    def readback(self, mismatch: str | None, now_s: float) -> None:
        """What the lamps read back in place of the colour that was set; None: they agree."""
        self._conflict.update(mismatch, now_s)
        self.latched = self.latched or self._conflict.latched

    def reset(self) -> None:
        """Ends what is latched; the heartbeats must prove themselves anew."""
        self.latched = self._beat = None
        self._conflict.reset()
        self._gaps.clear()
        self._silences.clear()

    def _held_until_s(self, now_s: float) -> float:
        return self._since_s + hold_s(sum(now_s - at_s < SILENCES_S for at_s in self._silences))

    def fault(self, now_s: float) -> str | None:
        """Why FAULT is shown at `now_s` whatever the service says; None when it is heard."""
        if self.latched is not None:
            return self.latched
        if self._beat is None:
            return "no heartbeat"
        if self._beat.colour is Colour.OFF:
            return None
        if now_s - self._heard_s >= SILENCE_S:
            return f"no heartbeat for {SILENCE_S:g} s"
        if now_s - self._since_s < RECOVER_S and self._beat.colour is not Colour.RED:
            return "heartbeats are coming again"
        if self._beat.colour in REASSURING and now_s < self._held_until_s(now_s):
            return "no blue or green yet: the service fell silent before"
        return None

    def shows(self, now_s: float) -> tuple[Colour, float]:
        """The colour of this moment, and when it must be asked for again at the latest."""
        beat = self._beat
        if beat is None or self.fault(now_s) is not None:
            pattern = FAULT
        else:
            pattern = (beat.colour, beat.blink_hz)
        if pattern != self._pattern:
            self._pattern, self._pattern_s = pattern, now_s
        colour, edge_s = blinked(*pattern, self._pattern_s, now_s)
        silent_s, recovered_s = self._heard_s + SILENCE_S, self._since_s + RECOVER_S
        limits_s = (edge_s, silent_s, recovered_s, self._held_until_s(now_s))
        return colour, min((at_s for at_s in limits_s if at_s > now_s), default=math.inf)
