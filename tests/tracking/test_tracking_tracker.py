"""The pole's tracker: what it reports, and the prediction over the latency."""

import numpy as np
import pytest

from bikeped.tracking.batch_tracker import TrackerSettings
from bikeped.tracking.tracker import Tracker, predict
from bikeped.types import GroundPoints


def points(*rows):
    """Ground points of (kind, x, y, detection index)."""
    return GroundPoints(
        np.array([r[0] for r in rows], np.int8),
        np.array([r[1:3] for r in rows], np.float64).reshape(-1, 2),
        np.array([r[3] for r in rows], np.int64),
    )


def test_tracks_are_in_order_of_age_with_their_detections():
    tracker = Tracker(TrackerSettings(max_unseen_s=0.05))
    tracker.update(points((0, 1, 0, 0), (0, 9, 0, 1)), 0.0)
    tracker.update(points((0, 9, 0, 4)), 1 / 30)
    tracker.update(points((0, 9, 0, 4)), 2 / 30)  # track 1 ends here and leaves its slot
    tracks = tracker.update(points((1, 5, 5, 7), (0, 9, 0, 3), (0, 20, 0, 2)), 3 / 30)
    assert tracks.id.tolist() == [2, 3, 4]
    assert tracks.kind.tolist() == [0, 1, 0]
    assert tracks.detection.tolist() == [3, 7, 2]
    assert tracks.unseen_s.tolist() == [0, 0, 0]
    assert tracks.time_s == 3 / 30
    tracks = tracker.update(points(), 4 / 30)
    assert tracks.detection.tolist() == [-1, -1, -1]
    assert tracks.unseen_s == pytest.approx([1 / 30] * 3)


def test_velocity_is_the_displacement_over_four_frames():
    tracker = Tracker(TrackerSettings(), speed_window_s=4 / 30)
    ys = [0.0, 0.1, 0.3, 0.2, 0.5, 0.9, 1.0]
    for i, y in enumerate(ys):
        tracks = tracker.update(points((0, 5, y, 0)), i / 30)
        expected = (y - ys[max(i - 4, 0)]) / (4 / 30)  # and of a younger track: not yet believed
        assert tracks.velocity_mps[0] == pytest.approx((0, expected), abs=1e-9)


def test_velocity_with_dropped_frames_spans_the_same_time():
    tracker = Tracker(TrackerSettings(), speed_window_s=4 / 30)
    for i in (0, 1, 2, 3, 7, 8, 12):
        tracks = tracker.update(points((1, 5, 0.2 * i, 0)), i / 30)
    assert tracks.velocity_mps[0] == pytest.approx((0, 6.0))


def test_history_is_the_last_positions_oldest_first_and_ends_with_the_track():
    tracker = Tracker(TrackerSettings(max_unseen_s=0.1), history_length=3)
    for i in range(5):
        tracker.update(points((0, 5, 0.1 * i, 0)), i / 30)
    (path,) = tracker.history().values()
    assert path == [[5, 0.1 * i] for i in (2, 3, 4)]
    for i in range(5, 9):
        tracker.update(points(), i / 30)
    assert tracker.history() == {}


def test_smoothed_runs_parallel_to_the_tracks():
    tracker = Tracker(TrackerSettings())
    for i in range(40):
        tracks = tracker.update(points((0, 5, 0, 0), (1, 9, 0.1 * i, 1)), i / 30)
    velocity, acceleration = tracker.smoothed()
    assert velocity.shape == acceleration.shape == (len(tracks), 2)
    np.testing.assert_allclose(velocity, [[0, 0], [0, 3]], atol=1e-6)
    np.testing.assert_allclose(acceleration, 0, atol=1e-3)


def test_predict_by_order():
    xy, v, a = np.array([[1.0, 2.0]]), np.array([[3.0, -1.0]]), np.array([[2.0, 4.0]])
    assert predict(xy, v, a, 0.5, 0).tolist() == [[1, 2]]
    assert predict(xy, v, a, 0.5, 1).tolist() == [[2.5, 1.5]]
    assert predict(xy, v, a, 0.5, 2).tolist() == [[2.75, 2.0]]
    assert predict(xy, v, None, 0.5, 2).tolist() == [[2.5, 1.5]]
    assert predict(xy, v, a, 0.0, 2).tolist() == [[1, 2]]
    assert predict(xy, v, a, np.array([[0.5]]), 1).tolist() == [[2.5, 1.5]]
    with pytest.raises(ValueError, match="order: expected 0, 1 or 2, got 3"):
        predict(xy, v, a, 0.5, 3)


def test_first_order_is_exact_at_constant_velocity():
    rng = np.random.default_rng(0)
    start, v = rng.normal(0, 5, (20, 2)), rng.normal(0, 3, (20, 2))
    ahead = predict(start, v, np.zeros((20, 2)), 0.2, 1)
    np.testing.assert_allclose(ahead, start + 0.2 * v, atol=1e-12)
    np.testing.assert_allclose(predict(start, v, np.zeros((20, 2)), 0.2, 2), ahead)
