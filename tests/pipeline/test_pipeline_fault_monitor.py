"""The fault monitor: ages, failing stages, hangs, and the faults of other parts."""

from __future__ import annotations

import math

import pytest
from pipeline_fakes import FakeFeed

from bikeped.faults import Fault, fault_texts
from bikeped.pipeline.fault_monitor import FaultMonitor, Limits

LIMITS = Limits(stale_after_s=0.5, silent_after_s=0.5)
SPEAKER = Fault("speaker", "speaker.error", "unplugged")


def monitor(
    frame_s: float | None, answer_s: float | None, *sources: Fault | None, live: bool = True
) -> FaultMonitor:
    feed = FakeFeed(live)
    feed.last_s = frame_s
    made = FaultMonitor(feed, LIMITS, [lambda fault=fault: fault for fault in sources])
    if answer_s is not None:
        made.processed(answer_s)
    return made


def test_there_is_no_fault_when_all_is_fresh():
    assert monitor(9.6, 9.5).faults(10.0) == ()
    assert monitor(10.4, 10.4).faults(10.0) == ()  # a clock that is read a little later


@pytest.mark.parametrize(
    ("frame_s", "answer_s", "texts", "codes"),
    [
        (
            None,
            None,
            ("camera: no frame yet", "detector: no answer yet"),
            ["camera.no_frame", "detector.no_answer"],
        ),
        (9.4, 10.0, ("camera: no frame for more than 0.5 s",), ["camera.no_frame"]),
        (10.0, 9.4, ("detector: no answer for more than 0.5 s",), ["detector.no_answer"]),
        (math.nan, 10.0, ("camera: no frame for more than 0.5 s",), ["camera.no_frame"]),
        (
            10.6,
            10.0,
            ("camera: no frame with a usable time: the newest lies in the future",),
            ["camera.future_time"],
        ),
        (
            10.0,
            10.6,
            ("detector: no answer with a usable time: the newest lies in the future",),
            ["detector.future_time"],
        ),
    ],
)
def test_ages_name_what_is_missing(frame_s, answer_s, texts, codes):
    faults = monitor(frame_s, answer_s).faults(10.0)
    assert fault_texts(faults) == texts
    assert [fault.code for fault in faults] == codes


def test_a_fault_stays_equal_while_it_lasts():
    assert len({monitor(9.0, 9.0).faults(10.0 + age) for age in range(5)}) == 1


def test_a_recording_has_no_faults():
    assert monitor(None, None, live=False).faults(10.0) == ()


def test_a_failing_stage_explains_a_silence_and_is_none_by_itself():
    watch = monitor(10.0, 10.0)
    watch.record("camera.undecodable", "camera", "broken", 10.0)
    watch.record("detector.error", "detector", "device lost", 10.0)
    assert watch.faults(10.1) == ()
    assert [fault.code for fault in watch.faults(11.0)] == [
        "camera.no_frame",
        "detector.no_answer",
        "camera.undecodable",
        "detector.error",
    ]
    watch.record("camera.undecodable", "camera", None, 11.0)
    watch.record("detector.error", "detector", None, 11.0)
    assert len(watch.faults(11.0)) == 2


def test_a_notice_of_another_part_leaves_the_light_alone():
    watch = monitor(10.0, 10.0, None, SPEAKER)
    assert watch.faults(10.0) == ()
    assert watch.notices() == (SPEAKER,)


def test_a_fault_of_another_part_reaches_the_light():
    stuck = Fault("light", "light.not_refreshed", "stuck")
    watch = monitor(10.0, 10.0, SPEAKER, stuck)
    assert watch.faults(10.0) == (stuck,)
    assert watch.notices() == (SPEAKER,)


@pytest.mark.parametrize("code", ["light.error", "light.hang", "light.thread_ended"])
def test_a_lamp_that_does_not_obey_is_a_fault_and_not_a_notice(code):
    absent = Fault("light", code, "no such chip")
    watch = monitor(10.0, 10.0, absent)
    assert watch.faults(10.0) == (absent,)
    assert watch.notices() == ()
