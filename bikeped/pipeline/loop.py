"""The loop, and the result of a frame that it hands on.

`Loop` wires feed, detection, tracking and decision, the signal and the listeners.
`DetectionScheduler` decodes and detects in threads. The rest (ground, track, decide, signal,
queues) happens on the event loop and takes about a millisecond a frame. `run` and `replay` differ
only in their feed and their clock.

Faults are checked with every frame and ten times a second: neither a camera nor a detector that
has stopped can prevent FAULT. On a live feed no camera or detector error ends the loop, except
`StageHangError`. A replay ends with the first error.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bikeped.capture.frame_grabber import FUTURE_S
from bikeped.detection.detector import DetectionResult
from bikeped.faults import Fault
from bikeped.monitor.verdicts import Verdict
from bikeped.overlay.overlay_data import GroundToFrame, OverlayData, ground_projector
from bikeped.pipeline.detection_scheduler import (
    DecodedFrame,
    DetectionScheduler,
    DetectionStage,
    FrameCounts,
)
from bikeped.pipeline.detector_watch import DetectorWatch
from bikeped.pipeline.fault_monitor import DEFAULT_LIMITS, FaultMonitor, Limits, StageHangError
from bikeped.pipeline.feed import Feed
from bikeped.pipeline.runtime import RateLimitedLogger
from bikeped.pipeline.signal_dispatcher import SignalDispatcher
from bikeped.pipeline.track_and_decide import TrackAndDecide, TrackingResult
from bikeped.types import Detections, Signal

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FrameResult:
    """One frame on its whole way; `t_s` is its capture time since the first result."""

    decoded: DecodedFrame
    t_s: float
    detections: Detections
    tracking: TrackingResult
    signal: Signal
    latency_ms: dict[str, float]  #: by stage, with `total` and `capture_age`


class FrameResultListener(Protocol):
    """Takes frame results: telemetry, audit log, event file, overlay."""

    async def on_frame_result(self, result: FrameResult) -> None:
        """One frame's result. On a live feed it is only queued: the loop waits for this."""


def stage_latencies(
    decoded: DecodedFrame,
    answer: DetectionResult,
    tracking: TrackingResult,
    feedback_ms: float,
    total_ms: float | None,
) -> dict[str, float]:
    """Milliseconds by stage: the paper's, `acquire`, their `total`, and `capture_age`.

    `total_ms` is measured from taking the frame over to setting the light; None sums the stages,
    as for a recording: it is decoded ahead, as no camera could be, and waiting is no latency.
    """
    stages = {
        "pre": decoded.decode_ms + answer.pre_ms,
        "inference": answer.inference_ms,
        "post": answer.post_ms,
        "track": tracking.track_ms,
        "decide": tracking.decide_ms,
        "feedback": feedback_ms,
    }
    total_ms = sum(stages.values()) if total_ms is None else total_ms
    return {
        "acquire": decoded.acquire_ms,
        **stages,
        "total": total_ms,
        "capture_age": total_ms + decoded.acquire_ms,
    }


def frame_overlay(
    result: FrameResult, track_and_decide: TrackAndDecide, signal: Signal | None = None
) -> tuple[OverlayData, GroundToFrame]:
    """The data to draw, and the projection of ground points into the frame.

    `signal` None: shown as the decision's state. Call it on the event loop: the tracker's history
    changes with the next frame.
    """
    frame, tracking = result.decoded.frame, result.tracking
    data = OverlayData(
        detections=result.detections,
        tracks=tracking.tracks,
        decision=tracking.decision,
        frame_number=frame.number,
        time_s=result.t_s,
        signal=signal,
        latency_s=result.latency_ms["total"] / 1e3,
        history={key: np.asarray(xy) for key, xy in track_and_decide.tracker.history().items()},
    )
    mapper = track_and_decide.ground_mapper
    return data, ground_projector(mapper.camera, mapper.framing_for(frame.width, frame.height))


class Loop:
    """Moves frames from `feed` to the light. `clock` gives seconds on the frames' time base.

    `fault_sources` are asked for faults of other parts (see `FaultMonitor`); `watch` sees whether
    the detector is blind.
    """

    def __init__(
        self,
        *,
        feed: Feed,
        detection: DetectionStage,
        track_and_decide: TrackAndDecide,
        dispatcher: SignalDispatcher,
        outputs: Sequence[FrameResultListener] = (),
        limits: Limits = DEFAULT_LIMITS,
        clock: Callable[[], float] = time.monotonic,
        on_tick: Callable[[], None] = lambda: None,
        fault_sources: Sequence[Callable[[], Fault | None]] = (),
        watch: DetectorWatch | None = None,
    ) -> None:
        self.feed, self._detection, self._track_and_decide = feed, detection, track_and_decide
        self._dispatcher, self._outputs = dispatcher, tuple(outputs)
        self._limits, self._clock, self._on_tick = limits, clock, on_tick
        sources = (*fault_sources, lambda: None if watch is None else watch.fault)
        self.monitor, self.watch = FaultMonitor(feed, limits, sources), watch
        self.counts = FrameCounts()
        self._limited_log = RateLimitedLogger(log)
        self.stopping = asyncio.Event()  #: set it to end `run`
        self._first_s: float | None = None  # capture time of the first result
        self._newest_s = -math.inf  # capture time of the newest result

    def verdicts(self) -> tuple[Verdict, ...]:
        """All checks of the newest picture, and of the detector where it is watched."""
        watched = () if self.watch is None else (self.watch.verdict,)
        return (*self.monitor.picture.verdicts, *watched)

    def frame_age_s(self) -> float | None:
        """Age of the newest frame of a live feed; None before the first."""
        age_s = self.feed.age_s(self._clock())
        return max(0.0, age_s) if math.isfinite(age_s) else None

    async def run(self) -> None:
        """Runs until the recording ends or `stopping` is set; the light is then dark.

        Raises StageHangError when a stage hangs that only a new process can free, and
        leaves the light in FAULT; for a recording also the error of a frame that cannot be
        processed (GeometryError, DetectorError). Threads that hang are left behind: they are
        daemons.
        """
        scheduler = DetectionScheduler(
            self.feed,
            self._detection,
            self.monitor,
            self.counts,
            self._track_and_decide.ground_mapper,
            self._process,
            self._clock,
            self.watch,
        )
        detecting = asyncio.create_task(scheduler.detect_frames(), name="detect")
        stopping = asyncio.create_task(self.stopping.wait(), name="stop")
        tasks: set[asyncio.Task[None] | asyncio.Task[bool]] = {
            detecting,
            stopping,
            asyncio.create_task(scheduler.decode_frames(), name="decode"),
        }
        if self.feed.live:
            tasks.add(asyncio.create_task(self._tick(scheduler), name="tick"))
        try:
            pending = set(tasks)
            while not (detecting.done() or stopping.done()):
                done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()  # a failure of any of them ends the loop
        except StageHangError as hang:
            self._dispatcher.dispatch(self._clock(), None, (hang.fault,))
            raise
        except BaseException:
            self._dispatcher.switch_off()
            raise
        else:
            self._dispatcher.switch_off()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.gather(scheduler.close(self._limits.close_s), self.feed.close())

    async def _process(self, decoded: DecodedFrame, answer: DetectionResult | None) -> None:
        """Tracks and decides one answered frame, sets the light, and passes the result on."""
        if answer is None:
            self._show_without_frame()
            return
        frame = decoded.frame
        # A recording has no other time than its own.
        now_s = self._clock() if self.feed.live else frame.captured_s
        if not self._newest_s < frame.captured_s <= now_s + FUTURE_S:
            # A repeated frame, or one of another clock, which must not count as the newest either:
            # later ones would look old. Without others the missing answers become a FAULT.
            self.counts.out_of_order += 1
            why = "its time is not newer, or lies in the future"
            self._limited_log.warn("order", f"frame {frame.number} is skipped: {why}")
            return
        self._newest_s = frame.captured_s
        age_s = max(0.0, now_s - frame.captured_s)
        tracking = self._track_and_decide.update(
            answer.detections, frame.width, frame.height, frame.captured_s, age_s
        )
        if self.watch is not None:
            await self.watch.on_answer(decoded, answer.detections)
        self.monitor.processed(frame.captured_s, decoded.checks, now_s)
        self.counts.frames += 1
        began = time.perf_counter()
        signal = self._dispatcher.dispatch(now_s, tracking.decision, self.monitor.faults(now_s))
        ended = time.perf_counter()
        total_ms = (ended - decoded.received_s) * 1e3 if self.feed.live else None
        latency_ms = stage_latencies(decoded, answer, tracking, (ended - began) * 1e3, total_ms)
        if self._first_s is None:
            self._first_s = frame.captured_s
        t_s = frame.captured_s - self._first_s
        result = FrameResult(decoded, t_s, answer.detections, tracking, signal, latency_ms)
        for listener in self._outputs:
            await self._pass_on(result, listener)

    async def _pass_on(self, result: FrameResult, listener: FrameResultListener) -> None:
        try:
            await listener.on_frame_result(result)
        except Exception as error:
            if not self.feed.live:
                raise
            self._limited_log.failure("output", error)

    def _show_without_frame(self) -> None:
        """Updates the signal without a new decision."""
        now_s = self._clock()
        self._dispatcher.dispatch(now_s, None, self.monitor.faults(now_s))

    async def _tick(self, scheduler: DetectionScheduler) -> None:
        """Checks ages and hanging threads between frames."""
        while True:
            await asyncio.sleep(self._limits.tick_s)
            self._show_without_frame()
            self._on_tick()
            self.monitor.check_stages(self._clock(), scheduler.workers)
