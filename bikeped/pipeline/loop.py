"""The loop: frame, picture, detections, tracking, signal, messages.

Workers, each with one thread: one decodes, the others look (one, or two at a recording). At most
one picture waits between them, so that the next frame is decoded while the last one is looked at;
what they answer is judged in the frames' order. Everything else (ground, track,
decide, signal, queues) happens on the event loop and takes about a millisecond. `run` and `replay`
differ only in their feed and their clock.

FAULT is decided by a tick of its own, ten times a second, from the ages of the newest frame and
the newest answer: neither a camera nor a detector that has stopped can keep it from coming.

On a live feed no camera or detector error ends the loop, except `StageHangError`. A replay ends
with the first error.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from bikeped.detection.base import DetectionResult
from bikeped.errors import BikepedError, CaptureError, GeometryError
from bikeped.faults import Fault
from bikeped.feedback import assess
from bikeped.pipeline.detection_stage import DetectionStage, Picture
from bikeped.pipeline.feed import Feed
from bikeped.pipeline.latest_frame_slot import LatestFrameSlot, first_of
from bikeped.pipeline.rate_limited_log import RateLimitedLogger
from bikeped.pipeline.signal_dispatcher import SignalDispatcher
from bikeped.pipeline.track_and_decide import TrackAndDecide, TrackingResult
from bikeped.pipeline.worker_threads import WorkerThread
from bikeped.types import Detections, Frame, Signal

log = logging.getLogger(__name__)

#: Frames that do not decode for this long: the camera is opened anew.
RESTART_AFTER_S = 5.0
_WEIGHT = 0.2  #: of the newest duration in the usual one


class StageHangError(Exception):
    """A thread that cannot be ended does not return: only a new process helps."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(str(fault))
        self.fault = fault


@dataclass(frozen=True)
class FrameResult:
    """Everything that is known of one frame when the light has been told."""

    picture: Picture
    t_s: float  #: capture time since the first frame judged
    detections: Detections
    tracking: TrackingResult
    signal: Signal
    latency_ms: dict[str, float]


class Output(Protocol):
    """Takes results: telemetry, audit log, event file, overlay."""

    async def on_frame_result(self, result: FrameResult) -> None:
        """One frame's result. On a live feed it is only put aside: the loop waits for this."""


@dataclass(frozen=True)
class Limits:
    """When the loop loses its patience, in seconds."""

    stale_after_s: float = 0.5  #: no frame: FAULT
    silent_after_s: float = 0.5  #: no answer of the detector: FAULT
    hang_after_s: float = 15.0  #: a call that does not return, a detector that only fails: end
    tick_s: float = 0.1
    close_s: float = 2.0  #: how long a thread may take to end


@dataclass(frozen=True)
class _Look:
    """A picture that a worker looks at since `began_s`, and its future answer."""

    picture: Picture
    worker: WorkerThread
    began_s: float
    answer: asyncio.Future[DetectionResult]


@dataclass
class FrameCounts:
    """Totals since the start."""

    received: int = 0
    frames: int = 0  #: judged
    undecodable: int = 0
    failed: int = 0  #: the detector raised
    out_of_order: int = 0


class Loop:
    """Moves frames from `feed` to the light. `clock` gives seconds on the frames' time base."""

    def __init__(
        self,
        *,
        feed: Feed,
        detection: DetectionStage,
        track_and_decide: TrackAndDecide,
        dispatcher: SignalDispatcher,
        outputs: Sequence[Output] = (),
        limits: Limits = Limits(),
        clock: Callable[[], float] = time.monotonic,
        on_tick: Callable[[], None] = lambda: None,
        max_inflight: int = 1,
    ) -> None:
        """`max_inflight`: pictures that the detector may work on at once."""
        self._feed, self._detection, self._track_and_decide = feed, detection, track_and_decide
        self._dispatcher = dispatcher
        self._outputs = tuple(outputs)
        self._limits = limits
        self._clock = clock
        self._on_tick = on_tick
        self._looks_at_once = max_inflight
        self.counts = FrameCounts()
        self._limited_log = RateLimitedLogger(log)
        self._stop = asyncio.Event()
        # What is wrong now; the first text of a row of failures stays, so that one row is one fault
        self._geometry_fault: Fault | None = None
        self._decode_fault: tuple[Fault, float] | None = None
        self._detector_fault: tuple[Fault, float] | None = None
        self._answered_s: float | None = None  # capture time of the newest frame answered
        self._first_s: float | None = None  # capture time of the first frame judged
        self._judged_s: float | None = None  # capture time of the newest frame judged
        self._looking_since_s: float | None = None
        self._usual_look_s = self._usual_decode_s = 0.0

    def stop(self) -> None:
        """Ends `run`; callable from a signal handler."""
        self._stop.set()

    @property
    def stopping(self) -> bool:
        """Whether `stop` was called."""
        return self._stop.is_set()

    def dropped(self) -> int:
        """Frames replaced by a newer one before anybody looked."""
        return self._feed.dropped()

    def frame_age_s(self) -> float | None:
        """Age of the newest frame of a live feed; None before the first."""
        now_s = self._clock()
        newest_s = self._feed.newest_s(now_s)
        return None if newest_s is None else max(0.0, now_s - newest_s)

    async def run(self) -> None:
        """Runs until the recording ends or `stop` is called; the light is then dark.

        Raises StageHangError when a read or the detector has not returned for `hang_after_s`, and
        leaves the light in FAULT; for a recording also the error of a frame that cannot be judged
        (GeometryError, DetectorError). Threads that hang are left behind: they are daemons.
        """
        slot = LatestFrameSlot()
        decoder = WorkerThread("decode", self._clock)
        lookers = [WorkerThread("look", self._clock) for _ in range(self._looks_at_once)]
        looking = asyncio.create_task(self._look(slot, lookers), name="look")
        stopping = asyncio.create_task(self._stop.wait(), name="stop")
        tasks: set[asyncio.Task[None] | asyncio.Task[bool]] = {
            looking,
            stopping,
            asyncio.create_task(self._decode(slot, decoder), name="decode"),
        }
        if self._feed.live:
            tasks.add(asyncio.create_task(self._tick((decoder, *lookers)), name="tick"))
        try:
            pending = set(tasks)
            while not (looking.done() or stopping.done()):
                done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()  # a failure of any of them ends the loop
        except StageHangError as hang:
            self._dispatcher.step(self._clock(), None, (hang.fault,))
            raise
        except BaseException:
            self._dispatcher.off()
            raise
        else:
            self._dispatcher.off()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.gather(
                decoder.close(self._limits.close_s),
                *(looker.close(self._limits.close_s) for looker in lookers),
                self._feed.close(),
            )

    async def _decode(self, slot: LatestFrameSlot, worker: WorkerThread) -> None:
        while True:
            # Room first, then the frame: a live frame taken early would only grow old.
            await slot.room()
            await self._until_wanted()
            taken = await self._feed.next()
            if taken is None:
                slot.put(None)
                return
            frame, acquire_ms = taken
            self.counts.received += 1
            began = time.perf_counter()
            try:
                picture = await worker.submit(self._detection.decode, frame, began, acquire_ms)
            except CaptureError as error:
                self.counts.undecodable += 1
                self._limited_log.warn("decode", f"frame {frame.number} is skipped: {error}")
                self._decode_fault = self._decode_fault or (
                    Fault("camera", "camera.undecodable", f"frames do not decode ({error})"),
                    self._clock(),
                )
                continue
            self._decode_fault = None
            self._usual_decode_s += _WEIGHT * (picture.decode_ms / 1e3 - self._usual_decode_s)
            slot.put(picture)

    async def _until_wanted(self) -> None:
        """Waits while the detector is sure to be busy: what is taken too early ages in the slot.

        A recording does not age; there every wait would only cost throughput.
        """
        if self._feed.live and self._looking_since_s is not None:
            free_s = self._looking_since_s + self._usual_look_s
            ahead_s = 2 * self._usual_decode_s + 0.005
            await asyncio.sleep(min(max(free_s - ahead_s - time.perf_counter(), 0.0), 0.2))

    async def _look(self, slot: LatestFrameSlot, workers: Sequence[WorkerThread]) -> None:
        """Lets every worker look at a picture of its own, and judges them in their order."""
        free, looks = list(workers), deque[_Look]()
        try:
            while not (slot.ended and not looks):
                self._begin_looks(slot, free, looks)
                if not looks:
                    await slot.filled()
                    continue
                if free and not slot.ended:
                    await first_of(looks[0].answer, slot.filled())
                else:
                    await asyncio.wait({looks[0].answer})
                if not looks[0].answer.done():
                    continue
                look = looks.popleft()
                free.append(look.worker)
                self._looking_since_s = looks[0].began_s if looks else None
                answer = self._answer(look)
                # What waits already is looked at meanwhile: the detector is the slowest.
                self._begin_looks(slot, free, looks)
                if answer is not None:
                    await self._finish(look.picture, answer)
        finally:
            for look in looks:
                if not look.answer.cancel() and not look.answer.cancelled():
                    look.answer.exception()  # of an end that has a cause already

    def _begin_looks(
        self, slot: LatestFrameSlot, free: list[WorkerThread], looks: deque[_Look]
    ) -> None:
        """Hands what waits to whoever has nothing to look at."""
        while free and (picture := slot.take()) is not None:
            misfit = self._misfit(picture.frame)
            if self._feed.live:
                self._geometry_fault = (
                    None if misfit is None else Fault("geometry", "camera.frame_size", str(misfit))
                )
                if misfit is not None:
                    self._show()
                    continue
            worker, began_s = free.pop(), time.perf_counter()
            if misfit is None:
                answer = worker.submit(self._detection.detect, picture)
            else:
                # Ends the replay when the frames before it are judged.
                answer = asyncio.get_running_loop().create_future()
                answer.set_exception(misfit)
            looks.append(_Look(picture, worker, began_s, answer))
            self._looking_since_s = looks[0].began_s

    def _misfit(self, frame: Frame) -> GeometryError | None:
        """Why a frame of this size has no place on the ground, or None."""
        try:
            self._track_and_decide.ground_mapper.framing_for(frame.width, frame.height)
        except GeometryError as error:
            return error
        return None

    def _answer(self, look: _Look) -> DetectionResult | None:
        """What the detector says of a picture; None when a live one could not be looked at."""
        self._usual_look_s += _WEIGHT * (time.perf_counter() - look.began_s - self._usual_look_s)
        try:
            answer = look.answer.result()
        except Exception as error:
            if not self._feed.live:
                raise
            number = look.picture.frame.number
            self.counts.failed += 1
            if isinstance(error, BikepedError):
                self._limited_log.warn("detector", f"frame {number} is skipped: {error}")
            else:
                self._limited_log.failure("detector", error)
            self._detector_fault = self._detector_fault or (
                Fault("detector", "detector.error", str(error)),
                self._clock(),
            )
            return None
        self._detector_fault = None
        return answer

    async def _finish(self, picture: Picture, answer: DetectionResult) -> None:
        """Judges one answered frame, tells the light, and hands the result on."""
        frame = picture.frame
        if self._judged_s is not None and not frame.captured_s > self._judged_s:
            # A camera that was opened anew, on another clock. Its frames are believed again as soon
            # as they are newer; until then the silence becomes a FAULT.
            self.counts.out_of_order += 1
            self._limited_log.warn("order", f"frame {frame.number} is skipped: its time went back")
            return
        self._judged_s = frame.captured_s
        now_s = self._now(frame)
        tracking = self._track_and_decide.update(
            answer.detections,
            frame.width,
            frame.height,
            frame.captured_s,
            max(0.0, now_s - frame.captured_s),
        )
        self._answered_s = frame.captured_s
        self.counts.frames += 1
        began = time.perf_counter()
        signal = self._dispatcher.step(now_s, tracking.decision, self._faults(now_s))
        ended = time.perf_counter()
        stages = {
            "pre": picture.decode_ms + answer.pre_ms,
            "inference": answer.inference_ms,
            "post": answer.post_ms,
            "track": tracking.track_ms,
            "decide": tracking.decide_ms,
            "feedback": (ended - began) * 1e3,
        }
        # A recording is decoded ahead, as no camera could be: waiting is not latency.
        total_ms = (ended - picture.received_s) * 1e3 if self._feed.live else sum(stages.values())
        latency = {
            "acquire": picture.acquire_ms,
            **stages,
            "total": total_ms,
            "capture_age": total_ms + picture.acquire_ms,
        }
        if self._first_s is None:
            self._first_s = frame.captured_s
        t_s = frame.captured_s - self._first_s
        result = FrameResult(picture, t_s, answer.detections, tracking, signal, latency)
        for output in self._outputs:
            await self._hand_on(output, result)

    async def _hand_on(self, output: Output, result: FrameResult) -> None:
        try:
            await output.on_frame_result(result)
        except Exception as error:
            if not self._feed.live:
                raise
            self._limited_log.failure("output", error)

    def _now(self, frame: Frame) -> float:
        """Live: the clock. A recording has no other time than its own."""
        return self._clock() if self._feed.live else frame.captured_s

    def _show(self) -> None:
        """Shows what a moment without a new decision leads to."""
        now_s = self._clock()
        self._dispatcher.step(now_s, None, self._faults(now_s))

    def _faults(self, now_s: float) -> tuple[Fault, ...]:
        """Why the light must not trust the decision; empty when it may."""
        if not self._feed.live:
            return ()
        explicit = [self._geometry_fault] if self._geometry_fault else []
        error = self._feed.error()
        if error is not None:
            explicit.append(Fault("camera", "camera.error", error))
        faults = (
            *assess(
                now_s,
                self._feed.newest_s(now_s),
                self._answered_s,
                self._limits.stale_after_s,
                self._limits.silent_after_s,
            ),
            *explicit,
        )
        if not faults:  # one bad frame among good ones is no fault
            return ()
        causes = [cause[0] for cause in (self._decode_fault, self._detector_fault) if cause]
        return (*faults, *causes)

    async def _tick(self, workers: Sequence[WorkerThread]) -> None:
        """Judges the silence between frames, and whether a thread is stuck."""
        limit_s = self._limits.hang_after_s
        while True:
            await asyncio.sleep(self._limits.tick_s)
            self._show()
            self._on_tick()
            now_s = self._clock()
            if self._feed.hung_s(now_s) > limit_s:
                detail = f"a read has not returned for {limit_s:g} s"
                raise StageHangError(Fault("camera", "camera.hang", detail))
            if max(worker.busy_s(now_s) for worker in workers) > limit_s:
                raise StageHangError(
                    Fault("detector", "detector.hang", f"has not returned for {limit_s:g} s")
                )
            # A GPU that has failed once may fail until the process ends.
            if self._detector_fault is not None and now_s - self._detector_fault[1] > limit_s:
                detail = f"{self._detector_fault[0].detail} (for {limit_s:g} s)"
                raise StageHangError(Fault("detector", "detector.failing", detail))
            if self._decode_fault is not None and (now_s - self._decode_fault[1] > RESTART_AFTER_S):
                self._decode_fault = (self._decode_fault[0], now_s)
                self._feed.restart()
