"""One rider, one track, one kind, whether the detector often misses the bicycle or boxes both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.tracking.kalman import MotionNoise
from bikeped.types import Kind

P, C, V = int(Kind.PEDESTRIAN), int(Kind.CYCLIST), int(Kind.VEHICLE)
SETTINGS = TrackerSettings(
    max_unseen_s=10.0,
    confirm_hits=2,
    max_speed_mps=(6.0, 20.0, 40.0),
    position_noise_m=0.75,
    motion=MotionNoise(),
    rider_radius_m=1.0,
)
#: Of a detector that boxes rider and cycle as one.
WHOLE = replace(SETTINGS, cyclist_box_includes_rider=True)


def feed(tracker: BatchTracker, frame: int, *detections: tuple[float, ...]) -> None:
    """Detections are (kind, x, y); those with a confidence are joined riders."""
    xy = np.asarray([p[1:3] for p in detections]).reshape(1, -1, 2)
    kind = np.asarray([[p[0] for p in detections]], np.int8).reshape(1, -1)
    confidence = np.asarray([[p[3] if len(p) > 3 else 1.0 for p in detections]], np.float32)
    ridden = (kind == C) & (confidence < 1)
    tracker.update(frame / 30, xy, kind, ridden, confidence)


def kinds(tracker: BatchTracker) -> dict[int, int]:
    alive = tracker.alive[0]
    return dict(zip(tracker.id[0][alive].tolist(), tracker.kind[0][alive].tolist(), strict=True))


def test_a_flickering_rider_stays_one_cyclist():
    tracker = BatchTracker(SETTINGS)
    rng = np.random.default_rng(3)
    for frame in range(120):
        cycle_seen = frame < 3 or rng.random() < 0.4
        feed(tracker, frame, (C if cycle_seen else P, 4.0 * frame / 30, 5.0))
        assert kinds(tracker) == {1: C}


def test_a_rider_first_taken_for_a_walker_becomes_a_cyclist_without_leaving_a_ghost():
    tracker = BatchTracker(SETTINGS)
    for frame in range(20):
        feed(tracker, frame, (P if frame < 10 else C, 4.0 * frame / 30, 5.0))
    assert kinds(tracker) == {1: C}


def test_one_false_bicycle_does_not_make_a_walker_a_cyclist():
    tracker = BatchTracker(SETTINGS)
    for frame in range(60):
        feed(tracker, frame, (C if frame == 30 else P, 1.3 * frame / 30, 5.0))
        assert kinds(tracker) == {1: P}


@pytest.mark.parametrize("first", [0, 5, 40])
@pytest.mark.parametrize("gap", [1, 3])
def test_two_faint_bicycles_under_a_walker_do_not_make_a_cyclist(first, gap):
    tracker = BatchTracker(SETTINGS)
    for step in range(60):
        faint = (C, 1.3 * step * gap / 30, 5.0, 0.14)
        feed(tracker, step * gap, faint if step in (first, first + 1) else (P, *faint[1:3]))
        assert kinds(tracker) == {1: P}


@pytest.mark.parametrize("confidence", [0.1, 0.15, 0.3])
def test_a_rider_whose_bicycle_is_faint_but_found_again_and_again_is_a_cyclist(confidence):
    tracker = BatchTracker(SETTINGS)
    rng = np.random.default_rng(8)
    called = []
    for frame in range(120):
        found = rng.random() < 0.8
        place = (4.0 * frame / 30, 5.0)
        feed(tracker, frame, (C, *place, confidence) if found else (P, *place))
        called += kinds(tracker).values()
    assert len(called) == 120
    assert called[20:] == [C] * 100


def test_a_bicycle_without_a_person_is_a_cyclist_however_faint():
    tracker = BatchTracker(SETTINGS)
    xy, kind = np.array([[[4.0, 5.0]]]), np.array([[C]], np.int8)
    alone, faint = np.zeros((1, 1), np.bool_), np.full((1, 1), 0.11, np.float32)
    for frame in range(30):
        tracker.update(frame / 30, xy, kind, alone, faint)
        assert kinds(tracker) == {1: C}


def test_who_gets_off_and_walks_is_a_pedestrian_again():
    tracker = BatchTracker(SETTINGS)
    for frame in range(30 + 90):
        feed(tracker, frame, (C if frame < 30 else P, 1.3 * frame / 30, 5.0))
    assert kinds(tracker) == {1: P}


def test_a_pedestrian_beside_a_cyclist_who_is_seen_keeps_a_track_of_their_own():
    tracker = BatchTracker(SETTINGS)
    for frame in range(30):
        feed(tracker, frame, (C, 0.0, 5.0), (P, 0.6, 5.0))
    assert sorted(kinds(tracker).values()) == [P, C]


def test_a_person_farther_than_a_rider_can_be_is_new():
    tracker = BatchTracker(SETTINGS)
    for frame in range(5):
        feed(tracker, frame, (C, 0.0, 5.0))
    feed(tracker, 5, (P, 1.5, 5.0))
    assert kinds(tracker) == {1: C, 2: P}


@pytest.mark.parametrize(("unseen_frames", "continued"), [(29, True), (31, False)])
def test_a_cyclist_unseen_for_a_second_is_not_continued_by_a_person(unseen_frames, continued):
    tracker = BatchTracker(SETTINGS)
    for frame in range(5):
        feed(tracker, frame, (C, 0.0, 5.0))
    for frame in range(5, 4 + unseen_frames):
        feed(tracker, frame)
    feed(tracker, 4 + unseen_frames, (P, 0.0, 5.0))
    assert kinds(tracker) == ({1: C} if continued else {1: C, 2: P})


def test_a_person_whom_the_gate_keeps_from_their_own_track_does_not_continue_a_cyclists():
    settings = replace(SETTINGS, max_speed_mps=(6.0, 20.0, 40.0), position_noise_m=0.3)
    tracker = BatchTracker(settings)
    for frame in range(5):
        feed(tracker, frame, (P, 0.0, 5.0), (C, 2.0, 5.0))
    feed(tracker, 5, (P, 1.5, 5.0))  # 1.5 m in one frame: too far for the pedestrian's track
    assert kinds(tracker) == {1: P, 2: C}
    assert tracker.detection[0].tolist()[:2] == [-1, -1]


def test_vehicles_and_the_simulation_are_left_alone():
    for settings, first, then in ((SETTINGS, V, P), (TrackerSettings(), C, P)):
        tracker = BatchTracker(settings)
        for frame in range(5):
            feed(tracker, frame, (first, 0.0, 5.0))
        feed(tracker, 5, (then, 0.2, 5.0))
        assert kinds(tracker) == {1: first, 2: then}


@pytest.mark.parametrize("wrong_frames", [1, 3, 10])
def test_where_riders_are_whole_a_walker_first_taken_for_a_cyclist_is_soon_a_walker(wrong_frames):
    tracker = BatchTracker(WHOLE)
    wrong = 0
    for frame in range(60):
        kind = C if frame < wrong_frames else P
        feed(tracker, frame, (kind, 1.3 * frame / 30, 5.0))
        assert len(kinds(tracker)) == 1  # and there is no ghost of a cyclist
        wrong += kinds(tracker) == {1: C}
    assert kinds(tracker) == {1: P}
    # Of the first two sights the newer one is right.
    assert wrong < 2 * wrong_frames + (wrong_frames > 1)


def test_where_riders_are_whole_the_most_frequent_kind_is_the_tracks():
    for share, expected in ((0.2, P), (0.8, C)):
        rng = np.random.default_rng(5)
        tracker = BatchTracker(WHOLE)
        called = []
        for frame in range(200):
            feed(tracker, frame, (C if rng.random() < share else P, 3.0 * frame / 30, 5.0))
            called += kinds(tracker).values()
        assert called[30:] == [expected] * 170
        assert len(called) == 200


def test_where_riders_are_whole_two_people_stay_two():
    tracker = BatchTracker(WHOLE)
    for frame in range(30):
        feed(tracker, frame, (C, 0.0, 5.0), (P, 0.6, 5.0))
    assert sorted(kinds(tracker).values()) == [P, C]
