"""Where frames come from: a live camera or a recording."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

from bikeped.capture.base import FrameSource
from bikeped.capture.frame_grabber import FrameGrabber
from bikeped.errors import CaptureError
from bikeped.pipeline.runtime import WorkerThread
from bikeped.types import Frame


class Feed:
    """A source of frames for the loop. As it stands here, a recording: never late, never hung."""

    live = False
    dropped = 0  #: frames that were replaced by a newer one before they were taken
    error: CaptureError | None = None  #: what is wrong with the source now

    async def next_frame(self) -> tuple[Frame, float] | None:
        """The next frame and how long getting it took in ms; None at the end of a recording."""
        raise NotImplementedError

    def age_s(self, now_s: float) -> float:
        """Time since the newest frame arrived, on the loop's clock; infinite before the first."""
        return math.inf

    def rate(self, now_s: float, window_s: float) -> tuple[float, float] | None:
        """Frames per second of the last `window_s`, and their nominal rate; None: not known."""
        return None

    def replace_hung(self, now_s: float) -> str | None:
        """Opens the source anew where a read hangs; why only a new process helps, else None."""
        return None

    def restart(self) -> None:
        """Asks for the source to be opened anew: its frames cannot be used."""

    async def close(self) -> None:
        """Closes the source; takes a bounded time, whatever the source does."""


class LiveFeed(FrameGrabber, Feed):
    """The newest frame of a camera, from `start` on; old ones are dropped and counted."""

    live = True

    async def next_frame(self) -> tuple[Frame, float] | None:
        while (frame := await self.next(1.0)) is None:
            if self.ended:
                return None
        return frame, max(0.0, (time.monotonic() - frame.captured_s) * 1e3)

    async def close(self) -> None:
        await asyncio.to_thread(self.stop)


class RecordedFeed(Feed):
    """Every frame of a recording in order, read one ahead in a thread."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source
        self._reader = WorkerThread("read")
        self._ahead: asyncio.Future[tuple[Frame | None, float]] | None = None

    async def next_frame(self) -> tuple[Frame, float] | None:
        ahead = self._ahead or self._reader.submit(_timed, self._source.read)
        frame, took_ms = await ahead
        if frame is None:
            self._ahead = ahead  # the next call gets the end again
            return None
        self._ahead = self._reader.submit(_timed, self._source.read)
        return frame, took_ms

    async def close(self) -> None:
        if self._ahead is not None:
            self._ahead.cancel()
            await asyncio.gather(self._ahead, return_exceptions=True)
        self._reader.submit(self._source.close)
        await self._reader.close()


def _timed(read: Callable[[], Frame | None]) -> tuple[Frame | None, float]:
    began = time.perf_counter()
    frame = read()
    return frame, (time.perf_counter() - began) * 1e3
