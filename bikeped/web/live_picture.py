"""The live page's picture: drawn in a thread of low priority, at a bounded rate, for lookers only.

It decodes the frame once more, at the size that people need: what the detector gets, and when, does
not depend on who looks.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from collections.abc import Iterator, Mapping

import cv2
import numpy as np

from bikeped.capture.jpeg import JpegDecoder
from bikeped.errors import CaptureError
from bikeped.overlay import OverlayData, draw_overlay, encode_jpeg, ground_projector
from bikeped.pipeline.frame_result import FrameResult
from bikeped.pipeline.rate_limited_log import RateLimitedLogger
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.pipeline.worker_threads import WorkerThread
from bikeped.types import FloatArray, ImageArray, Signal
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
        self._lookers = 0
        self._painting: asyncio.Task[None] | None = None
        self._limited_log = RateLimitedLogger(log)
        self._fresh = asyncio.Event()
        self.jpeg: bytes | None = None
        self.number = 0  #: of the picture in `jpeg`
        self.drawn = 0  #: pictures drawn since the start

    @contextlib.contextmanager
    def looking(self) -> Iterator[None]:
        """While somebody is in here, pictures are drawn."""
        self._lookers += 1
        if self._painting is None:
            self.jpeg = None  # the last one may be hours old
            self._painting = asyncio.create_task(self._paint(), name="paint")
        try:
            yield
        finally:
            self._lookers -= 1
            if self._lookers == 0 and self._painting is not None:
                self._painting.cancel()
                self._painting = None

    async def next(self, since: int) -> tuple[int, bytes] | None:
        """The newest picture after picture number `since`; None when there will be none."""
        while not self._state.closed:
            if self.jpeg is not None and self.number != since:
                return self.number, self.jpeg
            await self._fresh.wait()
        return None

    def close(self) -> None:
        """Lets everybody go who waits; after the state was closed."""
        self._tell()

    def _tell(self) -> None:
        self._fresh.set()
        self._fresh = asyncio.Event()

    async def _paint(self) -> None:
        worker, decoder = WorkerThread("paint"), JpegDecoder(buffers=1)
        worker.submit(_step_back)
        frames = -1
        try:
            while not self._state.closed:
                await self._state.next_frame(frames)
                frames, result = self._state.frames, self._state.result
                if result is None:
                    continue
                began_s = time.monotonic()
                try:
                    self.jpeg = await worker.submit(
                        self._draw, decoder, result, self._state.signal_now, self._trails()
                    )
                except Exception as error:  # noqa: BLE001 - a picture less, never more
                    self._limited_log.failure("paint", error)
                else:
                    self.number += 1
                    self.drawn += 1
                    self._tell()
                rest_s = self._interval_s - (time.monotonic() - began_s)
                await asyncio.sleep(max(rest_s, 0.0))
        finally:
            await asyncio.shield(worker.close(0.0))

    def _trails(self) -> Mapping[int, FloatArray]:
        return {
            key: np.asarray(value)
            for key, value in self._track_and_decide.tracker.history().items()
        }

    def _draw(
        self,
        decoder: JpegDecoder,
        result: FrameResult,
        signal: Signal | None,
        history: Mapping[int, FloatArray],
    ) -> bytes:
        frame, tracking = result.decoded.frame, result.tracking
        overlay_data = OverlayData(
            detections=result.detections,
            tracks=tracking.tracks,
            decision=tracking.decision,
            frame_number=frame.number,
            time_s=result.t_s,
            signal=signal,
            latency_s=result.latency_ms["total"] / 1e3,
            history=history,
        )
        small = self._picture(decoder, result)
        framing = self._track_and_decide.ground_mapper.framing_for(frame.width, frame.height)
        return encode_jpeg(
            draw_overlay(
                small,
                overlay_data,
                scale=small.shape[1] / frame.width,
                ground_to_frame=ground_projector(
                    self._track_and_decide.ground_mapper.camera, framing
                ),
                banner=False,
            ),
            _QUALITY,
        )

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


def _step_back() -> None:
    """Gives this thread a lower priority than those of the pipeline."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
