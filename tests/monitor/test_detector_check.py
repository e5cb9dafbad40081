"""When a detector counts as blind, and when it is checked."""

from __future__ import annotations

import numpy as np

from bikeped.monitor.detector_check import (
    CHECK_EVERY_S,
    MOTION_S,
    MOVERS,
    RECHECK_S,
    SILENT_S,
    DetectorCheck,
    finds_again,
)
from bikeped.types import Detections, Kind


def boxes(*objects: tuple[Kind, float]) -> Detections:
    n = len(objects)
    box = np.array([(u, 10, u + 20, 60) for _, u in objects], np.float32).reshape(n, 4)
    return Detections(np.array([k for k, _ in objects], np.int8), np.ones(n, np.float32), box)


def watch(
    check: DetectorCheck,
    start_s: float,
    seconds: float,
    count: int = 0,
    motion_s: float = 0.0,
    movers: int = MOVERS,
) -> float:
    """Answers twice a second; returns the time after them."""
    for n in range(round(seconds * 2)):
        check.answered(count, start_s + n / 2, motion_s, movers)
    return start_s + seconds


def test_every_known_object_must_be_found_again() -> None:
    known = boxes((Kind.PEDESTRIAN, 0), (Kind.CYCLIST, 100))
    assert finds_again(known, boxes((Kind.CYCLIST, 103), (Kind.VEHICLE, 50), (Kind.PEDESTRIAN, 2)))
    assert not finds_again(known, boxes((Kind.PEDESTRIAN, 0)))
    assert not finds_again(known, boxes((Kind.PEDESTRIAN, 0), (Kind.PEDESTRIAN, 100)))
    assert not finds_again(known, boxes((Kind.PEDESTRIAN, 0), (Kind.CYCLIST, 115)))
    assert not finds_again(known, Detections.empty())


def test_two_failures_in_a_row_are_a_fault_and_one_success_ends_it() -> None:
    check = DetectorCheck()
    assert not check.due()
    now_s = watch(check, 100.0, CHECK_EVERY_S + 1, count=1)
    assert check.due()
    assert not check.due(waits_s=5.0)
    check.checked(passed=False)
    assert check.fault is None
    assert not check.trusted
    assert not check.due()
    now_s = watch(check, now_s, RECHECK_S + 1, count=1)
    assert check.due()
    check.checked(passed=False)
    assert check.fault is not None
    assert check.fault.code == "detector.blind"
    assert "check picture" in check.fault.detail
    now_s = watch(check, now_s, RECHECK_S + 1, count=1)
    check.checked(passed=True)
    assert check.fault is None
    assert check.trusted
    assert not check.due()
    watch(check, now_s, CHECK_EVERY_S + 1, count=1)
    assert check.due()
    numbers = check.numbers
    assert (numbers.check_passes, numbers.check_failures) == (1, 2)
    assert numbers.check_age_s is not None
    assert numbers.check_age_s >= CHECK_EVERY_S
    assert numbers.detection_age_s == 0.0


def test_much_motion_and_no_detection_is_a_fault_until_something_is_found() -> None:
    check = DetectorCheck()
    now_s = watch(check, 0.0, SILENT_S, motion_s=MOTION_S)
    assert check.fault is None
    now_s = watch(check, now_s, 1.0, motion_s=MOTION_S)
    assert check.fault is not None
    assert check.verdict.active
    assert check.verdict.value == check.verdict.threshold == 1.0
    now_s = watch(check, now_s, 30.0)  # the street is empty now, the model as blind as before
    assert check.fault is not None
    assert not check.trusted
    watch(check, now_s, 1.0, count=1)
    assert check.fault is None


def test_a_check_that_passes_on_an_empty_street_ends_it_too() -> None:
    check = DetectorCheck()
    now_s = watch(check, 0.0, SILENT_S + 1, motion_s=MOTION_S)
    check.checked(passed=True)
    assert check.fault is not None  # it finds the known, and ignores those who move
    watch(check, now_s, 1.0)
    check.checked(passed=True)
    assert check.fault is None


def test_little_motion_one_thing_or_a_detection_now_and_then_is_none() -> None:
    for motion_s, movers in ((MOTION_S - 0.1, MOVERS), (20.0, MOVERS - 1)):
        check = DetectorCheck()
        watch(check, 0.0, 120.0, motion_s=motion_s, movers=movers)
        assert check.fault is None
    check, now_s = DetectorCheck(), 0.0
    for _ in range(5):
        now_s = watch(check, now_s, SILENT_S - 2, motion_s=20.0)
        now_s = watch(check, now_s, 1.0, count=1, motion_s=20.0)
    assert check.fault is None


def test_a_pause_of_the_camera_is_no_silence_of_the_model() -> None:
    check = DetectorCheck()
    watch(check, 0.0, 10.0, count=1)
    now_s = watch(check, 100.0, 10.0, motion_s=20.0)
    assert check.fault is None
    now_s = watch(check, now_s, SILENT_S, motion_s=20.0)
    assert check.fault is not None


def test_time_that_runs_back_does_not_put_the_check_off() -> None:
    check = DetectorCheck()
    watch(check, 1000.0, 5.0, count=1)
    watch(check, 0.0, CHECK_EVERY_S + 1, count=1)
    assert check.due()
    assert DetectorCheck().numbers.check_age_s is None
