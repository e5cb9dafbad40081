"""Worker threads, rate-limited log lines, feeds, decoding and systemd messages."""

from __future__ import annotations

import asyncio
import logging
import math
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pipeline_fakes import PATIENCE_S, Clock, FakeDetector

from bikeped.capture import open_source
from bikeped.config.schema import CameraConfig
from bikeped.errors import CaptureError
from bikeped.pipeline.detection_scheduler import DetectionStage
from bikeped.pipeline.feed import LiveFeed, RecordedFeed
from bikeped.pipeline.runtime import RateLimitedLogger, WorkerThread, notify
from bikeped.types import Frame


async def test_a_worker_answers_in_order_and_passes_errors_on():
    worker = WorkerThread("test")
    assert await asyncio.gather(*(worker.submit(pow, n, 2) for n in range(5))) == [0, 1, 4, 9, 16]
    with pytest.raises(ZeroDivisionError):
        await worker.submit(divmod, 1, 0)
    assert await worker.submit(len, "still alive") == 11
    assert await worker.close()


async def test_a_worker_that_hangs_says_so_and_is_left_behind():
    clock, go, entered = Clock(), threading.Event(), threading.Event()
    worker = WorkerThread("test", clock)

    def hang() -> None:
        entered.set()
        go.wait(PATIENCE_S)

    assert worker.busy_s(clock()) == 0.0
    call = worker.submit(hang)
    try:
        assert await asyncio.to_thread(entered.wait, PATIENCE_S)
        clock.now_s += 20
        assert worker.busy_s(clock()) == 20.0
        assert not await worker.close(0.01)
        assert worker._thread.daemon  # so it cannot keep the process
    finally:
        go.set()
    await call
    assert worker.busy_s(clock()) == 0.0


async def test_a_cancelled_call_is_not_begun():
    worker, go, done = WorkerThread("test"), threading.Event(), []
    first = worker.submit(go.wait, PATIENCE_S)
    second = worker.submit(done.append, 1)
    second.cancel()
    await asyncio.wait({second})
    go.set()
    assert await first
    assert await worker.submit(len, done) == 0
    assert await worker.close()


def test_thirty_failures_a_second_are_a_line_every_ten(caplog):
    clock = Clock()
    limited_log = RateLimitedLogger(logging.getLogger("limited_log"), clock=clock)
    with caplog.at_level(logging.WARNING):
        for _ in range(300):
            limited_log.warn("decode", "bad frame")
            clock.now_s += 1 / 30
        limited_log.failure("output", OSError("full"))
        clock.now_s += 0.5
        limited_log.warn("decode", "bad frame")
    assert [record.getMessage() for record in caplog.records] == [
        "bad frame",
        "output: full",
        "bad frame (and 299 more since the last such line)",
    ]
    assert caplog.records[1].exc_info


async def test_a_recorded_feed_gives_every_frame_and_then_the_end(make_clip):
    source = open_source(CameraConfig(source=str(make_clip("c.avi", 7))))
    feed = RecordedFeed(source)
    numbers = []
    while (taken := await feed.next_frame()) is not None:
        numbers.append(taken[0].number)
    assert numbers == list(range(7))
    assert await feed.next_frame() is None
    await feed.close()


class Slow:
    """A source whose read returns when `go` is set."""

    name, width, height, fps, live = "slow", 96, 64, 30.0, True

    def __init__(self) -> None:
        self.go, self.entered, self.closed = threading.Event(), threading.Event(), False

    def read(self) -> Frame | None:
        self.entered.set()
        self.go.wait(PATIENCE_S)
        return None

    def close(self) -> None:
        self.closed = True


async def test_a_recorded_feed_closes_its_source_after_the_read_under_way():
    source = Slow()
    feed = RecordedFeed(source)  # type: ignore[arg-type]
    reading = asyncio.create_task(feed.next_frame())
    assert await asyncio.to_thread(source.entered.wait, PATIENCE_S)
    reading.cancel()
    source.go.set()
    await feed.close()
    assert source.closed


async def test_a_live_feed_that_ended_says_so_and_one_that_broke_says_why(make_clip):
    class Ends(Slow):
        def read(self) -> Frame | None:
            return None

    feed = LiveFeed(Ends)  # type: ignore[arg-type]
    feed.start()
    assert await asyncio.wait_for(feed.next_frame(), PATIENCE_S) is None
    assert feed.age_s(1.0) == math.inf
    assert feed.error is None
    await feed.close()

    failed = asyncio.Event()
    loop = asyncio.get_running_loop()

    def breaks() -> Slow:
        loop.call_soon_threadsafe(failed.set)
        raise CaptureError("/dev/video7: no such camera")

    feed = LiveFeed(breaks)  # type: ignore[arg-type,return-value]
    feed.start()
    await asyncio.wait_for(failed.wait(), PATIENCE_S)
    await feed.close()  # waits for the thread, which sets the error right after the call above
    assert str(feed.error) == "/dev/video7: no such camera"


STAGE = DetectionStage(FakeDetector())


@given(st.binary(max_size=2000))
@settings(max_examples=200, deadline=None)
def test_any_bytes_as_a_frame_are_refused_and_never_crash(data):
    with pytest.raises(CaptureError):
        STAGE.decode(Frame(0, 0.0, 96, 64, jpeg=data), 0.0, 0.0)


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_a_damaged_jpeg_is_a_picture_or_refused(small_jpegs, data):
    jpeg = bytearray(small_jpegs[0])
    for _ in range(data.draw(st.integers(1, 8))):
        jpeg[data.draw(st.integers(0, len(jpeg) - 1))] = data.draw(st.integers(0, 255))
    try:
        picture = STAGE.decode(Frame(0, 0.0, 96, 64, jpeg=bytes(jpeg)), 0.0, 0.0)
    except CaptureError:
        return
    assert picture.rgb.dtype == np.uint8
    assert picture.rgb.ndim == 3


def test_without_a_service_manager_nothing_is_sent_and_nothing_fails(monkeypatch):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify("READY=1", "STATUS=up")
    monkeypatch.setenv("NOTIFY_SOCKET", "/nowhere/notify")
    notify("WATCHDOG=1")
