"""The thread that keeps the newest frame, and recordings at live pace."""

from __future__ import annotations

import asyncio
import itertools
import math
import queue
import threading

import pytest

from bikeped.capture.base import FrameSource
from bikeped.capture.frame_grabber import MAX_LEFT, OPENING_S, FrameGrabber, backoff_s
from bikeped.capture.recordings import PacedSource, VideoSource
from bikeped.errors import CaptureError
from bikeped.types import Frame

WAIT_S = 20.0  # only ever reached when a test fails


class Clock:
    def __init__(self, now_s=1000.0):
        self.now_s = now_s

    def __call__(self):
        return self.now_s

    def sleep(self, seconds):
        self.now_s += seconds


def _frame(captured_s=0.0, number=0):
    return Frame(number, captured_s, 96, 64, jpeg=b"jpeg")


class FakeSource(FrameSource):
    """Hands out what a test puts into `answers`; `idle` is set whenever it waits for more."""

    live = True
    name = "fake"
    width, height, fps = 96, 64, 30.0

    def __init__(self):
        self.answers = queue.Queue()
        self.idle = threading.Event()
        self.closed = threading.Event()

    def read(self):
        if self.answers.empty():
            self.idle.set()
        answer = self.answers.get()
        if isinstance(answer, Exception):
            raise answer
        return answer() if callable(answer) else answer

    def close(self):
        self.closed.set()

    def give(self, *answers):
        """Puts answers and waits until the reader has come back for more."""
        assert self.idle.wait(WAIT_S)
        self.idle.clear()
        for answer in answers[:-1]:
            self.answers.put(answer)
        self.answers.put(answers[-1])
        assert self.idle.wait(WAIT_S)


class Bench:
    """A grabber whose factory opens FakeSources; `sources` in the order of opening."""

    def __init__(self, **settings):
        self.clock = Clock()
        self.opens = 0
        self.sources = queue.Queue()
        self.refusals = queue.Queue()
        settings = {"first_pause_s": 0.001, "max_pause_s": 0.002, **settings}
        self.grabber = FrameGrabber(self._open, clock=self.clock, **settings)

    def _open(self):
        if not self.refusals.empty():
            raise self.refusals.get()
        source = FakeSource()
        self.opens += 1
        self.last = source
        self.sources.put(source)
        return source

    def opened(self):
        return self.sources.get(timeout=WAIT_S)


@pytest.fixture
def bench():
    made = []

    def make(**settings):
        made.append(Bench(**settings))
        return made[-1]

    yield make
    for each in made:
        each.grabber.stop(0.0)
        if hasattr(each, "last"):
            each.last.answers.put(CaptureError("the test is over"))  # ends a read that waits
        assert each.grabber.stop(WAIT_S)


async def test_the_newest_frame_wins_and_the_others_are_counted(bench):
    b = bench()
    b.grabber.start()
    b.opened().give(_frame(1.0), _frame(2.0), _frame(3.0))
    frame = await b.grabber.next(WAIT_S)
    assert (frame.captured_s, frame.number) == (3.0, 2)
    assert (b.grabber.frames, b.grabber.dropped) == (3, 2)
    assert b.grabber._latest is frame


async def test_a_frame_is_taken_once(bench):
    b = bench()
    b.grabber.start()
    source = b.opened()
    source.give(_frame(1.0))
    assert (await b.grabber.next(WAIT_S)).captured_s == 1.0
    assert await b.grabber.next(0.001) is None
    source.give(_frame(2.0))
    assert (await b.grabber.next(WAIT_S)).captured_s == 2.0
    assert b.grabber.dropped == 0


async def test_a_waiting_consumer_is_woken(bench):
    b = bench()
    b.grabber.start()
    source = b.opened()
    waiting = asyncio.create_task(b.grabber.next(WAIT_S))
    await asyncio.sleep(0)  # lets it begin to wait
    assert not waiting.done()
    source.answers.put(_frame(1.0))
    assert (await waiting).captured_s == 1.0


async def test_a_cancelled_wait_loses_no_frame_and_a_second_consumer_is_a_bug(bench):
    b = bench()
    b.grabber.start()
    source = b.opened()
    waiting = asyncio.create_task(b.grabber.next(WAIT_S))
    await asyncio.sleep(0)
    with pytest.raises(RuntimeError, match="one consumer"):
        await b.grabber.next(WAIT_S)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    source.give(_frame(1.0))
    assert (await b.grabber.next(WAIT_S)).captured_s == 1.0


async def test_stop_wakes_the_consumer(bench):
    b = bench()
    b.grabber.start()
    b.opened()
    waiting = asyncio.create_task(b.grabber.next(WAIT_S))
    await asyncio.sleep(0)
    assert not b.grabber.stop(0.0)  # the read has not returned, so the thread is left behind
    assert await waiting is None


def test_age_counts_from_the_last_arrival(bench):
    b = bench()
    assert b.grabber.age_s(b.clock.now_s) == math.inf
    b.grabber.start()
    source = b.opened()
    source.give(_frame(1.0))
    assert b.grabber.age_s(b.clock.now_s + 0.5) == pytest.approx(0.5)
    b.clock.now_s += 3.0
    source.give(_frame(2.0))
    assert b.grabber.age_s(b.clock.now_s) == 0.0


async def test_a_read_that_does_not_return_is_left_and_a_new_capture_opened(bench):
    b = bench(hang_after_s=2.0)
    b.grabber.start()
    hanging = b.opened()
    hanging.give(_frame(1.0))
    assert b.grabber.replace_hung(b.clock.now_s + 2.0) is None
    assert b.opens == 1
    assert b.grabber.replace_hung(b.clock.now_s + 2.1) is None
    fresh = b.opened()
    assert "a read has not returned for 2 s" in str(b.grabber.error)
    fresh.give(_frame(2.0))
    assert b.grabber.error is None
    assert (await b.grabber.next(WAIT_S)).captured_s == 2.0
    # What the old read returns at last is not the newest frame, and its device is closed.
    hanging.answers.put(_frame(900.0))
    assert hanging.closed.wait(WAIT_S)
    fresh.give(_frame(3.0))
    assert (await b.grabber.next(WAIT_S)).captured_s == 3.0
    assert b.grabber.replace_hung(b.clock.now_s) is None


def test_a_left_read_that_fails_does_not_count_against_the_new_capture(bench):
    b = bench(hang_after_s=2.0)
    b.grabber.start()
    hanging = b.opened()
    assert hanging.idle.wait(WAIT_S)
    b.grabber.replace_hung(b.clock.now_s + 2.1)
    b.opened().give(_frame(1.0))
    hanging.answers.put(CaptureError("late"))
    assert hanging.closed.wait(WAIT_S)
    assert b.grabber.error is None


def test_a_device_that_stays_busy_after_a_hang_needs_a_new_process(bench):
    b = bench(hang_after_s=2.0, first_pause_s=1e6, max_pause_s=1e6)
    fail, failed = b.grabber._failed, threading.Event()
    b.grabber._failed = lambda *args: (fail(*args), failed.set())
    b.grabber.start()
    hanging = b.opened()
    assert hanging.idle.wait(WAIT_S)
    b.refusals.put(CaptureError("busy"))
    b.clock.now_s += 2.1
    assert b.grabber.replace_hung(b.clock.now_s) is None
    assert failed.wait(WAIT_S)
    assert b.grabber.replace_hung(b.clock.now_s + 2.0) is None
    assert "busy" in b.grabber.replace_hung(b.clock.now_s + 2.1)
    hanging.answers.put(CaptureError("the test is over"))


def test_opening_may_take_longer_than_a_read():
    clock, opening, go = Clock(), threading.Event(), threading.Event()

    def open_slowly():
        opening.set()
        go.wait(WAIT_S)
        raise CaptureError("the test is over")

    grabber = FrameGrabber(open_slowly, clock=clock, hang_after_s=2.0)
    grabber.start()
    assert opening.wait(WAIT_S)
    first = grabber._reader
    grabber.replace_hung(clock.now_s + 2.0 + OPENING_S)
    assert grabber._reader is first
    grabber.replace_hung(clock.now_s + 2.1 + OPENING_S)
    assert grabber._reader is not first
    go.set()
    assert grabber.stop(WAIT_S)


def test_too_many_hanging_reads_need_a_new_process(bench):
    b = bench(hang_after_s=2.0)
    b.grabber.start()
    sources = []
    for number in range(MAX_LEFT + 1):
        sources.append(b.opened())
        assert sources[-1].idle.wait(WAIT_S)
        b.clock.now_s += 2.1
        problem = b.grabber.replace_hung(b.clock.now_s)
        assert (problem is None) == (number < MAX_LEFT)
    assert problem == "5 reads have not returned"
    for source in sources:
        source.answers.put(CaptureError("the test is over"))


async def test_a_frame_from_the_future_is_dropped_and_later_ones_count(bench):
    b = bench(stale_after_s=2.0)
    b.grabber.start()
    source = b.opened()
    now_s = b.clock.now_s
    source.give(_frame(now_s - 0.1), _frame(now_s + 3600.0), _frame(now_s - 0.05))
    assert (await b.grabber.next(WAIT_S)).captured_s == now_s - 0.05
    assert b.grabber.frames == 2


def test_a_source_of_frames_from_the_future_alone_is_opened_anew(bench):
    b = bench(stale_after_s=2.0)
    b.grabber.start()
    source = b.opened()
    b.clock.now_s += 2.1
    source.answers.put(_frame(b.clock.now_s + 60.0))
    b.opened()
    assert "time stamps of the past" in str(b.grabber.error)


async def test_a_broken_source_is_closed_and_a_fresh_one_counts_on(bench):
    b = bench()
    b.grabber.start()
    first = b.opened()
    first.give(_frame(1.0), _frame(2.0))
    first.answers.put(CaptureError("unplugged"))
    second = b.opened()
    assert first.closed.is_set()
    assert str(b.grabber.error) == "unplugged"
    second.give(_frame(0.5))  # a fresh source may start its time and numbers again
    assert b.grabber.error is None
    assert b.opens == 2
    assert (await b.grabber.next(WAIT_S)).number == 2


def test_opening_is_tried_again_until_it_works(bench):
    b = bench()
    for _ in range(3):
        b.refusals.put(CaptureError("no such camera"))
    b.grabber.start()
    source = b.opened()
    assert str(b.grabber.error) == "no such camera"
    assert b.opens == 1
    source.give(_frame(1.0))
    assert b.grabber.error is None


def test_a_bug_in_a_source_does_not_end_the_thread(bench, caplog):
    b = bench()
    b.grabber.start()
    b.opened().answers.put(ZeroDivisionError("a bug"))
    b.opened()
    assert "ZeroDivisionError: a bug" in str(b.grabber.error)
    assert "Traceback" in caplog.text


def test_a_source_that_repeats_itself_is_stale_and_opened_anew(bench):
    b = bench(stale_after_s=2.0)
    b.grabber.start()
    first = b.opened()
    first.give(_frame(1.0))
    b.clock.now_s += 1.9
    first.give(_frame(1.0))
    assert b.grabber.frames == 1
    b.clock.now_s += 0.2
    first.answers.put(_frame(1.0))
    b.opened()
    assert first.closed.is_set()
    assert "no newer frame" in str(b.grabber.error)


def test_restart_opens_a_fresh_source_at_once_and_is_no_error(bench):
    b = bench(first_pause_s=1e6, max_pause_s=1e6)
    b.grabber.start()
    first = b.opened()
    first.give(_frame(1.0))
    b.grabber.restart()
    first.answers.put(_frame(2.0))
    b.opened()
    assert first.closed.is_set()
    assert b.grabber.error is None
    assert b.opens == 2


def test_stop_closes_the_source_and_breaks_a_long_pause(bench):
    b = bench(first_pause_s=1e6, max_pause_s=1e6)
    b.grabber.start()
    source = b.opened()
    source.answers.put(CaptureError("unplugged"))
    assert source.closed.wait(WAIT_S)
    assert b.grabber.stop(WAIT_S)


def test_stop_before_start_is_harmless(bench):
    assert bench().grabber.stop()


def test_a_camera_that_was_away_for_long_is_tried_again_within_a_second(bench):
    assert bench().grabber._max_pause_s == 0.002  # the tests' own
    assert FrameGrabber(FakeSource)._max_pause_s <= 1.0


def test_pauses_double_up_to_the_cap():
    assert [backoff_s(n, 0.25, 8.0) for n in range(1, 8)] == [0.25, 0.5, 1, 2, 4, 8, 8]
    assert backoff_s(100_000, 0.25, 8.0) == 8.0


def test_the_pause_is_short_again_only_after_a_healthy_while(bench, monkeypatch):
    pauses = []

    def note(failures, first_s, most_s):
        pauses.append(failures)
        return 0.0

    monkeypatch.setattr("bikeped.capture.frame_grabber.backoff_s", note)
    b = bench(healthy_after_s=1.0)
    b.grabber.start()
    for healthy in (False, False, True, False):
        source = b.opened()
        source.give(_frame(1.0))
        b.clock.now_s += 1.5 if healthy else 0.5
        source.give(_frame(2.0))
        source.answers.put(CaptureError("unplugged"))
    b.opened()
    assert pauses == [1, 2, 1, 2]


def test_a_consumer_whose_loop_is_closed_does_not_end_the_thread(bench):
    b = bench()
    b.grabber.start()
    source = b.opened()
    loop = asyncio.new_event_loop()
    loop.close()
    b.grabber._waiter = (loop, asyncio.Event())
    source.give(_frame(1.0), _frame(2.0))
    assert b.grabber.frames == 2
    assert b.grabber.error is None


async def test_a_paced_recording_runs_to_its_end_through_the_grabber(write_video):
    path = write_video("a.avi", "MJPG")
    clock = Clock()
    grabber = FrameGrabber(
        lambda: PacedSource(VideoSource(path), clock=clock, sleep=clock.sleep), clock=clock
    )
    grabber.start()
    frames = []
    while not grabber.ended or not frames or frames[-1] is not None:
        frames.append(await grabber.next(WAIT_S))
        assert grabber.error is None
    assert grabber.stop(WAIT_S)
    numbers = [frame.number for frame in frames if frame is not None]
    assert numbers[-1] == 5
    assert numbers == sorted(set(numbers))
    assert grabber.frames == 6
    assert grabber.dropped == 6 - len(numbers)
    assert grabber.error is None
    assert await grabber.next(WAIT_S) is None


class Recording(FrameSource):
    live = False
    name = "recording"
    width, height, fps = 96, 64, 10.0

    def __init__(self, times_s):
        self.frames = iter([_frame(t, n) for n, t in enumerate(times_s)])
        self.closed = False

    def read(self):
        return next(self.frames, None)

    def close(self):
        self.closed = True


def test_a_paced_recording_keeps_its_spacing_on_the_live_clock():
    clock = Clock(50.0)
    recording = Recording([7.0, 7.1, 7.4])
    with PacedSource(recording, clock=clock, sleep=clock.sleep) as source:
        assert source.live
        assert (source.width, source.height, source.fps) == (96, 64, 10.0)
        seen = []
        for frame in iter(source.read, None):
            seen.append((frame.captured_s, clock.now_s))
            clock.now_s += 0.03  # the consumer's work is part of the frame period
    expected = [50.0, 50.1, 50.4]
    assert [captured for captured, _ in seen] == pytest.approx(expected)
    assert [delivered for _, delivered in seen] == pytest.approx(expected)
    assert recording.closed


def test_a_late_frame_comes_at_once_and_looks_its_age():
    clock = Clock(50.0)
    source = PacedSource(Recording([0.0, 0.1, 0.2]), clock=clock, sleep=clock.sleep)
    source.read()
    clock.now_s += 1.0
    ages = [
        clock.now_s - frame.captured_s for frame in itertools.islice(iter(source.read, None), 2)
    ]
    assert ages == pytest.approx([0.9, 0.8])
    assert clock.now_s == 51.0
