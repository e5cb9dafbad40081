"""The newest frame of a live source, read in a thread that reopens it after a failure."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TypeVar

from bikeped.capture.base import FrameSource
from bikeped.errors import CaptureError
from bikeped.types import Frame

_log = logging.getLogger(__name__)

_Result = TypeVar("_Result")

#: Opening a camera may take this much longer than a read, in seconds.
OPENING_S = 4.0
#: A time stamp further ahead of the clock than this is of no frame that was captured, in seconds.
FUTURE_S = 0.1
#: So many calls that do not return are left to their threads; each holds memory and a device.
MAX_LEFT = 4


def backoff_s(failures: int, first_s: float, max_s: float) -> float:
    """Pause before the next attempt after `failures` (at least 1) in a row: doubles each time."""
    return float(min(first_s * 2.0 ** min(failures - 1, 60), max_s))


class _Reader:
    """A thread that reads the source, and the call that it is in."""

    def __init__(self, run: Callable[[_Reader], None]) -> None:
        self.given_up = threading.Event()  #: another thread has taken its place
        self.busy_since_s: float | None = None
        self.opening = False
        self.failures = 0  #: in a row
        self.thread = threading.Thread(target=run, args=(self,), name="frame-grabber", daemon=True)


class FrameGrabber:
    """Reads a live source in its own thread and keeps only the newest frame.

    `open_source` is called in the thread, at `start` and again after an error, after `restart` and
    when the source delivers no newer frame for `stale_after_s`. A read that does not return cannot
    be ended; `replace_hung` leaves it behind after `hang_after_s`. Attempts are `first_pause_s`
    apart, doubled up to `max_pause_s`, and reset once a source has delivered for `healthy_after_s`.
    The end of a source (a paced recording) ends the thread: see `ended`. A frame that is not newer
    than the last, or from the future, is dropped.

    Frame numbers continue across restarts. `next` is for one consumer; everything else may be used
    from any thread. Times are seconds on `clock`.
    """

    def __init__(
        self,
        open_source: Callable[[], FrameSource],
        *,
        clock: Callable[[], float] = time.monotonic,
        stale_after_s: float = 2.0,
        hang_after_s: float = 2.0,
        max_fps: float = math.inf,
        first_pause_s: float = 0.25,
        max_pause_s: float = 1.0,
        healthy_after_s: float = 1.0,
    ) -> None:
        self._open_source = open_source
        self._clock = clock
        self._stale_after_s, self._hang_after_s = stale_after_s, hang_after_s
        self._first_pause_s, self._max_pause_s = first_pause_s, max_pause_s
        self._healthy_after_s = healthy_after_s
        self._stop = threading.Event()
        self._restart = threading.Event()
        self._reader = _Reader(self._run)
        self._left: list[_Reader] = []  # whose calls have not returned
        self._left_s = -math.inf  # when the newest was left
        self._lock = threading.Lock()  # guards everything below
        self._latest: Frame | None = None
        self._taken = True
        self._waiter: tuple[asyncio.AbstractEventLoop, asyncio.Event] | None = None
        self.frames = 0  #: that arrived
        self.dropped = 0  #: that a newer one replaced before they were taken
        self.error: CaptureError | None = None  #: why there are no frames; None since a frame came
        self.ended = False  #: whether the source has come to its end
        self._arrived_s: float | None = None
        self._arrivals: deque[float] = deque(maxlen=512)
        self._max_fps = max_fps
        self.nominal_fps: float | None = None  #: the highest stated, at most `max_fps`

    def start(self) -> None:
        """Starts the thread, once."""
        self._reader.thread.start()

    def stop(self, timeout_s: float = 2.0) -> bool:
        """Ends the thread, waiting up to `timeout_s`: call it outside the event loop.

        False when the thread hangs in the source (it is a daemon thread).
        """
        self._stop.set()
        self._wake()
        thread = self._reader.thread
        if thread.ident is not None:
            thread.join(timeout_s)
        return not thread.is_alive()

    def restart(self) -> None:
        """Reopens the source once the current read has returned."""
        self._restart.set()

    async def next(self, timeout_s: float) -> Frame | None:
        """The newest frame not taken yet; waits for one up to `timeout_s`.

        None after the timeout, after `stop`, and at the end of a recording.
        """
        wake = asyncio.Event()
        with self._lock:
            if self._waiter is not None:
                raise RuntimeError("FrameGrabber.next has one consumer, and it is waiting already")
            frame = self._take()
            if frame is not None or self.ended or self._stop.is_set():
                return frame
            self._waiter = (asyncio.get_running_loop(), wake)
        try:
            await asyncio.wait_for(wake.wait(), timeout_s)
        except asyncio.TimeoutError:
            pass  # a frame may have come meanwhile: checked below
        finally:
            with self._lock:
                self._waiter = None
        with self._lock:
            return self._take()

    def age_s(self, now_s: float) -> float:
        """Time since the last frame arrived; infinite before the first."""
        with self._lock:
            return math.inf if self._arrived_s is None else now_s - self._arrived_s

    def rate(self, now_s: float, window_s: float) -> tuple[float, float] | None:
        """Frames per second that arrived in the last `window_s`, and their nominal rate.

        None before a whole window has passed since the first, and while none comes.
        """
        with self._lock:
            arrivals, nominal = list(self._arrivals), self.nominal_fps
        recent = sum(now_s - window_s < at_s <= now_s for at_s in arrivals)
        if not recent or nominal is None or now_s - arrivals[0] < window_s:
            return None
        return recent / window_s, nominal

    def replace_hung(self, now_s: float) -> str | None:
        """Leaves a call that has not returned to its thread, and opens the source in a new one.

        Call it now and then. Returns why only a new process can help, else None: a V4L2 device
        stays busy while a read of it does not return.
        """
        with self._lock:
            reader, limit_s = self._reader, self._hang_after_s
            limit_s += OPENING_S if reader.opening else 0.0
            hung = reader.busy_since_s is not None and now_s - reader.busy_since_s > limit_s
            if hung:
                reader.given_up.set()
                self._left.append(reader)
                self._left_s = now_s
                self._reader = _Reader(self._run)
                text = f"a read has not returned for {limit_s:g} s; opening the camera anew"
                self.error = CaptureError(text)
            self._left = [left for left in self._left if left.thread.is_alive()]
            still, error = len(self._left), self.error
        if hung:
            _log.error("camera: %s", error)
            self._reader.thread.start()
        if still > MAX_LEFT:
            return f"{still} reads have not returned"
        if still and error is not None and now_s - self._left_s > self._hang_after_s:
            return f"a read has not returned, and the camera cannot be opened anew: {error}"
        return None

    def _run(self, reader: _Reader) -> None:
        while not self._over(reader):
            try:
                self._read_source(reader)
            except CaptureError as error:
                self._failed(reader, error)
            except Exception as error:  # noqa: BLE001  (the thread must outlive a bug)
                _log.exception("the camera's source failed")
                self._failed(
                    reader, CaptureError(f"camera.source: {type(error).__name__}: {error}")
                )
            if self.ended:
                break
            if reader.failures and not self._over(reader):
                pause_s = backoff_s(reader.failures, self._first_pause_s, self._max_pause_s)
                self._stop.wait(pause_s)
        self._wake()

    def _over(self, reader: _Reader) -> bool:
        return self._stop.is_set() or reader.given_up.is_set()

    def _read_source(self, reader: _Reader) -> None:
        """Opens a source and reads it until it fails (raises), ends, or `restart` is called."""
        self._restart.clear()
        source = self._timed(reader, self._open_source, opening=True)
        try:
            opened_s = fresh_s = self._clock()
            self.nominal_fps = min(max(self.nominal_fps or 0.0, source.fps), self._max_fps)
            last_captured_s = -math.inf
            while not (self._over(reader) or self._restart.is_set()):
                frame = self._timed(reader, source.read)
                if frame is None:
                    self.ended = not reader.given_up.is_set()
                    return
                now_s = self._clock()
                if last_captured_s < frame.captured_s <= now_s + FUTURE_S:
                    last_captured_s, fresh_s = frame.captured_s, now_s
                    self._publish(reader, frame, now_s)
                    if now_s - opened_s >= self._healthy_after_s:
                        reader.failures = 0
                elif now_s - fresh_s > self._stale_after_s:
                    raise CaptureError(
                        f"{source.name}: no newer frame for {now_s - fresh_s:.1f} s; "
                        "is it still plugged in, and are its time stamps of the past?"
                    )
        finally:
            self._timed(reader, source.close)

    def _timed(
        self, reader: _Reader, call: Callable[[], _Result], *, opening: bool = False
    ) -> _Result:
        with self._lock:
            reader.busy_since_s, reader.opening = self._clock(), opening
        try:
            return call()
        finally:
            with self._lock:
                reader.busy_since_s, reader.opening = None, False

    def _publish(self, reader: _Reader, frame: Frame, now_s: float) -> None:
        with self._lock:
            if reader.given_up.is_set():
                return
            if not self._taken:
                self.dropped += 1
            self._latest = dataclasses.replace(frame, number=self.frames)
            self._taken = False
            self.frames += 1
            self._arrived_s = now_s
            self._arrivals.append(now_s)
            self.error = None
        self._wake()

    def _take(self) -> Frame | None:
        """The newest frame if it was not taken yet; the lock must be held."""
        if self._taken:
            return None
        self._taken = True
        return self._latest

    def _failed(self, reader: _Reader, error: CaptureError) -> None:
        reader.failures += 1
        with self._lock:
            if reader.given_up.is_set():
                return
            known, self.error = self.error, error
        # An unplugged camera must not fill the log: a new error, then the 2nd, 4th, 8th ... time.
        if str(known) != str(error) or reader.failures & (reader.failures - 1) == 0:
            _log.warning("%s (attempt %d follows)", error, reader.failures + 1)

    def _wake(self) -> None:
        with self._lock:
            if self._waiter is None:
                return
            loop, wake = self._waiter
            try:
                loop.call_soon_threadsafe(wake.set)
            except RuntimeError:
                self._waiter = None  # the loop is closed
