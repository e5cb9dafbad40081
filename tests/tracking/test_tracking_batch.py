"""The life of a track, step by step, and independent scenes in one batch."""

import numpy as np
import pytest

from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.tracking.kalman import MotionNoise

PEDESTRIAN, CYCLIST, VEHICLE = 0, 1, 2
#: As the pole's configuration has it.
POLE = TrackerSettings(
    match_radius_m=3.0,
    max_unseen_s=10.0,
    frame_s=1 / 30,
    confirm_hits=2,
    max_speed_mps=(6.0, 20.0, 40.0),
    position_noise_m=0.75,
    motion=MotionNoise(),
    max_range_m=60.0,
)


def feed(tracker, t, *points, kind=PEDESTRIAN):
    """One scene, one frame; `points` are (x, y) or (x, y, kind)."""
    xy = np.array([p[:2] for p in points], np.float64).reshape(1, -1, 2)
    kinds = np.array([[p[2] if len(p) > 2 else kind for p in points]], np.int8)
    tracker.update(t, xy, kinds.reshape(1, -1))


def present(tracker):
    """{id: (x, y)} of the reported tracks."""
    slots = np.nonzero(tracker.reported[0])[0]
    return {int(tracker.id[0, s]): tuple(tracker.xy_m[0, s].tolist()) for s in slots}


def slot_of(tracker, number):
    return int(np.nonzero(tracker.alive[0] & (tracker.id[0] == number))[0][0])


# ---- the pole's tracker: birth, confirmation, coasting, return, end


def test_birth_and_confirmation():
    tracker = BatchTracker(POLE)
    feed(tracker, 0.0, (5, 0))
    assert present(tracker) == {}
    assert tracker.alive.sum() == 1
    feed(tracker, 1 / 30, (5, 0.01))
    assert present(tracker)[1] == pytest.approx((5, 0.01), abs=0.005)
    assert tracker.detection[0, slot_of(tracker, 1)] == 0


def test_a_single_false_detection_never_counts_and_is_soon_forgotten():
    tracker = BatchTracker(POLE)
    feed(tracker, 0.0, (5, 0))
    for i in range(1, 7):
        feed(tracker, i / 30)
        assert tracker.alive.sum() == 1
        assert present(tracker) == {}
    feed(tracker, 7 / 30)  # 0.2 s have passed
    assert tracker.alive.sum() == 0


def test_a_lost_track_coasts_at_its_velocity_and_is_found_again():
    tracker = BatchTracker(POLE)
    for i in range(31):
        feed(tracker, i / 30, (5, 5 * i / 30), kind=CYCLIST)
    for i in range(31, 61):
        feed(tracker, i / 30)
        assert present(tracker)[1] == pytest.approx((5, 5 * i / 30), abs=1e-3)
        assert tracker.detection[0, slot_of(tracker, 1)] == -1
    feed(tracker, 61 / 30, (5.3, 5 * 61 / 30), kind=CYCLIST)
    assert present(tracker) == {1: pytest.approx((5.3, 5 * 61 / 30), abs=0.02)}


def test_dropped_after_10_seconds_and_not_before():
    tracker = BatchTracker(POLE)
    feed(tracker, 0.0, (5, 0))
    feed(tracker, 1 / 30, (5, 0))
    for i in range(2, 302):
        feed(tracker, i / 30)
        assert 1 in present(tracker), i
    feed(tracker, 302 / 30)
    assert present(tracker) == {}
    feed(tracker, 303 / 30, (5, 0))
    feed(tracker, 304 / 30, (5, 0))
    assert set(present(tracker)) == {2}  # ids are never used again


def test_a_track_that_coasts_out_of_range_is_dropped():
    tracker = BatchTracker(POLE)
    for i in range(30):
        feed(tracker, i / 30, (50 + 10 * i / 30, 0), kind=CYCLIST)
    assert present(tracker)
    feed(tracker, 31 / 30)
    assert not present(tracker)


@pytest.mark.parametrize("settings", [POLE, TrackerSettings()])
def test_no_match_across_classes(settings):
    tracker = BatchTracker(settings)
    feed(tracker, 0.0, (5, 0, PEDESTRIAN))
    feed(tracker, 1 / 30, (5, 0, PEDESTRIAN))
    feed(tracker, 2 / 30, (5, 0, CYCLIST))
    feed(tracker, 3 / 30, (5, 0, CYCLIST))
    assert set(present(tracker)) == {1, 2}
    kinds = tracker.kind[0][tracker.reported[0]]
    assert sorted(kinds.tolist()) == [PEDESTRIAN, CYCLIST]


# ---- the speed gate


def test_the_gate_refuses_a_jump_but_does_not_breed():
    tracker = BatchTracker(POLE)
    for i in range(5):
        feed(tracker, i / 30, (5, 0))
    # 6 m/s * 1/30 s + 0.75 m = 0.95 m: 1.0 m is too far for one frame, but no second person.
    feed(tracker, 5 / 30, (5, 1.0))
    assert tracker.alive.sum() == 1
    assert tracker.detection[0, 0] == -1
    # A frame later 6 * 2/30 + 0.75 = 1.15 m are allowed, and it is the same track.
    feed(tracker, 6 / 30, (5, 1.0))
    assert list(present(tracker)) == [1]
    assert tracker.detection[0, 0] == 0
    assert tracker.alive.sum() == 1


def test_a_detection_beside_a_track_that_has_its_own_is_a_new_one():
    tracker = BatchTracker(POLE)
    feed(tracker, 0.0, (5, 0))
    feed(tracker, 1 / 30, (5, 0), (5, 1.2))
    feed(tracker, 2 / 30, (5, 0), (5, 1.2))
    assert present(tracker) == {1: (5, 0), 2: (5, 1.2)}


def test_the_gate_knows_the_class():
    for kind, far_enough in ((PEDESTRIAN, 0.9), (CYCLIST, 1.4), (VEHICLE, 2.0)):
        tracker = BatchTracker(POLE)
        feed(tracker, 0.0, (5, 0), kind=kind)
        feed(tracker, 1 / 30, (5, far_enough), kind=kind)
        assert tracker.hits[0, 0] == 2
        tracker = BatchTracker(POLE)
        feed(tracker, 0.0, (5, 0), kind=kind)
        feed(tracker, 1 / 30, (5, far_enough + 0.1), kind=kind)
        assert tracker.hits[0, 0] == 1  # 6, 20 or 40 m/s * 1/30 s + 0.75 m


def test_no_velocity_beyond_the_classs_speed():
    tracker = BatchTracker(POLE)
    for frame in range(6):
        feed(tracker, frame / 30, (5 + 0.4 * frame, 0))  # 12 m/s
        assert tracker.hits[0, 0] == frame + 1
    assert np.hypot(*tracker.velocity_mps[0, 0]) == pytest.approx(6.0)


def test_farther_than_the_match_radius_is_somebody_else():
    for settings in (POLE, TrackerSettings()):
        tracker = BatchTracker(settings)
        feed(tracker, 0.0, (5, 0))
        feed(tracker, 1 / 30, (5, 3.01))
        assert tracker.alive.sum() == 2
    tracker = BatchTracker(TrackerSettings())
    feed(tracker, 0.0, (5, 0))
    feed(tracker, 1 / 30, (5, 3.0))  # at the radius it still is the same
    assert tracker.alive.sum() == 1


# ---- time


@pytest.mark.parametrize("every", [2, 3, 6])
def test_dropped_frames_do_not_change_velocity_or_position(every):
    all_frames, some = BatchTracker(POLE), BatchTracker(POLE)
    for i in range(61):
        feed(all_frames, i / 30, (5, 0.1 * i), kind=CYCLIST)
        if i % every == 0:
            feed(some, i / 30, (5, 0.1 * i), kind=CYCLIST)
    for tracker in (all_frames, some):
        assert present(tracker)[1] == pytest.approx((5, 6), abs=1e-3)
        np.testing.assert_allclose(tracker.velocity_mps[0, 0], (0, 3), atol=0.02)


@pytest.mark.parametrize("kind", [PEDESTRIAN, CYCLIST])
def test_frames_without_a_detection_are_a_longer_prediction(kind):
    seen = {0: 0.0, 1: 0.04, 5: 0.2, 6: 0.19, 11: 0.5}
    ticking, sparse = BatchTracker(POLE), BatchTracker(POLE)
    for frame in range(12):
        feed(ticking, frame / 30, *([(5, seen[frame])] if frame in seen else []), kind=kind)
        if frame in seen:
            feed(sparse, frame / 30, (5, seen[frame]), kind=kind)
    for name in ("xy_m", "velocity_mps", "covariance"):
        np.testing.assert_allclose(getattr(ticking, name)[0, 0], getattr(sparse, name)[0, 0])


def test_speed_at_5_frames_a_second_is_that_at_30():
    """Box noise of 0.1 m; a rider sets off, and rides at 5 m/s."""
    rng = np.random.default_rng(11)
    speeds: dict[int, list[float]] = {1: [], 6: []}
    for _ in range(40):
        for gap, found in speeds.items():
            tracker = BatchTracker(POLE)
            for i in range(0, 91, gap):
                place = np.array([5, 5 * max(i - 30, 0) / 30]) + rng.normal(0, 0.1, 2)
                feed(tracker, i / 30, tuple(place), kind=CYCLIST)
            found.append(float(np.hypot(*tracker.velocity_mps[0, 0])))
    assert np.mean(speeds[1]) == pytest.approx(5, rel=0.03)
    assert np.mean(speeds[6]) == pytest.approx(np.mean(speeds[1]), rel=0.05)
    assert np.abs(np.array(speeds[6]) - 5).max() < 1.0


def test_one_wrong_match_of_a_young_cyclist_is_not_believed():
    # 0.66 m in a frame, as when a box jumps to a neighbour: 19.8 m/s.
    tracker = BatchTracker(POLE)
    for frame, east in enumerate((5.0, 5.66, 5.66, 5.66, 5.66)):
        feed(tracker, frame / 30, (east, 0), kind=CYCLIST)
        assert np.hypot(*tracker.velocity_mps[0, 0]) < 12
    assert np.hypot(*tracker.velocity_mps[0, 0]) < 5


def test_irregular_times():
    rng = np.random.default_rng(1)
    t, tracker = 0.0, BatchTracker(POLE)
    for _ in range(200):
        t += rng.choice([0.005, 1 / 30, 0.05, 0.2, 0.9])
        feed(tracker, t, (5 + 2 * t / 50, -20 + 0.5 * t))
    assert set(present(tracker)) == {1}
    np.testing.assert_allclose(tracker.velocity_mps[0, 0], (0.04, 0.5), atol=1e-6)


def test_time_must_not_go_back():
    tracker = BatchTracker(POLE)
    feed(tracker, 1.0)
    with pytest.raises(ValueError, match=r"0\.9 is before the last update at 1\.0"):
        feed(tracker, 0.9)


# ---- the simulation's settings (definitions, section 7)


def test_simulation_reports_from_the_first_detection():
    tracker = BatchTracker(TrackerSettings())
    feed(tracker, 0.0, (5, 0))
    assert present(tracker) == {1: (5, 0)}


def test_simulation_velocity_and_acceleration_are_exponential_means_from_zero():
    tracker = BatchTracker(TrackerSettings())
    ys = [0.0, 0.3, 0.5, 0.9, 0.8, 1.6]
    velocity = acceleration = 0.0  # per frame, as the simulation counts
    for i, y in enumerate(ys):
        feed(tracker, i / 30, (5, y))
        if i:
            before = velocity
            velocity = 0.5 * velocity + 0.5 * (y - ys[i - 1])
            acceleration = 0.5 * acceleration + 0.5 * (velocity - before)
        assert tracker.velocity_mps[0, 0, 1] / 30 == pytest.approx(velocity, abs=1e-9)
        assert tracker.acceleration_mps2[0, 0, 1] / 900 == pytest.approx(acceleration, abs=1e-9)


def test_simulation_has_no_speed_gate():
    tracker = BatchTracker(TrackerSettings())
    feed(tracker, 0.0, (5, 0))
    feed(tracker, 1 / 30, (5, 2.9))
    assert present(tracker) == {1: (5, 2.9)}


def test_simulation_removes_after_more_than_30_unseen_frames():
    for start in (0, 7, 1000):  # i / 30 rounds differently everywhere
        tracker = BatchTracker(TrackerSettings())
        feed(tracker, start / 30, (5, 0))
        for i in range(1, 31):
            feed(tracker, (start + i) / 30)
            assert present(tracker) == {1: (5, 0)}
        feed(tracker, (start + 31) / 30)
        assert present(tracker) == {}


def test_simulation_keeps_a_track_that_returns_after_30_unseen_frames():
    tracker = BatchTracker(TrackerSettings())
    feed(tracker, 0.0, (5, 0))
    for i in range(1, 31):
        feed(tracker, i / 30)
    feed(tracker, 31 / 30, (5, 0.5))
    assert present(tracker) == {1: (5, 0.5)}


# ---- ten people standing


def crowd(seed, spacing, miss, layout):
    """Tracker after each of 300 frames of ten people standing, boxes 10 cm uncertain."""
    rng = np.random.default_rng(seed)
    place = np.arange(10)
    if layout == "row":
        people = np.stack([np.full(10, 8.0), place * spacing - 4], axis=1)
    else:
        people = np.stack([8 + place // 5 * spacing, place % 5 * spacing - 4], axis=1)
    tracker = BatchTracker(POLE)
    for frame in range(300):
        xy = people + rng.normal(0, 0.1, people.shape)
        xy = rng.permutation(xy[rng.random(10) >= miss])
        tracker.update(frame / 30, xy[None], np.zeros((1, len(xy)), np.int8))
        yield frame, tracker


@pytest.mark.parametrize("layout", ["row", "two rows"])
@pytest.mark.parametrize("spacing", [0.8, 1.0, 1.5, 2.0])
def test_ten_people_standing_stay_ten_tracks(spacing, layout):
    for seed in range(3):
        for frame, tracker in crowd(seed, spacing, 0.0, layout):
            ids = sorted(present(tracker))
            assert ids == (list(range(1, 11)) if frame else [])
        assert tracker.alive.sum() == 10


@pytest.mark.parametrize("layout", ["row", "two rows"])
@pytest.mark.parametrize("spacing", [1.0, 1.5, 2.0])
def test_ten_people_of_whom_a_quarter_is_missed_never_become_eleven(spacing, layout):
    for seed in range(3):
        most = max(int(tracker.reported.sum()) for _, tracker in crowd(seed, spacing, 0.25, layout))
        assert most == 10


def test_a_track_that_expired_in_a_gap_is_not_matched_after_it():
    tracker = BatchTracker(TrackerSettings(max_unseen_s=1.0))
    feed(tracker, 0.0, (5, 0))
    feed(tracker, 3.0, (5, 0))
    assert present(tracker) == {2: (5, 0)}


def test_a_track_lives_exactly_as_long_as_it_may_be_unseen_at_every_frame():
    for first in range(200):
        tracker = BatchTracker(TrackerSettings(max_unseen_s=30 / 30))
        feed(tracker, first / 30, (5, 0))
        for frame in range(1, 31):
            feed(tracker, (first + frame) / 30)
        assert present(tracker) == {1: (5, 0)}, first
        feed(tracker, (first + 31) / 30)
        assert present(tracker) == {}, first


def test_two_updates_at_one_time_are_allowed():
    tracker = BatchTracker(TrackerSettings())
    feed(tracker, 1.0, (5, 0))
    feed(tracker, 1.0, (5, 0))
    assert list(present(tracker)) == [1]


# ---- batch


@pytest.mark.parametrize("settings", [POLE, TrackerSettings()])
def test_lanes_together_equal_each_alone(settings):
    rng = np.random.default_rng(3)
    scenes, places = 5, 12
    together = BatchTracker(settings, scenes, slots=2)
    alone = [BatchTracker(settings, 1, slots=2) for _ in range(scenes)]
    home = rng.uniform(-10, 10, (scenes, places, 2))
    kind_of = rng.integers(0, 3, (scenes, places)).astype(np.int8)
    for frame in range(80):
        xy = home + rng.normal(0, 0.15, home.shape) + np.array([0.03, 0.02]) * frame
        here = rng.random((scenes, places)) < np.array([0.2, 0.5, 0.7, 0.9, 1.0])[:, None]
        kind = np.where(here, kind_of, -1).astype(np.int8)
        xy[~here] = np.where(rng.random(2) < 0.5, np.nan, 3.0)  # empty places hold anything
        together.update(frame / 30, xy, kind)
        for scene, single in enumerate(alone):
            single.update(frame / 30, xy[scene : scene + 1], kind[scene : scene + 1])
            slots = single.alive.shape[1]
            assert not together.alive[scene, slots:].any()
            a, b = together.alive[scene, :slots], single.alive[0]
            assert (a == b).all()
            for name in ("id", "kind", "xy_m", "velocity_mps", "acceleration_mps2", "seen_s",
                         "covariance", "hits", "detection"):  # fmt: skip
                left, right = getattr(together, name)[scene, :slots], getattr(single, name)[0]
                assert (left[a] == right[b]).all(), (frame, scene, name)
    assert together.id.max() > 12


def test_above_the_cap_the_unconfirmed_go_first_and_then_those_unseen_for_longest():
    tracker = BatchTracker(TrackerSettings(max_unseen_s=10.0, confirm_hits=2, max_tracks=4))

    def see(time_s: float, *x_m: float) -> set[int]:
        xy = np.array([[(x, 5.0) for x in x_m]]).reshape(1, -1, 2)
        tracker.update(time_s, xy, np.zeros((1, len(x_m)), np.int8))
        return set(tracker.id[0][tracker.alive[0]].tolist())

    assert see(0.0, 0.0, 20.0) == {1, 2}
    assert see(0.1, 0.0, 20.0) == {1, 2}
    assert see(0.2, 20.0, 40.0) == {1, 2, 3}  # 3 has been seen once
    assert see(0.3, 20.0, 60.0, 80.0) == {1, 2, 4, 5}
    assert see(0.4, 20.0, 60.0, 80.0, 100.0) == {2, 4, 5, 6}  # confirmed, but unseen for longest
    assert see(0.5, 20.0, 60.0, 80.0, 100.0) == {2, 4, 5, 6}
