"""The filter against a textbook's, with matrices, and what it must not depend on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.tracking.kalman import MotionNoise, correct, predict_covariance

repeatable = settings(derandomize=True, deadline=None, max_examples=60)
MOTION = MotionNoise()
#: Without gates, so that every detection is matched and no velocity is limited.
OPEN = TrackerSettings(match_radius_m=1e6, max_unseen_s=1e6, motion=MOTION)
PEDESTRIAN, CYCLIST = 0, 1
gaps = st.lists(st.floats(0.0, 2.0), min_size=1, max_size=25)
seeds = st.integers(0, 2**32 - 1)


def textbook(times, places, kind):
    """State [x, y, vx, vy] and covariance [4, 4] by matrices, as any textbook writes them."""
    noise, growth = MOTION.measured_m[kind] ** 2, MOTION.acceleration_mps2[kind] ** 2 / 30
    state = np.array([*places[0], 0, 0])
    p = np.diag([noise, noise, *[MOTION.first_speed_mps[kind] ** 2] * 2])
    h = np.eye(2, 4)
    for dt, place in zip(np.diff(times), places[1:], strict=True):
        f = np.eye(4) + dt * np.eye(4, k=2)
        q = growth * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        state, p = f @ state, f @ p @ f.T + q
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + noise * np.eye(2))
        state, p = state + gain @ (place - h @ state), (np.eye(4) - gain @ h) @ p
    return state, p


def walk(seed, steps_s):
    """Times [n + 1] and places [n + 1, 2] of somebody who wanders, seen with noise."""
    rng = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.cumsum(steps_s)])
    return times, rng.normal(0, 2, 2) * times[:, None] + rng.normal(0, 0.3, (len(times), 2))


def follow(times, places, kind=CYCLIST):
    tracker = BatchTracker(OPEN)
    for time_s, place in zip(times, places, strict=True):
        tracker.update(float(time_s), place.reshape(1, 1, 2), np.full((1, 1), kind, np.int8))
    assert tracker.alive.sum() == 1
    return tracker.xy_m[0, 0], tracker.velocity_mps[0, 0], tracker.covariance[0, 0]


@repeatable
@given(seeds, gaps, st.sampled_from([PEDESTRIAN, CYCLIST]))
def test_it_is_the_textbooks(seed, steps_s, kind):
    times, places = walk(seed, np.maximum(steps_s, 1e-3))
    xy, velocity, covariance = follow(times, places, kind)
    state, p = textbook(times, places, kind)
    np.testing.assert_allclose(np.concatenate([xy, velocity]), state, rtol=1e-6, atol=1e-6)
    place, mixed, speed = covariance
    expected = np.kron([[place, mixed], [mixed, speed]], np.eye(2))
    np.testing.assert_allclose(p, expected, rtol=1e-6, atol=1e-9)


@repeatable
@given(seeds, gaps, st.floats(0, 1e5), st.floats(-np.pi, np.pi))
def test_neither_the_hour_nor_the_heading_matters(seed, steps_s, later_s, angle):
    times, places = walk(seed, np.maximum(steps_s, 1e-3))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    xy, velocity, covariance = follow(times, places)
    there = follow(times + later_s, places @ turn.T + np.array([3.0, -8.0]))
    np.testing.assert_allclose(there[0], turn @ xy + np.array([3.0, -8.0]), atol=1e-5)
    np.testing.assert_allclose(there[1], turn @ velocity, atol=1e-4)
    np.testing.assert_allclose(there[2], covariance, atol=1e-6)


@repeatable
@given(seeds, gaps)
def test_the_covariance_stays_one_and_a_detection_makes_it_smaller(seed, steps_s):
    rng, noise = np.random.default_rng(seed), MOTION.noise(1 / 30)[[CYCLIST]]
    xy = velocity = np.zeros((1, 2))
    covariance = MOTION.first_covariance()[[CYCLIST]]
    for step in steps_s:
        elapsed = np.array([step])
        before = np.stack(predict_covariance(covariance, elapsed, noise), axis=1)
        measured = rng.normal(0, 3, (1, 2))
        xy, velocity, covariance = correct(xy, velocity, covariance, measured, elapsed, noise)
        place, mixed, speed = covariance[0]
        assert 0 < place < noise[0, 0]
        assert place * speed - mixed**2 > 0
        assert place < before[0, 0]
        assert speed <= before[0, 2]


@repeatable
@given(seeds, st.floats(0, 3), st.floats(0, 3))
def test_a_gap_in_two_steps_is_the_same_gap(seed, first_s, second_s):
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 1, (2, 2))
    whole = root @ root.T
    covariance = np.array([[whole[0, 0], whole[0, 1], whole[1, 1]]])
    noise = MOTION.noise(1 / 30)[[PEDESTRIAN]]
    once = predict_covariance(covariance, np.array([first_s + second_s]), noise)
    half = np.stack(predict_covariance(covariance, np.array([first_s]), noise), axis=1)
    twice = predict_covariance(half, np.array([second_s]), noise)
    np.testing.assert_allclose(np.ravel(twice), np.ravel(once), rtol=1e-9, atol=1e-12)


def test_errors_are_as_large_as_the_covariance_says():
    """People who move as the filter supposes: the mean squared error over the variance is one."""
    rng = np.random.default_rng(2)
    people, frames, frame_s = 500, 60, 1 / 30
    noise = MOTION.noise(frame_s)[np.zeros(people, np.intp)]
    velocity = rng.normal(0, MOTION.first_speed_mps[0], (people, 2))
    place = rng.normal(0, 5, (people, 2))
    seen = place + rng.normal(0, MOTION.measured_m[0], place.shape)
    track, moving = seen, np.zeros((people, 2))
    covariance = MOTION.first_covariance()[np.zeros(people, np.intp)]
    for _ in range(frames):
        push = rng.normal(0, MOTION.acceleration_mps2[0], (people, 2))
        place = place + velocity * frame_s + push * frame_s**2 / 2
        velocity = velocity + push * frame_s
        seen = place + rng.normal(0, MOTION.measured_m[0], place.shape)
        step_s = np.full(people, frame_s)
        track, moving, covariance = correct(
            track + moving * frame_s, moving, covariance, seen, step_s, noise
        )
    assert ((track - place) ** 2).mean() / covariance[0, 0] == pytest.approx(1, abs=0.15)
    assert ((moving - velocity) ** 2).mean() / covariance[0, 2] == pytest.approx(1, abs=0.15)
