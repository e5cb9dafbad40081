"""Episodes: arrays at once and frame by frame agree; scenes do not run into one another."""

from __future__ import annotations

import numpy as np
import pytest

from bikeped.decision.episodes import EpisodeTracker, onsets, runs


def test_runs_of_equal_neighbours():
    assert runs([3, 3, 0, 2, 3, 3]).tolist() == [[0, 2], [2, 3], [3, 4], [4, 6]]
    assert runs([True]).tolist() == [[0, 1]]
    assert runs([]).shape == (0, 2)


def test_an_onset_is_the_first_frame_of_an_episode():
    active = np.array([True, True, False, False, True, True])
    assert onsets(active).tolist() == [True, False, False, False, True, False]
    assert active.tolist() == [True, True, False, False, True, True]  # is left as it was
    assert onsets(np.zeros(0, np.bool_)).tolist() == []


def test_no_episode_spans_two_scenes():
    active = np.array([False, True, True, True, True, False])
    assert np.flatnonzero(onsets(active, [0, 3])).tolist() == [1, 3]


@pytest.mark.parametrize("seed", range(5))
def test_frame_by_frame_agrees_with_the_arrays(seed: int):
    active = np.random.default_rng(seed).random(200) < 0.4
    tracker = EpisodeTracker()
    changes = [tracker.update(bool(now)) for now in active]
    assert [change == "begins" for change in changes] == onsets(active).tolist()
    assert [change in ("begins", "lasts") for change in changes] == active.tolist()
    assert tracker.count == int(onsets(active).sum())
    spans = [span for span in runs(active).tolist() if active[span[0]]]
    assert [stop for _, stop in spans if stop < 200] == [
        i for i, change in enumerate(changes) if change == "ends"
    ]
