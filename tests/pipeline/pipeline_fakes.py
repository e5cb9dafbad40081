"""Fakes for the loop: a feed, a detector, a light, a clock, and a recorder."""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Callable

import numpy as np

from bikeped.config.load import LoadedConfig, parse_config
from bikeped.detection.detector import DetectionResult
from bikeped.faults import Fault, fault_texts
from bikeped.feedback.signal_logic import SignalLogic
from bikeped.pipeline.detection_scheduler import DecodedFrame, DetectionStage
from bikeped.pipeline.detector_watch import DetectorWatch
from bikeped.pipeline.fault_monitor import Limits
from bikeped.pipeline.loop import FrameResult, Loop
from bikeped.pipeline.signal_dispatcher import SignalDispatcher
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.types import Decision, Detections, Frame, Kind, Signal

PATIENCE_S = 20.0  # reached only by a failure

CONFIG = """
camera: {width: 96, height: 64, projection: perspective, pad_size: null, crop_size: null,
         radius_px: 58, fov_deg: 73, height_m: 5.0, pitch_deg: -35}
"""
RGB = np.zeros((64, 96, 3), np.uint8)


def small(*overrides: str) -> LoadedConfig:
    from pathlib import Path

    return parse_config(CONFIG, "small.yaml", Path(), overrides)


def seen(*objects: tuple[Kind, float, float]) -> Detections:
    """Detections whose boxes end at the given pixels."""
    n = len(objects)
    box = np.array([(u - 3, v - 10, u + 3, v) for _, u, v in objects], np.float32).reshape(n, 4)
    kind = np.array([kind for kind, _, _ in objects], np.int8)
    return Detections(kind, np.full(n, 0.9, np.float32), box)


class Clock:
    def __init__(self, now_s: float = 100.0) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s


class FakeFeed:
    """Hands out what the test puts in."""

    def __init__(self, live: bool = True) -> None:
        self.live = live
        self.queue: asyncio.Queue[Frame | Exception | None] = asyncio.Queue()
        self.last_s: float | None = None
        self.error: Exception | None = None
        self.dropped = 0
        self.hopeless: str | None = None
        self.restarts = 0
        self.closed = False
        self.number = 0

    def put(self, captured_s: float, **changes: object) -> None:
        self.last_s = captured_s
        values = {"width": 96, "height": 64, "rgb": RGB, **changes}
        if "jpeg" in changes:
            values["rgb"] = None
        self.queue.put_nowait(Frame(self.number, captured_s, **values))  # type: ignore[arg-type]
        self.number += 1

    async def next_frame(self) -> tuple[Frame, float] | None:
        item = await self.queue.get()
        if isinstance(item, Exception):
            raise item
        return None if item is None else (item, 1.0)

    def age_s(self, now_s: float) -> float:
        return math.inf if self.last_s is None else now_s - self.last_s

    def rate(self, now_s: float, window_s: float) -> tuple[float, float] | None:
        return None

    def replace_hung(self, now_s: float) -> str | None:
        return self.hopeless

    def restart(self) -> None:
        self.restarts += 1

    async def close(self) -> None:
        self.closed = True


class FakeDetector:
    """Sees `answer`; raises `error` while there is one; blocks while `go` is not set."""

    name = "fake"
    model_hash: str | None = None
    cyclist_box_includes_rider = False

    def __init__(self, answer: Detections | None = None) -> None:
        self.answer = Detections.empty() if answer is None else answer
        self.error: Exception | None = None
        self.go = threading.Event()
        self.go.set()
        self.entered = threading.Event()
        self.calls = 0

    def decode_size(self, width: int, height: int) -> tuple[int, int]:
        return width, height

    def detect(self, picture: DecodedFrame) -> DetectionResult:
        self.calls += 1
        self.entered.set()
        self.go.wait(PATIENCE_S)
        if self.error is not None:
            raise self.error
        return DetectionResult(self.answer, 0.1, 1.0, 0.1)


class FakeLight:
    """What `LightDriver.show` was called with."""

    name, errors = "simulated", 0

    def __init__(self) -> None:
        self.shown: list[Signal] = []

    def show(self, signal: Signal) -> None:
        self.shown.append(signal)


class Recorder:
    """Listens to signals, results and ticks, and lets a test wait for them."""

    def __init__(self) -> None:
        self.signals: list[tuple[Signal, str, Decision | None]] = []
        self.results: list[FrameResult] = []
        self.ticks = 0
        self._news = asyncio.Event()

    def on_signal(self, signal: Signal, sentence: str, decision: Decision | None) -> None:
        self.signals.append((signal, sentence, decision))
        self._news.set()

    async def on_frame_result(self, result: FrameResult) -> None:
        self.results.append(result)
        self._news.set()

    def tick(self) -> None:
        self.ticks += 1
        self._news.set()

    async def until(self, done: Callable[[], bool]) -> None:
        async def wait() -> None:
            while not done():
                self._news.clear()
                await self._news.wait()

        await asyncio.wait_for(wait(), PATIENCE_S)

    async def some_ticks(self) -> None:
        """Until two whole ticks have passed: whatever was to be noticed has been."""
        target = self.ticks + 2
        await self.until(lambda: self.ticks >= target)

    @property
    def name(self) -> str:
        return self.signals[-1][0].name if self.signals else ""

    @property
    def faults(self) -> tuple[str, ...]:
        return fault_texts(self.signals[-1][0].faults)


class Rig:
    """A loop with fakes at every seam; `async with` runs it."""

    def __init__(self, *, live: bool = True, config: LoadedConfig | None = None) -> None:
        self.config = config or small()
        self.clock = Clock()
        self.feed = FakeFeed(live)
        self.detector = FakeDetector()
        self.light = FakeLight()
        self.recorder = Recorder()
        self.outputs: list[object] = [self.recorder]
        self.limits = Limits(tick_s=0.005, close_s=0.05)
        self.track_and_decide = TrackAndDecide(self.config)
        self.max_inflight = 1
        self.fault_sources: list[Callable[[], Fault | None]] = []
        self.watch: DetectorWatch | None = None

    def start(self) -> None:
        self.dispatcher = SignalDispatcher(
            SignalLogic.from_config(self.config.config.feedback),
            self.light,  # type: ignore[arg-type]
            listeners=(self.recorder,),
        )
        self.detection = DetectionStage(self.detector)
        self.detection.max_inflight = self.max_inflight
        self.loop = Loop(
            feed=self.feed,
            detection=self.detection,
            track_and_decide=self.track_and_decide,
            dispatcher=self.dispatcher,
            outputs=self.outputs,  # type: ignore[arg-type]
            limits=self.limits,
            clock=self.clock,
            on_tick=self.recorder.tick,
            fault_sources=self.fault_sources,
            watch=self.watch,
        )
        self.task = asyncio.create_task(self.loop.run())

    async def __aenter__(self) -> Rig:
        self.start()
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.detector.go.set()
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)

    async def frames(self, count: int, step_s: float = 1 / 30, **changes: object) -> None:
        """Puts frames of the present moment in and waits for each to be dealt with."""
        for _ in range(count):
            self.clock.now_s += step_s
            before = self.dealt_with()
            self.feed.put(self.clock.now_s, **changes)
            await self.recorder.until(lambda before=before: self.dealt_with() > before)

    def recorded(self, count: int, *, ends: bool = True) -> None:
        """Puts `count` frames of a recording in, and its end."""
        for number in range(count):
            self.feed.put(number / 30)
        if ends:
            self.feed.queue.put_nowait(None)

    def dealt_with(self) -> int:
        counts = self.loop.counts
        return counts.frames + counts.undecodable + counts.failed + counts.out_of_order

    async def well(self) -> None:
        """Until the light says IDLE."""
        await self.frames(6)
        assert self.recorder.name == "IDLE"

    async def ended(self) -> None:
        await asyncio.wait_for(self.task, PATIENCE_S)
