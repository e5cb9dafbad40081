"""Where a track is, between what was seen and what was expected."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.tracking.kalman import MotionNoise

#: A track is where its detection is, or where the filter puts it.
RAW = TrackerSettings(max_unseen_s=10.0)
CALM = TrackerSettings(max_unseen_s=10.0, motion=MotionNoise())


def follow(settings: TrackerSettings, seen: np.ndarray, frames: list[int] | None = None):
    """Positions [n, 2] of the one track that follows `seen` [n, 2], at these frame numbers."""
    tracker = BatchTracker(settings)
    positions = []
    for frame, xy in zip(frames or range(len(seen)), seen, strict=True):
        tracker.update(frame / 30, xy.reshape(1, 1, 2), np.zeros((1, 1), np.int8))
        assert tracker.id[0][tracker.alive[0]].tolist() == [1]
        positions.append(tracker.xy_m[0][tracker.alive[0]][0].copy())
    return np.array(positions)


def walk(count: int, velocity: tuple[float, float] = (1.4, -0.3)) -> np.ndarray:
    return np.array([4.0, 9.0]) + np.arange(count)[:, None] / 30 * np.array(velocity)


@given(st.floats(-9, 9), st.floats(-9, 9))
def test_who_moves_evenly_is_soon_followed_without_lag(east, north):
    path = walk(60, (east, north))
    assert follow(CALM, path)[45:] == pytest.approx(path[45:], abs=0.005)


@pytest.mark.parametrize("noise_m", [0.05, 0.1, 0.15])
def test_noise_is_halved_and_closing_in_shows_over_two_frames(noise_m):
    noise = np.random.default_rng(2).normal(0, noise_m, (600, 2))
    path = walk(600)
    raw, calm = follow(RAW, path + noise), follow(CALM, path + noise)
    late = slice(30, None)
    error = [np.sqrt(((p - path)[late] ** 2).sum(1).mean()) for p in (raw, calm)]
    assert error[1] < 0.55 * error[0]
    # What the decision asks: is it farther along than two frames ago?
    forward = [np.mean(p[32:, 0] > p[30:-2, 0]) for p in (raw, calm)]
    assert 1 - forward[1] < 0.5 * (1 - forward[0])


def test_who_stops_at_once_is_overshot_by_little():
    path = np.concatenate([walk(60, (5.0, 0.0)), np.repeat(walk(60, (5.0, 0.0))[-1:], 60, 0)])
    calm = follow(CALM, path)
    assert np.abs(calm - path).max() < 0.45
    assert np.abs(calm - path)[-20:].max() < 0.05


def test_after_a_gap_the_detection_counts_for_more():
    frames = [*range(30), 90]
    seen = np.concatenate([walk(30), walk(91)[90:] + np.array([0.8, 0.0])])
    calm = follow(CALM, seen, frames)
    assert calm[-1] == pytest.approx(seen[-1], abs=0.01)
    near = follow(CALM, np.concatenate([walk(30), walk(31)[30:] + np.array([0.8, 0.0])]))
    assert near[-1, 0] - walk(31)[30, 0] < 0.3


def test_a_young_track_is_calmer_than_its_sights_and_does_not_seem_to_walk():
    rng = np.random.default_rng(4)
    error, moved = {RAW: [], CALM: []}, {RAW: [], CALM: []}
    for _ in range(400):
        seen = np.array([5.0, 7.0]) + rng.normal(0, 0.05, (9, 2))
        for settings in (RAW, CALM):
            found = follow(settings, seen) - (5.0, 7.0)
            error[settings].append((found**2).sum(1))
            moved[settings].append(np.hypot(*(found[2:] - found[:-2]).T) > 0.15)
    noise = [np.sqrt(np.mean(error[settings], axis=0)) for settings in (RAW, CALM)]
    assert (noise[1][2:] < 0.8 * noise[0][2:]).all()
    assert noise[1][-1] < 0.6 * noise[0][-1]
    walks = [np.mean(moved[settings], axis=0) for settings in (RAW, CALM)]
    assert (walks[1] < 0.5 * walks[0]).all()
