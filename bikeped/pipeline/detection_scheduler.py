"""From frames to detections: decoding and detecting in threads, and which frame when.

One decoded frame may wait; the results keep the frames' order.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, Protocol

from bikeped.capture.jpeg import JpegDecoder
from bikeped.detection.detector import DetectionResult, Detector
from bikeped.errors import BikepedError, CaptureError, GeometryError
from bikeped.pipeline.fault_monitor import FaultMonitor
from bikeped.pipeline.feed import Feed
from bikeped.pipeline.picture_monitor import NO_CHECKS, PictureChecks, PictureMonitor
from bikeped.pipeline.runtime import RateLimitedLogger, WorkerThread
from bikeped.pipeline.track_and_decide import GroundMapper
from bikeped.types import Frame, ImageArray

log = logging.getLogger(__name__)

_NEWEST_WEIGHT = 0.2  #: of the newest duration in the usual one

#: Inferences at once on a recording, where the processor does them: see `load_detector_pool`.
MAX_INFLIGHT = 2
#: A check of the detector waits so long for a moment without a waiting frame, where an inference
#: takes at most so long: a slower one would make the frame that then waits too old for the light.
_CHECK_WAITS_S, _CHECK_DELAYS_S = 5.0, 0.12
#: Decoded frames in use at once: being decoded, waiting, processed, drawn, a spare, and detected.
FRAME_BUFFERS = 5 + MAX_INFLIGHT
#: A picture narrower than this hides that it is blurred.
MONITOR_WIDTH = 320


@dataclass(frozen=True)
class DecodedFrame:
    """A decoded frame; `rgb` may be a scaled copy and is valid for the next `FRAME_BUFFERS` - 1."""

    frame: Frame
    rgb: ImageArray
    received_s: float  #: time.perf_counter() when the frame was taken over
    acquire_ms: float
    decode_ms: float
    checks: PictureChecks = NO_CHECKS


class FrameDetector(Protocol):
    """What finds road users in a frame: a model, or the demo's reader of drawn boxes."""

    name: str
    model_hash: str | None
    cyclist_box_includes_rider: bool

    def decode_size(self, width: int, height: int) -> tuple[int, int]:
        """Smallest width and height that it needs of a frame of this size, in pixels."""

    def detect(self, decoded: DecodedFrame) -> DetectionResult:
        """What is in the frame; raises DetectorError. Called in up to `max_inflight` threads."""


class DetectorChecker(Protocol):
    """Says when known answers should go through the detector, and learns what came of it."""

    def check_picture(self, waits_s: float) -> DecodedFrame | None:
        """The picture to check with, where a check has been due for `waits_s` seconds."""

    def checked(self, answer: DetectionResult | None) -> None:
        """The detector's answer; None where it failed."""


class DetectorPool:
    """A detector model, in as many copies as frames are detected at once."""

    def __init__(self, *detectors: Detector) -> None:
        first = detectors[0]
        self.name = first.name
        self.model_hash: str | None = first.model_hash
        self.cyclist_box_includes_rider = first.cyclist_box_includes_rider
        self.max_inflight = len(detectors)
        self.decode_size, self.region = first.decode_size, first.region
        self._free: queue.SimpleQueue[Detector] = queue.SimpleQueue()
        for detector in detectors:
            self._free.put(detector)

    def detect(self, decoded: DecodedFrame) -> DetectionResult:
        detector = self._free.get()
        try:
            return detector.infer(decoded.rgb, decoded.frame.width, decoded.frame.height)
        finally:
            self._free.put(detector)


class DetectionStage:
    """Decodes at the smallest scale that the detector needs, checks the picture, and detects.

    `view_width`: pixels that a picture for people needs; the monitor needs `MONITOR_WIDTH`.
    `decode` belongs to one thread, `detect` to one or more others.
    """

    def __init__(
        self,
        detector: FrameDetector,
        view_width: int = 0,
        picture_monitor: PictureMonitor | None = None,
    ) -> None:
        self.detect = detector.detect
        self.max_inflight = detector.max_inflight if isinstance(detector, DetectorPool) else 1
        self._decode_size = detector.decode_size
        self.picture_monitor = picture_monitor
        self._view_width = view_width if picture_monitor is None else max(view_width, MONITOR_WIDTH)
        self._jpeg = JpegDecoder(buffers=FRAME_BUFFERS)

    def decode(self, frame: Frame, received_s: float, acquire_ms: float) -> DecodedFrame:
        """The decoded frame; raises CaptureError when it does not decode."""
        began = time.perf_counter()
        rgb = frame.rgb
        if rgb is None:
            assert frame.jpeg is not None  # noqa: S101  Frame holds one of the two
            width, height = self._decode_size(frame.width, frame.height)
            view = min(self._view_width, frame.width)
            if view > width:
                width, height = view, max(height, round(frame.height * view / frame.width))
            rgb = self._jpeg.decode(frame.jpeg, min_width=width, min_height=height)
        decode_ms = (time.perf_counter() - began) * 1e3
        checks = NO_CHECKS
        if self.picture_monitor is not None:
            checks = self.picture_monitor.update(rgb, frame.captured_s)
        return DecodedFrame(frame, rgb, received_s, acquire_ms, decode_ms, checks)


@dataclass
class FrameCounts:
    """Totals since the start."""

    received: int = 0
    frames: int = 0  #: that led to a decision
    undecodable: int = 0
    failed: int = 0  #: the detector raised
    out_of_order: int = 0


class LatestFrameSlot:
    """Holds at most one decoded frame; None, put last, is the end."""

    def __init__(self) -> None:
        self._item: DecodedFrame | None = None
        self.empty = asyncio.Event()
        self.full = asyncio.Event()  #: also set at the end
        self.empty.set()
        self.ended = False

    def put(self, item: DecodedFrame | None) -> None:
        """Fills the slot."""
        self._item = item
        self.ended = item is None
        self.empty.clear()
        self.full.set()

    def get_nowait(self) -> DecodedFrame | None:
        """The frame, if there is one now."""
        item, self._item = self._item, None
        if item is not None:
            self.full.clear()
            self.empty.set()
        return item


@dataclass(frozen=True)
class _InFlight:
    """A frame that a detector thread works on since `began_s`, and its future answer."""

    decoded: DecodedFrame
    worker: WorkerThread
    began_s: float
    answer: asyncio.Future[DetectionResult]


class DetectionScheduler:
    """Takes frames from `feed`, decodes and detects them in threads, awaits `on_answer` for each.

    One thread decodes, `max_inflight` threads detect. On a live feed a frame that fails, or does
    not fit the camera of `ground_mapper`, has the answer None and is reported to `monitor`; in a
    recording the error ends `detect_frames`, after the frames before it were passed on.

    The pictures of `checker` are detected between frames: a frame that comes meanwhile waits for at
    most one inference, and none is lost.
    """

    def __init__(
        self,
        feed: Feed,
        detection: DetectionStage,
        monitor: FaultMonitor,
        counts: FrameCounts,
        ground_mapper: GroundMapper,
        on_answer: Callable[[DecodedFrame, DetectionResult | None], Awaitable[None]],
        clock: Callable[[], float],
        checker: DetectorChecker | None = None,
    ) -> None:
        self._feed, self._detection, self._checker = feed, detection, checker
        self._monitor, self._counts = monitor, counts
        self._ground_mapper, self._on_answer, self._clock = ground_mapper, on_answer, clock
        self._slot = LatestFrameSlot()
        self._decoder = WorkerThread("decode", clock)
        self._idle = [WorkerThread("detect", clock) for _ in range(detection.max_inflight)]
        self.workers = (self._decoder, *self._idle)
        self._inflight = deque[_InFlight]()
        self._check: _InFlight | None = None
        self._usual_detect_s = self._usual_decode_s = 0.0
        self._limited_log = RateLimitedLogger(log)

    async def close(self, timeout_s: float) -> None:
        """Ends the threads; one that hangs is left behind after `timeout_s`."""
        await asyncio.gather(*(worker.close(timeout_s) for worker in self.workers))

    async def decode_frames(self) -> None:
        """Decodes frame after frame, until the feed ends."""
        while True:
            # Room first, then the frame: a live frame taken early would only grow old.
            await self._slot.empty.wait()
            await self._wait_for_detector()
            taken = await self._feed.next_frame()
            if taken is None:
                self._slot.put(None)
                return
            frame, acquire_ms = taken
            self._counts.received += 1
            began = time.perf_counter()
            try:
                decoded = await self._decoder.submit(
                    self._detection.decode, frame, began, acquire_ms
                )
            except CaptureError as error:
                self._counts.undecodable += 1
                self._limited_log.warn("decode", f"frame {frame.number} is skipped: {error}")
                detail = f"frames do not decode ({error})"
                self._monitor.record("camera.undecodable", "camera", detail, self._clock())
                continue
            self._monitor.record("camera.undecodable", "camera", None, self._clock())
            self._usual_decode_s += _NEWEST_WEIGHT * (
                decoded.decode_ms / 1e3 - self._usual_decode_s
            )
            self._slot.put(decoded)

    async def _wait_for_detector(self) -> None:
        """Waits until the detector is nearly free: a live frame taken earlier ages in the slot.

        A recording does not age; there a wait would only cost throughput.
        """
        if self._feed.live and self._inflight:
            free_s = self._inflight[0].began_s + self._usual_detect_s
            ahead_s = 2 * self._usual_decode_s + 0.005
            await asyncio.sleep(min(max(free_s - ahead_s - time.perf_counter(), 0.0), 0.2))

    async def detect_frames(self) -> None:
        """Keeps every detector thread busy and passes the answers on in the frames' order."""
        slot, inflight = self._slot, self._inflight
        try:
            while not (slot.ended and not inflight):
                self._dispatch()
                full = asyncio.ensure_future(slot.full.wait())
                news: set[asyncio.Future[Any]] = {inflight[0].answer} if inflight else set()
                if self._check is not None:
                    news.add(self._check.answer)
                if self._idle and not slot.ended:
                    news.add(full)
                try:
                    await asyncio.wait(news, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    full.cancel()
                self._end_check()
                if not (inflight and inflight[0].answer.done()):
                    continue
                oldest = inflight.popleft()
                self._idle.append(oldest.worker)
                answer = self._result(oldest)
                if not self._feed.live:  # at the same frame in every replay
                    self._begin_check()
                    if self._check is not None:
                        await asyncio.wait({self._check.answer})
                        self._end_check()
                # The next frame is detected while this one is processed: detection takes longest.
                self._dispatch()
                await self._on_answer(oldest.decoded, answer)
        finally:
            for frame in (*inflight, *([self._check] if self._check else [])):
                if not frame.answer.cancel() and not frame.answer.cancelled():
                    frame.answer.exception()  # retrieved, so that asyncio does not log it

    def _dispatch(self) -> None:
        """Hands the waiting frame to an idle detector thread; a check where none waits."""
        if self._feed.live and not self._inflight:
            waits = self._slot.full.is_set()
            if not waits or self._usual_detect_s < _CHECK_DELAYS_S:
                self._begin_check(_CHECK_WAITS_S if waits else 0.0)
        while self._idle and (decoded := self._slot.get_nowait()) is not None:
            worker, began_s = self._idle.pop(), time.perf_counter()
            answer = worker.submit(self._detect, decoded)
            self._inflight.append(_InFlight(decoded, worker, began_s, answer))

    def _begin_check(self, waits_s: float = 0.0) -> None:
        """Hands the check picture to an idle detector thread where a check is due."""
        if self._checker is None or self._check is not None or not self._idle or self._slot.ended:
            return
        picture = self._checker.check_picture(waits_s)
        if picture is not None:
            worker = self._idle.pop()
            answer = worker.submit(self._detection.detect, picture)
            self._check = _InFlight(picture, worker, time.perf_counter(), answer)

    def _end_check(self) -> None:
        """Passes on what came of a check that has ended."""
        if self._checker is None or self._check is None or not self._check.answer.done():
            return
        check, self._check = self._check, None
        self._idle.append(check.worker)
        error = check.answer.exception()
        if error is not None:
            self._limited_log.failure("check", error)
        self._checker.checked(None if error is not None else check.answer.result())

    def _detect(self, decoded: DecodedFrame) -> DetectionResult:
        self._ground_mapper.framing_for(decoded.frame.width, decoded.frame.height)  # may raise
        return self._detection.detect(decoded)

    def _result(self, done: _InFlight) -> DetectionResult | None:
        """The detector's answer; None when it failed on a live frame, or the frame did not fit."""
        took_s, now_s = time.perf_counter() - done.began_s, self._clock()
        self._usual_detect_s += _NEWEST_WEIGHT * (took_s - self._usual_detect_s)
        error, number = done.answer.exception(), done.decoded.frame.number
        if error is not None and not self._feed.live:
            raise error
        misfit = str(error) if isinstance(error, GeometryError) else None
        self._monitor.record("camera.frame_size", "geometry", misfit, now_s)
        if misfit is not None:
            return None
        failure = None if error is None else str(error)
        self._monitor.record("detector.error", "detector", failure, now_s)
        if error is None:
            return done.answer.result()
        self._counts.failed += 1
        if isinstance(error, BikepedError):
            self._limited_log.warn("detector", f"frame {number} is skipped: {error}")
        else:
            self._limited_log.failure("detector", error)
        return None
