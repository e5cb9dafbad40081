"""A slow camera and late decisions are named; the light is left alone."""

from __future__ import annotations

import pytest

from bikeped.capture.frame_grabber import FrameGrabber
from bikeped.faults import Effect
from bikeped.pipeline.feed import Feed
from bikeped.pipeline.pace import STEADY_S, Pace
from bikeped.types import Frame


class Arrivals(Feed):
    """A camera of 30 frames/s nominally, whose frames come at `per_s`."""

    per_s: float | None = 30.0

    def rate(self, now_s, window_s):
        return None if self.per_s is None else (self.per_s, 30.0)


def _codes(pace):
    return [fault.code for fault in pace.faults]


def test_a_recording_and_a_good_pace_have_no_notice():
    pace, feed = Pace(0.25), Arrivals()
    for tick in range(20):
        pace.answered(tick / 10, 0.1)
        pace.check(tick / 10, feed)
        pace.check(tick / 10, Feed())
    assert pace.faults == ()


def test_a_slow_camera_is_named_with_its_number_until_it_is_steady_again():
    pace, feed = Pace(0.25), Arrivals()
    feed.per_s = 5.0
    pace.check(10.0, feed)
    (slow,) = pace.faults
    assert (slow.code, slow.kind.effect) == ("camera.slow", Effect.NOTICE)
    assert "5 frames/s arrive, not 30" in slow.detail
    feed.per_s = 7.0
    pace.check(10.1, feed)
    assert pace.faults == (slow,)  # logged once
    feed.per_s = 16.0  # between the two thresholds: neither begins nor ends it
    pace.check(15.0, feed)
    assert pace.faults == (slow,)
    feed.per_s = 30.0
    pace.check(15.0 + STEADY_S / 2, feed)
    assert pace.faults == (slow,)
    pace.check(15.0 + STEADY_S, feed)
    assert pace.faults == ()
    feed.per_s = 16.0
    pace.check(20.0, feed)
    assert pace.faults == ()


def test_late_decisions_are_named_and_one_late_frame_is_not():
    pace, feed = Pace(0.25), Arrivals()
    for tick in range(10):
        pace.answered(1 + tick / 10, 0.4 if tick == 5 else 0.1)
        pace.check(1 + tick / 10, feed)
    assert pace.faults == ()
    for tick in range(2):
        pace.answered(3 + tick / 10, 0.4)
    pace.check(3.1, feed)
    assert _codes(pace) == ["service.slow"]
    assert "400 ms after the picture" in pace.faults[0].detail
    pace.answered(3.5, 0.1)
    pace.check(4.0, feed)
    assert _codes(pace) == ["service.slow"]
    pace.answered(5.2, 0.1)
    pace.check(5.2, feed)
    assert pace.faults == ()


@pytest.mark.parametrize(("step_s", "per_s"), [(1 / 30, 30), (0.2, 5)])
def test_the_grabber_counts_what_arrived_in_the_last_second(step_s, per_s):
    now_s = [100.0]
    grabber = FrameGrabber(lambda: None, clock=lambda: now_s[0])
    grabber.nominal_fps = 30.0
    assert grabber.rate(now_s[0], 1.0) is None
    for number in range(90):
        now_s[0] += step_s
        frame = Frame(number, now_s[0], 96, 64, jpeg=b"jpeg")
        grabber._publish(grabber._reader, frame, now_s[0])
    measured, nominal = grabber.rate(now_s[0], 1.0)
    assert (measured, nominal) == (pytest.approx(per_s, abs=1.01), 30.0)
    assert grabber.rate(now_s[0] + 5.0, 1.0) is None  # no frames is another fault
