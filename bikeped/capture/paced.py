"""A recording played in real time."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

from bikeped.capture.base import FrameSource
from bikeped.types import Frame


class PacedSource(FrameSource):
    """Returns each frame of `source` at its media time, the first one immediately.

    `captured_s` is rebased on `clock` (monotonic seconds), spaced as in the recording. No frame is
    dropped here: where reading is slower than the recording, frames come late.
    """

    live = True

    def __init__(
        self,
        source: FrameSource,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._source, self._clock, self._sleep = source, clock, sleep
        self._offset_s: float | None = None
        self.name = source.name
        self.width, self.height, self.fps = source.width, source.height, source.fps

    def read(self) -> Frame | None:
        frame = self._source.read()
        if frame is None:
            return None
        now_s = self._clock()
        if self._offset_s is None:
            self._offset_s = now_s - frame.captured_s
        due_s = frame.captured_s + self._offset_s
        if due_s > now_s:
            self._sleep(due_s - now_s)
        return dataclasses.replace(frame, captured_s=due_s)

    def close(self) -> None:
        self._source.close()
