"""The light: what a device must do, which lamp shows which colour, and the thread that drives it.

`LightDriver` runs one thread. The thread blinks the light, it alone calls the device (a device that
hangs blocks nothing else), and it is a watchdog: without a call of `show` for `watchdog_s` it shows
FAULT. Where the device reads back another colour than the one that was set, it latches FAULT until
the next start. A thread and not an asyncio task, because it must work when the event loop is stuck.
It does not cover a process that died or whose interpreter is stuck: systemd's watchdog ends that
process, and `python -m bikeped.feedback` (ExecStopPost) then darkens the light.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Protocol, TypeVar

from bikeped.errors import FeedbackError
from bikeped.faults import Fault
from bikeped.feedback.signal_logic import fault_signal
from bikeped.lamp.colours import Colour, Light, blinked
from bikeped.lamp.logic import ReadbackLatch
from bikeped.types import Signal

_log = logging.getLogger(__name__)

_T = TypeVar("_T")

#: The fault of a light that the service has not set for `watchdog_s`.
NOT_REFRESHED = Fault("light", "light.not_refreshed", "not refreshed by the service")


class LightOutput(Protocol):
    """What the service needs of its light: a thread that drives it, or the lamp's process."""

    name: str  #: as in `feedback.light`
    errors: int  #: device calls that failed, since the start

    @property
    def fault(self) -> Fault | None: ...
    def start(self) -> None: ...
    def show(self, signal: Signal) -> None: ...
    def close(self, timeout_s: float = 2.0) -> bool: ...


class SimulatedLight:
    """A light that only writes to the log."""

    def __init__(self) -> None:
        self.colour = Colour.OFF
        self._lit = Colour.OFF

    def set(self, colour: Colour) -> None:
        # The dark half of blinking is not logged: a FAULT that lasts a month is one line.
        if colour not in (Colour.OFF, self._lit):
            _log.info("simulated light: %s", colour.value)
            self._lit = colour
        self.colour = colour

    def close(self) -> None:
        _log.info("simulated light: off")
        self.colour = self._lit = Colour.OFF


class LightDriver:
    """Shows signals on a light, from its own thread, and reports when the light does not obey.

    `open_light` opens the device, in the thread, at the start and after every error; `name` is its
    kind, as in `feedback.light`. Without a `show` for `watchdog_s` the light shows FAULT. A newer
    signal replaces one that was not shown yet.
    """

    hang_s = 2.0  #: a device call longer than this is a fault
    assert_s = 0.5  #: between two sendings of an unchanged colour: a replugged light is noticed
    read_s = 0.1  #: between two readings of what is lit, where the device can tell
    retry_s = (0.5, 4.0)  #: first and longest pause after an error; pauses double

    def __init__(
        self,
        open_light: Callable[[], Light],
        *,
        name: str = "simulated",
        fault_blink_hz: float = 0.5,
        watchdog_s: float = 1.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = name
        self._open_light = open_light
        self._watchdog_signal = fault_signal((NOT_REFRESHED,), fault_blink_hz)
        self._watchdog_s, self._clock = watchdog_s, clock

        # Shared with the caller, guarded by the condition's lock.
        self._changed = threading.Condition()
        self._signal: Signal | None = None
        self._shown_s = clock()
        self._closing = False
        self._busy_since: float | None = None
        self._error: Fault | None = None
        self.errors = 0  #: device calls that failed, since the start

        # The thread's own.
        self._light: Light | None = None
        self._applied: Colour | None = None
        self._applied_s = 0.0
        self._pattern: tuple[Colour, float] = (Colour.OFF, 0.0)
        self._pattern_s = 0.0
        self._retry_at_s: float | None = None
        self._pause_s = self.retry_s[0]
        self._readback = ReadbackLatch()
        self._tripped = False
        self._to_say = (False, False)  # whether the watchdog has tripped, and had before
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Starts the thread; the light is opened there and shows FAULT until the first `show`."""
        if self._thread is not None:
            raise RuntimeError("a LightDriver starts once")
        # A daemon: a device that hangs for good must not keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="bikeped-light", daemon=True)
        self._thread.start()

    def show(self, signal: Signal) -> None:
        """Shows `signal` from now on and restarts its watchdog. Returns at once, always."""
        with self._changed:
            old = self._signal
            self._signal = signal
            self._shown_s = self._clock()
            # At 30 calls a second the thread is only woken when there is something to do.
            if self._tripped or old is None or _pattern_of(old) != _pattern_of(signal):
                self._changed.notify()

    @property
    def fault(self) -> Fault | None:
        """What is wrong with the light now, for health and the log; None when it obeys."""
        with self._changed:
            if self._thread is not None and not self._thread.is_alive() and not self._closing:
                detail = "its thread has ended; restart the service"
                return Fault("light", "light.thread_ended", detail)
            if self._busy_since is not None and self._clock() - self._busy_since > self.hang_s:
                detail = f"the device has not answered for more than {self.hang_s:g} s"
                return Fault("light", "light.hang", detail)
            if self._readback.latched:
                detail = f"{self._readback.latched}; repair it, then restart the service"
                return Fault("lamp", "lamp.latched", detail)
            return self._error

    def close(self, timeout_s: float = 2.0) -> bool:
        """Switches the light off and ends the thread; False when the device hangs.

        Waits at most `timeout_s`: from asyncio, call it by `asyncio.to_thread`.
        """
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is None:
            return True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def update(self, now_s: float) -> float:
        """Brings the light up to date at `now_s`; returns when to call again.

        Only the thread calls this, and tests with their own clock instead of a thread.
        """
        signal, trips_at_s = self._effective(now_s)
        if _pattern_of(signal) != self._pattern:
            self._pattern = _pattern_of(signal)
            self._pattern_s = now_s
        colour, edge_s = blinked(*self._pattern, self._pattern_s, now_s)
        due_s = min(edge_s, trips_at_s, self._apply(colour, now_s))
        # Said once the light is set, and outside the lock: a log that blocks must block neither.
        tripped, before = self._to_say
        if tripped and not before:
            _log.error("%s for %g s; the light shows FAULT", NOT_REFRESHED, self._watchdog_s)
        elif before and not tripped:
            _log.warning("light: refreshed again after its watchdog had tripped")
        return due_s

    def _effective(self, now_s: float) -> tuple[Signal, float]:
        """The signal that counts at `now_s`, and when the watchdog would trip."""
        with self._changed:
            signal, shown_s = self._signal, self._shown_s
            stale = now_s - shown_s >= self._watchdog_s
            was, self._tripped = self._tripped, stale and signal is not None
        self._to_say = (self._tripped, was)
        if stale or signal is None or (self._readback.latched and signal.colour is not Colour.OFF):
            return self._watchdog_signal, float("inf")
        return signal, shown_s + self._watchdog_s

    def _apply(self, colour: Colour, now_s: float) -> float:
        """Makes the device show `colour`, if it does not already; returns when to check again."""
        if self._retry_at_s is not None and now_s < self._retry_at_s:
            return self._retry_at_s
        reads = getattr(self._light, "mismatch", None)
        pause_s = self.assert_s if reads is None else self.read_s
        try:
            if reads is not None and self._applied is not None:
                applied = self._applied
                self._readback.update(self._call(lambda: reads(applied)), now_s)
            if colour == self._applied and 0 <= now_s - self._applied_s < self.assert_s:
                return min(self._applied_s + self.assert_s, now_s + pause_s)
            if self._light is None:
                self._light = self._call(self._open_light)
            light = self._light
            self._call(lambda: light.set(colour))
        except FeedbackError as error:
            return self._failed(str(error), now_s)
        except Exception as error:  # noqa: BLE001 - a bug must not end the watchdog's thread
            _log.debug("light: unexpected error", exc_info=True)
            return self._failed(f"{type(error).__name__}: {error}", now_s)
        self._retry_at_s, self._pause_s = None, self.retry_s[0]
        if self._error is not None:
            _log.warning("light: works again")
            with self._changed:
                self._error = None
        self._applied, self._applied_s = colour, now_s
        return now_s + pause_s

    def _call(self, action: Callable[[], _T]) -> _T:
        with self._changed:
            self._busy_since = self._clock()
        try:
            return action()
        finally:
            with self._changed:
                self._busy_since = None

    def _failed(self, detail: str, now_s: float) -> float:
        fault = Fault("light", "light.error", detail)
        with self._changed:
            known, self._error = self._error, fault
            self.errors += 1
        if fault != known:
            _log.error("%s", fault)
        self._release()
        self._applied = None
        self._retry_at_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, self.retry_s[1])
        return self._retry_at_s

    def _release(self) -> None:
        light, self._light = self._light, None
        if light is None:
            return
        try:
            self._call(light.close)
        except Exception as error:  # noqa: BLE001 - as in _apply
            level = logging.DEBUG if isinstance(error, FeedbackError) else logging.WARNING
            _log.log(level, "light: closing failed: %s: %s", type(error).__name__, error)

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._closing:
                    break
            wake_s = self.update(self._clock())
            with self._changed:
                wait_s = wake_s - self._clock()
                if not self._closing and wait_s > 0 and not self._pattern_changed():
                    # Bounded, so that a clock that misbehaves cannot stop the watchdog.
                    self._changed.wait(min(wait_s, self._watchdog_s))
        if self._light is None and self._error is not None:
            # A relay keeps its last colour while it cannot be reached: one more try to darken it.
            self._retry_at_s = None
            self._apply(Colour.OFF, self._clock())
        self._release()
        self._applied = None

    def _pattern_changed(self) -> bool:
        """Whether another pattern is due than the one that the last step began with."""
        signal = self._signal
        if signal is None or self._clock() - self._shown_s >= self._watchdog_s:
            signal = self._watchdog_signal
        return _pattern_of(signal) != self._pattern


def _pattern_of(signal: Signal) -> tuple[Colour, float]:
    return signal.colour, signal.blink_hz
