"""Greedy matching against the plain loop that it claims to equal."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.tracking.kalman import MotionNoise
from bikeped.tracking.matching import match_greedy

repeatable = settings(derandomize=True, deadline=None, max_examples=150)


def plain_greedy(pairs, tracks):
    """All pairs sorted by distance, then track, then detection; each taken if both are free."""
    matched, taken = [-1] * tracks, set()
    for _, track, detection in sorted(pairs):
        if matched[track] < 0 and detection not in taken:
            matched[track] = detection
            taken.add(detection)
    return matched


@repeatable
@given(
    st.integers(1, 8),
    st.integers(1, 8),
    st.dictionaries(
        st.tuples(st.integers(0, 7), st.integers(0, 7)), st.integers(0, 5), max_size=64
    ),
)
def test_equals_the_plain_loop_ties_included(tracks, detections, costs):
    pairs = sorted(
        (track, detection, float(cost))
        for (track, detection), cost in costs.items()
        if track < tracks and detection < detections
    )
    track = np.array([p[0] for p in pairs], np.intp)
    detection = np.array([p[1] for p in pairs], np.intp)
    cost = np.array([p[2] for p in pairs], np.float64)
    expected = plain_greedy([(c, t, d) for t, d, c in pairs], tracks)
    assert match_greedy(track, detection, cost, tracks, detections).tolist() == expected


def test_nearest_first_is_not_the_cheapest_sum():
    # Track 0 is 2 from detection 0 and 3 from detection 1; track 1 is 1 from detection 0 and 9
    # from detection 1. The cheapest sum keeps both near; nearest first gives track 1 its nearest.
    track, detection = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    matched = match_greedy(track, detection, np.array([2.0, 3.0, 1.0, 9.0]), 2, 2)
    assert matched.tolist() == [1, 0]
    matched = match_greedy(track, detection, np.array([1.0, 1.1, 1.05, 9.0]), 2, 2)
    assert matched.tolist() == [0, 1]  # 10 in all, where 2.15 would have been possible


def test_no_pairs():
    none = np.zeros(0, np.intp)
    assert match_greedy(none, none, np.zeros(0), 3, 2).tolist() == [-1, -1, -1]
    assert match_greedy(none, none, np.zeros(0), 0, 0).tolist() == []


GATED = TrackerSettings(
    match_radius_m=3.0,
    max_unseen_s=0.3,
    max_speed_mps=(6.0, 20.0, 40.0),
    position_noise_m=1.6,
    confirm_hits=2,
    motion=MotionNoise(),
)


@pytest.mark.parametrize("tracker_settings", [TrackerSettings(max_unseen_s=0.2), GATED])
@pytest.mark.parametrize("seed", range(4))
def test_the_tracker_matches_as_the_plain_loop_does(tracker_settings, seed):
    """Half-metre positions, so that many distances tie; every frame is matched anew by hand."""
    rng = np.random.default_rng(seed)
    tracker = BatchTracker(tracker_settings)
    reach = tracker_settings.max_speed_mps
    ties = 0
    for frame in range(60):
        count = rng.integers(0, 9)
        xy = rng.integers(0, 12, (count, 2)) / 2
        kind = rng.integers(0, 2, count).astype(np.int8)
        now = frame / 30
        step = now - tracker.time_s if frame else 0.0
        pairs = []
        alive = np.nonzero(tracker.alive[0])[0]
        for slot in alive.tolist():
            px, py = (tracker.xy_m[0, slot] + tracker.velocity_mps[0, slot] * step).tolist()
            sx, sy = tracker._seen_xy_m[0, slot].tolist()
            speed = reach[int(tracker.kind[0, slot])]
            gate = speed * (now - tracker.seen_s[0, slot]) + tracker_settings.position_noise_m
            for d, (x, y) in enumerate(xy.tolist()):
                cost = (px - x) ** 2 + (py - y) ** 2
                if tracker.kind[0, slot] != kind[d] or cost > tracker_settings.match_radius_m**2:
                    continue
                if (x - sx) ** 2 + (y - sy) ** 2 <= gate**2:
                    pairs.append((cost, slot, d))
        costs = [p[0] for p in pairs]
        ties += len(costs) - len(set(costs))
        expected = plain_greedy(pairs, tracker.alive.shape[1])
        ids = tracker.id[0].copy()
        tracker.update(now, xy[None], kind[None])
        for slot in alive.tolist():
            if tracker.alive[0, slot] and tracker.id[0, slot] == ids[slot]:
                assert tracker.detection[0, slot] == expected[slot]
            else:
                assert expected[slot] == -1  # only the unmatched are dropped
    assert ties > 5
