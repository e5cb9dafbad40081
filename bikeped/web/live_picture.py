"""The live page's picture: drawn in a thread of low priority, at a bounded rate, while viewed.

The frame is decoded again, at the page's size: viewers do not change what the detector gets.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from collections.abc import Iterator

import cv2
import numpy as np

from bikeped.capture.jpeg import JpegDecoder
from bikeped.errors import CaptureError
from bikeped.overlay.camera_view import draw_overlay
from bikeped.overlay.drawing import encode_jpeg
from bikeped.overlay.overlay_data import GroundToFrame, OverlayData
from bikeped.pipeline.loop import FrameResult, frame_overlay
from bikeped.pipeline.runtime import RateLimitedLogger, WorkerThread
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.types import ImageArray
from bikeped.web.live_state import LiveState

log = logging.getLogger(__name__)

_NICENESS = 10
_QUALITY = 80


class PictureRenderer:
    """Pictures of `state`'s frames as JPEG, at most `fps` a second and `width` wide."""

    def __init__(
        self, state: LiveState, track_and_decide: TrackAndDecide, width: int, fps: float
    ) -> None:
        self._state, self._track_and_decide = state, track_and_decide
        self._width, self._interval_s = width, 1.0 / fps
        self._viewers = 0
        self._drawing: asyncio.Task[None] | None = None
        self._limited_log = RateLimitedLogger(log)
        self._fresh = asyncio.Event()
        self.jpeg: bytes | None = None
        self.number = 0  #: pictures drawn since the start

    @contextlib.contextmanager
    def viewer(self) -> Iterator[None]:
        """Pictures are drawn while at least one viewer is inside."""
        self._viewers += 1
        if self._drawing is None:
            self.jpeg = None  # the last one may be hours old
            self._drawing = asyncio.create_task(self._draw_pictures(), name="draw")
        try:
            yield
        finally:
            self._viewers -= 1
            if self._viewers == 0 and self._drawing is not None:
                self._drawing.cancel()
                self._drawing = None

    async def next(self, since: int) -> tuple[int, bytes] | None:
        """The newest picture after picture number `since`; None when there will be none."""
        while not self._state.closed:
            if self.jpeg is not None and self.number != since:
                return self.number, self.jpeg
            await self._fresh.wait()
        return None

    def wake(self) -> None:
        """Wakes all that wait; without a new picture, call it after the state was closed."""
        self._fresh.set()
        self._fresh = asyncio.Event()

    async def _draw_pictures(self) -> None:
        worker, decoder = WorkerThread("draw"), JpegDecoder(buffers=1)
        worker.submit(_lower_priority)
        frames = -1
        try:
            while not self._state.closed:
                await self._state.wait_frame(frames)
                frames, result = self._state.frame_count, self._state.result
                if result is None:
                    continue
                began_s = time.monotonic()
                try:
                    data, to_frame = frame_overlay(
                        result, self._track_and_decide, self._state.signal
                    )
                    self.jpeg = await worker.submit(self._draw, decoder, result, data, to_frame)
                except Exception as error:  # noqa: BLE001 - a picture less, never more
                    self._limited_log.failure("picture", error)
                else:
                    self.number += 1
                    self.wake()
                rest_s = self._interval_s - (time.monotonic() - began_s)
                await asyncio.sleep(max(rest_s, 0.0))
        finally:
            await asyncio.shield(worker.close(0.0))

    def _draw(
        self, decoder: JpegDecoder, result: FrameResult, data: OverlayData, to_frame: GroundToFrame
    ) -> bytes:
        rgb = self._picture(decoder, result)
        scale = rgb.shape[1] / result.decoded.frame.width
        drawn = draw_overlay(rgb, data, scale=scale, ground_to_frame=to_frame)
        return encode_jpeg(drawn, _QUALITY)

    def _picture(self, decoder: JpegDecoder, result: FrameResult) -> ImageArray:
        frame = result.decoded.frame
        width = min(self._width, frame.width)
        height = max(1, round(frame.height * width / frame.width))
        if frame.jpeg is not None:
            rgb = decoder.decode(frame.jpeg, min_width=width, min_height=height)
        elif frame.rgb is not None:
            rgb = frame.rgb
        else:  # pragma: no cover - a Frame holds one of the two
            raise CaptureError("the frame holds no picture")
        if rgb.shape[1] == width:
            return rgb
        return np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _lower_priority() -> None:
    """Gives this thread a lower priority than those of the pipeline."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
