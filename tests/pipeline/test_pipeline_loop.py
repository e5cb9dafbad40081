"""The loop with fakes at its seams: what it cannot see it must not call safe."""

from __future__ import annotations

import asyncio
import threading

import numpy as np
import pytest
from pipeline_fakes import PATIENCE_S, FakeDetector, Rig, seen, small

import bikeped.pipeline.detection_scheduler as scheduler_module
from bikeped.detection.detector import DetectionResult
from bikeped.errors import CaptureError, DetectorError, GeometryError
from bikeped.pipeline.detection_scheduler import DecodedFrame, LatestFrameSlot
from bikeped.pipeline.fault_monitor import RESTART_AFTER_S, Limits, StageHangError
from bikeped.pipeline.loop import FrameResult
from bikeped.types import Colour, Kind

REASSURING = {Colour.BLUE, Colour.GREEN}


def test_the_limits_in_use_lead_to_fault_within_a_second():
    limits = Limits()
    assert limits.stale_after_s + 2 * limits.tick_s < 1.0
    assert limits.silent_after_s + 2 * limits.tick_s < 1.0


async def test_a_camera_that_stops_is_a_fault_and_only_fresh_good_frames_end_it():
    async with Rig() as rig:
        await rig.well()
        rig.clock.now_s += 0.45
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "IDLE"
        rig.clock.now_s += 0.1
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "FAULT"
        assert "camera: no frame for more than 0.5 s" in rig.recorder.faults

        await rig.frames(4)
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "FAULT"
        assert all(line.startswith("recovering: ") for line in rig.recorder.faults)
        await rig.frames(1)
        assert rig.recorder.name == "IDLE"


async def test_an_old_frame_is_no_fresh_evidence():
    async with Rig() as rig:
        await rig.well()
        last_s = rig.clock.now_s
        rig.clock.now_s += 2.0
        await rig.recorder.some_ticks()
        for n in range(1, 9):  # a camera that hands out what it held back
            rig.feed.put(last_s + n / 30)
            await rig.recorder.until(lambda n=n: rig.loop.counts.frames == 6 + n)
        assert rig.recorder.name == "FAULT"


async def test_nothing_is_reassuring_before_the_first_good_frames():
    async with Rig() as rig:
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "FAULT"
        assert "camera: no frame yet" in rig.recorder.faults
        await rig.frames(4)
        assert not {signal.colour for signal in rig.light.shown} & REASSURING


async def test_a_blocked_detector_is_a_fault_and_then_the_end():
    async with Rig() as rig:
        await rig.well()
        rig.detector.go.clear()
        rig.detector.entered.clear()
        rig.feed.put(rig.clock.now_s + 0.03)
        assert await asyncio.to_thread(rig.detector.entered.wait, PATIENCE_S)
        rig.clock.now_s += 0.6
        rig.feed.last_s = rig.clock.now_s  # the camera goes on
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "FAULT"
        assert rig.recorder.faults == ("detector: no answer for more than 0.5 s",)
        rig.clock.now_s += 15.1
        rig.feed.last_s = rig.clock.now_s
        with pytest.raises(StageHangError, match="detector: has not returned for 15 s"):
            await rig.ended()
        assert rig.feed.closed
        assert rig.light.shown[-1].name == "FAULT"
        assert "detector: has not returned for 15 s" in rig.recorder.faults


async def test_a_camera_that_cannot_be_opened_anew_after_a_hang_is_the_end():
    async with Rig() as rig:
        await rig.well()
        rig.feed.hopeless = "a read has not returned, and the device is busy"
        with pytest.raises(StageHangError, match="camera: a read has not returned"):
            await rig.ended()
        assert rig.light.shown[-1].name == "FAULT"


async def test_frames_from_the_future_are_dropped_and_do_not_outlast_themselves():
    async with Rig() as rig:
        await rig.well()
        for _ in range(3):
            rig.feed.put(rig.clock.now_s + 3600.0)
        rig.feed.last_s = rig.clock.now_s
        await rig.recorder.until(lambda: rig.loop.counts.out_of_order == 3)
        await rig.frames(1)
        assert rig.recorder.name == "IDLE"
        assert rig.recorder.results[-1].decoded.frame.captured_s == rig.clock.now_s


async def test_while_only_frames_from_the_future_come_the_light_shows_fault():
    async with Rig() as rig:
        await rig.well()
        rig.clock.now_s += 0.6
        rig.feed.put(rig.clock.now_s + 3600.0)
        rig.feed.last_s = rig.clock.now_s
        await rig.recorder.until(lambda: rig.recorder.name == "FAULT")
        assert rig.recorder.faults == ("detector: no answer for more than 0.5 s",)
        await rig.frames(5)
        assert rig.recorder.name == "IDLE"


@pytest.mark.parametrize("error", [DetectorError("out of memory"), RuntimeError("a bug")])
async def test_one_failure_of_the_detector_costs_one_frame(error):
    async with Rig() as rig:
        await rig.well()
        rig.detector.error = error
        await rig.frames(1)
        rig.detector.error = None
        await rig.frames(1)
        assert rig.recorder.name == "IDLE"
        assert (rig.loop.counts.failed, rig.loop.counts.frames) == (1, 7)


async def test_a_detector_that_only_fails_is_a_fault_that_says_why_and_then_the_end():
    async with Rig() as rig:
        await rig.well()
        rig.detector.error = DetectorError("device lost")
        await rig.frames(20)
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "FAULT"
        assert "detector: device lost" in rig.recorder.faults
        rig.detector.error = None
        await rig.frames(5)
        assert rig.recorder.name == "IDLE"
        rig.detector.error = DetectorError("device lost")
        await rig.frames(1)
        rig.clock.now_s += 15.1
        with pytest.raises(StageHangError, match="device lost"):
            await rig.ended()


async def test_a_frame_that_does_not_decode_is_counted_and_skipped(small_jpegs):
    async with Rig() as rig:
        await rig.frames(6, jpeg=small_jpegs[0])
        for junk in (b"", b"\xff\xd8", small_jpegs[1][:200], b"\0" * 500):
            await rig.frames(1, jpeg=junk)
            assert rig.recorder.name == "IDLE"
        await rig.frames(1, jpeg=small_jpegs[1])
        assert (rig.loop.counts.undecodable, rig.loop.counts.frames) == (4, 7)
        assert rig.recorder.name == "IDLE"


async def test_nothing_but_junk_is_a_fault_and_a_fresh_capture(small_jpegs):
    async with Rig() as rig:
        await rig.frames(6, jpeg=small_jpegs[0])
        await rig.frames(20, jpeg=b"junk")
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "FAULT"
        assert any("frames do not decode" in line for line in rig.recorder.faults)
        assert rig.feed.restarts == 0
        await rig.frames(int(RESTART_AFTER_S * 30), jpeg=b"other junk")
        await rig.recorder.some_ticks()
        assert rig.feed.restarts == 1
        # One row of failures is one fault: its text must not change thirty times a second.
        texts = {s.faults for s, _, _ in rig.recorder.signals if "decode" in str(s.faults)}
        assert len(texts) == 1
        await rig.frames(5, jpeg=small_jpegs[0])
        assert rig.recorder.name == "IDLE"


async def test_frames_of_other_proportions_are_a_fault():
    async with Rig() as rig:
        await rig.well()
        rig.clock.now_s += 0.03
        rig.feed.put(rig.clock.now_s, width=96, height=96)
        await rig.recorder.until(lambda: rig.recorder.name == "FAULT")
        assert any(line.startswith("geometry: camera.width") for line in rig.recorder.faults)
        assert rig.detector.calls == 6  # what cannot be placed is not looked at
        await rig.frames(5)
        assert rig.recorder.name == "IDLE"


async def test_frames_of_other_proportions_end_a_replay():
    async with Rig(live=False) as rig:
        rig.feed.put(0.0, width=96, height=96)
        with pytest.raises(GeometryError, match="proportions"):
            await rig.ended()


async def test_a_time_that_goes_back_is_counted_and_becomes_a_fault():
    async with Rig() as rig:
        await rig.well()
        tracks = rig.recorder.results[-1].tracking.tracks.time_s
        for n in range(20):
            rig.clock.now_s += 1 / 30
            rig.feed.put(tracks - 50 + n / 30)
            await rig.recorder.until(lambda n=n: rig.loop.counts.out_of_order == n + 1)
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "FAULT"
        assert rig.loop.counts.frames == 6
        await rig.frames(5)
        assert rig.recorder.name == "IDLE"


async def test_a_camera_error_is_told_and_is_a_fault_at_once():
    async with Rig() as rig:
        await rig.well()
        rig.feed.error = CaptureError("/dev/video0: no such camera")
        await rig.recorder.some_ticks()
        assert rig.recorder.faults == ("camera: /dev/video0: no such camera",)


class Broken:
    async def on_frame_result(self, result):
        raise OSError("the disk is full")

    def on_signal(self, signal, sentence, decision):
        raise OSError("the disk is full")


async def test_an_output_that_fails_does_not_end_a_live_loop():
    rig = Rig()
    rig.outputs.insert(0, Broken())
    async with rig:
        rig.dispatcher._listeners = (Broken(), rig.recorder)
        await rig.well()
        assert len(rig.recorder.results) == 6


async def test_an_output_that_fails_ends_a_replay():
    rig = Rig(live=False)
    rig.outputs.insert(0, Broken())
    async with rig:
        rig.feed.put(0.0)
        with pytest.raises(OSError, match="disk is full"):
            await rig.ended()


async def test_stopping_during_a_blocked_read_is_prompt_and_dark():
    async with Rig() as rig:
        await rig.well()
        rig.loop.stopping.set()
        await rig.ended()
        assert rig.feed.closed
        assert rig.light.shown[-1].name == "OFF"
        assert rig.recorder.signals[-1][1] == "OFF: the service was stopped."


async def test_stopping_while_the_detector_hangs_leaves_it_behind():
    async with Rig() as rig:
        await rig.well()
        rig.detector.go.clear()
        rig.detector.entered.clear()
        rig.feed.put(rig.clock.now_s + 0.03)
        assert await asyncio.to_thread(rig.detector.entered.wait, PATIENCE_S)
        rig.loop.stopping.set()
        await rig.ended()
        assert not rig.detector.go.is_set()
        assert rig.light.shown[-1].name == "OFF"


async def test_a_cancelled_loop_leaves_the_light_dark_and_the_camera_free():
    async with Rig() as rig:
        await rig.well()
        rig.task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await rig.ended()
        assert rig.feed.closed
        assert rig.light.shown[-1].name == "OFF"


@pytest.mark.parametrize("error", [RuntimeError("a bug"), CaptureError("clip.avi: broken")])
async def test_a_failure_of_the_feed_ends_the_loop_dark(error):
    async with Rig() as rig:
        await rig.well()
        rig.feed.queue.put_nowait(error)
        with pytest.raises(type(error), match=str(error)):
            await rig.ended()
        assert rig.feed.closed
        assert rig.light.shown[-1].name == "OFF"


async def test_a_recording_ends_the_loop_after_its_last_frame():
    async with Rig(live=False) as rig:
        rig.recorded(10)
        await rig.ended()
        assert [o.decoded.frame.number for o in rig.recorder.results] == list(range(10))
        assert rig.recorder.ticks == 0  # a recording is not late


class PatientDetector(FakeDetector):
    """Answers about a frame when the next one (or the end) waits in the slot."""

    def __init__(self) -> None:
        super().__init__()
        self.put = 0
        self.changed = threading.Condition()

    def detect(self, picture: DecodedFrame) -> DetectionResult:
        answer = super().detect(picture)
        with self.changed:
            assert self.changed.wait_for(lambda: self.put >= picture.frame.number + 2, PATIENCE_S)
        return answer


async def test_the_waiting_frame_is_detected_while_one_is_processed(monkeypatch):
    rig = Rig(live=False)
    rig.detector = detector = PatientDetector()
    processed: list[int] = []

    class Watched(LatestFrameSlot):
        def put(self, item: DecodedFrame | None) -> None:
            super().put(item)
            with detector.changed:
                detector.put += 1
                detector.changed.notify_all()

    class Output:
        """Takes an result only when the detector has begun with the next frame."""

        async def on_frame_result(self, result: FrameResult) -> None:
            processed.append(result.decoded.frame.number)
            deadline = asyncio.get_running_loop().time() + PATIENCE_S
            while processed[-1] < 9 and detector.calls < processed[-1] + 2:
                assert asyncio.get_running_loop().time() < deadline
                await asyncio.sleep(0)

    monkeypatch.setattr(scheduler_module, "LatestFrameSlot", Watched)
    rig.outputs.append(Output())
    rig.recorded(10)
    async with rig:
        await rig.ended()
    assert processed == list(range(10))


class PairedDetector(FakeDetector):
    """Answers only when two frames are in flight, the later one first."""

    def __init__(self) -> None:
        super().__init__()
        self.both = threading.Barrier(2, timeout=PATIENCE_S)
        self.later = threading.Event()

    def detect(self, picture: DecodedFrame) -> DetectionResult:
        self.both.wait()
        if picture.frame.number % 2:
            self.later.set()
        else:
            assert self.later.wait(PATIENCE_S)
            self.later.clear()
        if self.error is not None and picture.frame.number == 5:
            raise self.error
        return DetectionResult(self.answer, 0.1, 1.0, 0.1)


@pytest.mark.parametrize("count", [8, 10])
async def test_two_frames_in_flight_are_processed_in_order(count):
    rig = Rig(live=False)
    rig.detector = PairedDetector()
    rig.max_inflight = 2
    rig.recorded(count)
    async with rig:
        await rig.ended()
    assert [o.decoded.frame.number for o in rig.recorder.results] == list(range(count))


async def test_the_second_of_two_in_flight_fails_after_the_first_is_processed():
    rig = Rig(live=False)
    rig.detector = PairedDetector()
    rig.detector.error = DetectorError("out of memory")
    rig.max_inflight = 2
    rig.recorded(10, ends=False)
    async with rig:
        with pytest.raises(DetectorError, match="out of memory"):
            await rig.ended()
        rig.detector.both.abort()  # releases the waiting thread
    assert [o.decoded.frame.number for o in rig.recorder.results] == [0, 1, 2, 3, 4]


async def test_a_detection_that_fails_meanwhile_costs_a_replay_no_frame_before_it():
    rig = Rig(live=False)
    processed: list[int] = []

    class Output:
        async def on_frame_result(self, result: FrameResult) -> None:
            processed.append(result.decoded.frame.number)
            if len(processed) == 3:
                rig.detector.error = DetectorError("out of memory")

    rig.outputs.append(Output())
    rig.recorded(10, ends=False)
    async with rig:
        with pytest.raises(DetectorError, match="out of memory"):
            await rig.ended()
    assert processed in (
        [0, 1, 2],
        [0, 1, 2, 3],
    )  # the detection after the third may have begun already
    assert rig.light.shown[-1].name == "OFF"


@pytest.mark.parametrize("max_inflight", [1, 2])
async def test_frames_before_one_of_other_proportions_are_processed(max_inflight):
    rig = Rig(live=False)
    rig.max_inflight = max_inflight
    rig.recorded(6, ends=False)
    rig.feed.put(6 / 30, width=64, height=96, rgb=np.zeros((96, 64, 3), np.uint8))
    async with rig:
        with pytest.raises(GeometryError):
            await rig.ended()
    assert [o.decoded.frame.number for o in rig.recorder.results] == list(range(6))


async def test_an_output_that_fails_while_the_detector_hangs_ends_a_replay():
    rig = Rig(live=False)

    class Output:
        async def on_frame_result(self, result: FrameResult) -> None:
            rig.detector.go.clear()
            raise OSError("disk is full")

    rig.outputs.append(Output())
    rig.recorded(4, ends=False)
    async with rig:
        with pytest.raises(OSError, match="disk is full"):
            await rig.ended()
    assert rig.light.shown[-1].name == "OFF"


async def test_the_newest_decision_reaches_listeners_with_its_own_pair():
    rig = Rig(config=small("decision.d_min_m=0.1", "decision.min_displacement_m=0.01"))
    async with rig:
        await rig.frames(6)
        for n in range(30):
            rig.detector.answer = seen((Kind.PEDESTRIAN, 30, 30), (Kind.CYCLIST, 80 - n, 30))
            await rig.frames(1)
            if rig.recorder.name == "ALERT":
                break
        signal, sentence, decision = next(
            entry for entry in rig.recorder.signals if entry[0].name == "ALERT"
        )
        assert signal.colour is Colour.RED
        assert decision.state.name == "ALERT"
        assert decision.pair is not None
        assert sentence == decision.sentence


async def test_latencies_are_the_papers_stages_and_add_up():
    async with Rig() as rig:
        await rig.well()
        latency = rig.recorder.results[-1].latency_ms
        parts = ("pre", "inference", "post", "track", "decide", "feedback")
        assert set(latency) == {*parts, "acquire", "total", "capture_age"}
        assert latency["capture_age"] == pytest.approx(latency["total"] + latency["acquire"])
        assert latency["acquire"] == 1.0
        # The fake detector claims more than it takes, by 1.2 ms.
        assert latency["total"] > sum(latency[p] for p in parts) - 1.3
