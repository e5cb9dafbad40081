"""The judge: from detections to a decision, as the pole and a replay have it."""

from __future__ import annotations

import numpy as np
import pytest

from bikeped.config import load_config
from bikeped.pipeline.track_and_decide import Judge
from bikeped.types import Detections, Kind, State

P, C = Kind.PEDESTRIAN, Kind.CYCLIST


def kinds_of_a_walker_first_taken_for_a_cyclist(judge: Judge) -> set[int]:
    """What the tracks are called at the end: ten frames a cyclist, ten a pedestrian."""
    box = np.array([[1880.0, 1500.0, 1960.0, 1800.0]], np.float32)
    for frame in range(20):
        kind = Kind.CYCLIST if frame < 10 else Kind.PEDESTRIAN
        seen = Detections(np.array([kind], np.int8), np.array([0.9], np.float32), box)
        judgement = judge.judge(seen, 3840, 2160, frame / 30, 0.0)
        assert judgement.not_on_ground == 0
    tracks = judgement.tracks
    return {int(tracks.kind[i]) for i in range(len(tracks.kind))}


@pytest.mark.parametrize(("riders_whole", "expected"), [(False, C), (True, P)])
def test_only_where_bicycles_are_easily_missed_a_person_stays_on_one(riders_whole, expected):
    judge = Judge(load_config(None), riders_whole=riders_whole)
    for _ in range(2):  # nothing of the first round is left in the second
        judge.reset()
        assert kinds_of_a_walker_first_taken_for_a_cyclist(judge) == {expected}


@pytest.mark.parametrize("wrong", [P, C])
def test_one_wrong_first_sight_starts_no_memory_of_a_cyclist(wrong):
    """Two sights make a track; when they differ, the newer one is right."""
    judge = Judge(load_config(None), riders_whole=True)
    right = P if wrong is C else C
    box = np.array([[1880.0, 1500.0, 1960.0, 1800.0]], np.float32)
    for frame in range(20):
        kind = np.array([wrong if frame == 0 else right], np.int8)
        seen = Detections(kind, np.array([0.9], np.float32), box)
        judgement = judge.judge(seen, 3840, 2160, frame / 30, 0.0)
        assert set(judgement.tracks.kind.tolist()) <= {right}
        assert judgement.decision.state in (
            {State.IDLE, State.SAFE} if right is P else {State.IDLE}
        )


def test_a_reset_forgets_what_was_seen():
    judge = Judge(load_config(None))
    kinds_of_a_walker_first_taken_for_a_cyclist(judge)
    judge.reset()
    tracks = judge.judge(Detections.empty(), 3840, 2160, 0.0, 0.0).tracks
    assert len(tracks) == 0
