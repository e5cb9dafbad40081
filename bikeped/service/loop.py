"""The loop: frame, picture, detections, judgement, signal, messages.

Two workers, each with one thread: one decodes, one looks. At most one picture waits between them,
so that the next frame is decoded while the last one is looked at. Everything else (ground, track,
decide, signal, queues) happens on the event loop and takes about a millisecond. `run` and `replay`
differ only in their feed and their clock.

FAULT is decided by a tick of its own, ten times a second, from the ages of the newest frame and
the newest answer: neither a camera nor a detector that has stopped can keep it from coming.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Protocol

from bikeped.detection.base import DetectorAnswer
from bikeped.errors import CaptureError, DetectorError, GeometryError
from bikeped.feedback import LightDriver, SignalLogic, Speaker, assess
from bikeped.service.feed import Feed
from bikeped.service.judge import Judge, Judgement
from bikeped.service.vision import Decoder, Eye, Picture
from bikeped.types import Detections, Frame, Signal, State

log = logging.getLogger(__name__)

TICK_S = 0.1


class Hung(Exception):  # noqa: N818  a state to leave, not an error of the user's
    """A thread that cannot be ended does not return: only a new process helps."""


@dataclass(frozen=True)
class Outcome:
    """Everything that is known of one frame when the light has been told."""

    picture: Picture
    detections: Detections
    judgement: Judgement
    signal: Signal
    latency_ms: dict[str, float]


class Output(Protocol):
    """Takes outcomes: telemetry, audit log, event file, overlay. Must not block when live."""

    async def frame(self, outcome: Outcome) -> None:
        """One frame's outcome. A live output only puts it aside."""

    def signal(self, signal: Signal, sentence: str) -> None:
        """What the light shows now, with every frame and every tick."""


@dataclass
class Counts:
    """Totals since the start."""

    frames: int = 0  #: judged
    undecodable: int = 0
    failed: int = 0  #: the detector raised
    out_of_order: int = 0
    received: int = 0
    last_errors: dict[str, str] = field(default_factory=dict)


class Loop:
    """Moves frames from `feed` to the light. `clock` gives seconds on the frames' time base."""

    def __init__(
        self,
        *,
        feed: Feed,
        decoder: Decoder,
        eye: Eye,
        judge: Judge,
        logic: SignalLogic,
        light: LightDriver | None,
        speaker: Speaker | None,
        outputs: list[Output],
        stale_after_s: float = 0.5,
        silent_after_s: float = 0.5,
        hang_after_s: float = 15.0,
        clock: Callable[[], float] = time.monotonic,
        on_tick: Callable[[], None] = lambda: None,
    ) -> None:
        self._feed, self._decoder, self._eye, self._judge = feed, decoder, eye, judge
        self._logic, self._light, self._speaker = logic, light, speaker
        self._outputs = outputs
        self._stale_after_s, self._silent_after_s = stale_after_s, silent_after_s
        self._hang_after_s = hang_after_s
        self._clock = clock
        self._on_tick = on_tick
        self.counts = Counts()
        self.last_answer_s: float | None = None  #: capture time of the newest frame answered
        self.last_frame_size: tuple[int, int] | None = None
        self.shown: Signal | None = None
        self._geometry_fault: str | None = None
        self._sentence = ""
        self._looking_since: float | None = None
        self._stop = asyncio.Event()

    def stop(self) -> None:
        """Ends `run` after the frame in hand; callable from a signal handler."""
        self._stop.set()

    async def run(self) -> None:
        """Runs until the recording ends or `stop` is called.

        Raises Hung when a read or the detector has not returned for `hang_after_s`; for a
        recording also the error of a frame that cannot be judged (GeometryError, DetectorError).
        """
        slot = _Slot()
        pools = [ThreadPoolExecutor(1, thread_name_prefix=name) for name in ("decode", "look")]
        looking = asyncio.create_task(self._look(slot, pools[1]), name="look")
        tasks = {
            looking,
            asyncio.create_task(self._decode(slot, pools[0]), name="decode"),
            asyncio.create_task(self._stop.wait(), name="stop"),
        }
        stopping = next(task for task in tasks if task.get_name() == "stop")
        if self._feed.live:
            tasks.add(asyncio.create_task(self._tick(), name="tick"))
        hung = False
        try:
            pending = set(tasks)
            while not (looking.done() or stopping.done()):
                done, pending = await asyncio.wait(pending, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()  # a failure of any of them ends the loop
        except Hung:
            hung = True
            raise
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            for pool in pools:  # a hung thread cannot be joined: the process ends without it
                pool.shutdown(wait=not hung, cancel_futures=True)
            if not hung:
                await self._feed.close()

    async def _decode(self, slot: _Slot, pool: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        while True:
            # Room first, then the frame: a live frame taken early would only grow old.
            await slot.room()
            taken = await self._feed.next()
            if taken is None:
                slot.put(None)
                return
            frame, acquire_ms = taken
            self.counts.received += 1
            began = time.perf_counter()
            try:
                picture = await loop.run_in_executor(
                    pool, self._decoder.decode, frame, began, acquire_ms
                )
            except CaptureError as error:
                self.counts.undecodable += 1
                self._say("decode", str(error))
                continue
            slot.put(picture)

    async def _look(self, slot: _Slot, pool: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        while True:
            picture = await slot.take()
            if picture is None:
                return
            self._looking_since = time.monotonic()
            try:
                answer = await loop.run_in_executor(pool, self._eye.see, picture)
            except DetectorError as error:
                if not self._feed.live:
                    raise
                self.counts.failed += 1
                self._say("detector", str(error))
                continue
            finally:
                self._looking_since = None
            await self._finish(picture, answer)

    async def _finish(self, picture: Picture, answer: DetectorAnswer) -> None:
        """Judges one answered frame, tells the light, and hands the outcome on."""
        frame = picture.frame
        now_s = self._now(frame)
        self.last_frame_size = (frame.width, frame.height)
        try:
            judgement = self._judge.judge(
                answer.detections,
                frame.width,
                frame.height,
                frame.captured_s,
                max(0.0, now_s - frame.captured_s),
            )
        except GeometryError as error:
            if not self._feed.live:
                raise
            self._geometry_fault = f"geometry: {error}"
            self._show(now_s, None)
            return
        except ValueError as error:  # a time stamp that went back: a camera that was reopened
            self.counts.out_of_order += 1
            self._say("order", str(error))
            return
        self._geometry_fault = None
        self.last_answer_s = frame.captured_s
        self.counts.frames += 1
        began = time.perf_counter()
        self._sentence = judgement.decision.sentence
        signal = self._show(now_s, judgement.decision.state)
        ended = time.perf_counter()
        latency = {
            "acquire": picture.acquire_ms,
            "pre": picture.decode_ms + answer.pre_ms,
            "inference": answer.inference_ms,
            "post": answer.post_ms,
            "track": judgement.track_ms,
            "decide": judgement.decide_ms,
            "feedback": (ended - began) * 1e3,
            "total": (ended - picture.received_s) * 1e3,
            "capture_age": (ended - picture.received_s) * 1e3 + picture.acquire_ms,
        }
        outcome = Outcome(picture, answer.detections, judgement, signal, latency)
        for output in self._outputs:
            await output.frame(outcome)

    def dropped(self) -> int:
        """Frames replaced by a newer one before anybody looked."""
        return self._feed.dropped()

    def _now(self, frame: Frame) -> float:
        """Live: the clock. A recording has no other time than its own."""
        return self._clock() if self._feed.live else frame.captured_s

    def faults(self, now_s: float) -> tuple[str, ...]:
        """Why the light must not trust the decision; empty when it may."""
        if not self._feed.live:
            return ()
        explicit = [self._geometry_fault] if self._geometry_fault else []
        error = self._feed.error()
        if error is not None:
            explicit.append(f"camera: {error}")
        return assess(
            now_s,
            self._feed.newest_s(now_s),
            self.last_answer_s,
            self._stale_after_s,
            self._silent_after_s,
            explicit=tuple(explicit),
        )

    def _show(self, now_s: float, state: State | None) -> Signal:
        faults = self.faults(now_s)
        signal = self._logic.step(now_s, state, faults)
        if self._light is not None:
            self._light.show(signal)
        if self._speaker is not None:
            self._speaker.play(signal.sound)
        sentence = "; ".join(signal.faults) if signal.name == "FAULT" else self._sentence
        if self.shown is None or self.shown.name != signal.name:
            log.info("%s: %s", signal.name, sentence)
        self.shown = signal
        for output in self._outputs:
            output.signal(signal, sentence)
        return signal

    async def _tick(self) -> None:
        """Judges the silence between frames, and whether a thread is stuck."""
        while True:
            await asyncio.sleep(TICK_S)
            now_s = self._clock()
            self._show(now_s, None)
            self._on_tick()
            if self._feed.hung_s(now_s) > self._hang_after_s:
                raise Hung(f"the camera's read has not returned for {self._hang_after_s:g} s")
            since = self._looking_since
            if since is not None and time.monotonic() - since > self._hang_after_s:
                raise Hung(f"the detector has not returned for {self._hang_after_s:g} s")

    def _say(self, what: str, text: str) -> None:
        """Logs a failure when it changes, not thirty times a second."""
        if self.counts.last_errors.get(what) != text:
            log.warning("%s", text)
            self.counts.last_errors[what] = text


class _Slot:
    """Room for one picture between two workers; None is the end."""

    def __init__(self) -> None:
        self._item: Picture | None = None
        self._filled, self._empty = asyncio.Event(), asyncio.Event()
        self._empty.set()

    async def room(self) -> None:
        """Returns when the slot is empty."""
        await self._empty.wait()

    def put(self, item: Picture | None) -> None:
        self._item = item
        self._empty.clear()
        self._filled.set()

    async def take(self) -> Picture | None:
        """The picture, as soon as there is one."""
        await self._filled.wait()
        item, self._item = self._item, None
        self._filled.clear()
        self._empty.set()
        return item
