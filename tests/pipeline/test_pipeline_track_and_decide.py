"""Tracking and decision: from detections to a decision, as the device and a replay run it."""

from __future__ import annotations

import numpy as np
import pytest

from bikeped.config.build import MAX_TRACKS
from bikeped.config.load import load_config
from bikeped.pipeline.track_and_decide import CROWDED, MAX_OF_A_KIND, TrackAndDecide
from bikeped.types import Detections, GroundPoints, Kind, State

P, C = Kind.PEDESTRIAN, Kind.CYCLIST


def kinds_of_a_walker_first_taken_for_a_cyclist(track_and_decide: TrackAndDecide) -> set[int]:
    """What the tracks are called at the end: ten frames a cyclist, ten a pedestrian."""
    box = np.array([[1880.0, 1500.0, 1960.0, 1800.0]], np.float32)
    for frame in range(20):
        kind = Kind.CYCLIST if frame < 10 else Kind.PEDESTRIAN
        seen = Detections(np.array([kind], np.int8), np.array([0.9], np.float32), box)
        tracking = track_and_decide.update(seen, 3840, 2160, frame / 30, 0.0)
        assert tracking.not_on_ground == 0
    tracks = tracking.tracks
    return {int(tracks.kind[i]) for i in range(len(tracks.kind))}


@pytest.mark.parametrize(("cyclist_box_includes_rider", "expected"), [(False, C), (True, P)])
def test_only_where_bicycles_are_easily_missed_a_person_stays_on_one(
    cyclist_box_includes_rider, expected
):
    track_and_decide = TrackAndDecide(
        load_config(None), cyclist_box_includes_rider=cyclist_box_includes_rider
    )
    for _ in range(2):  # nothing of the first round is left in the second
        track_and_decide.reset()
        assert kinds_of_a_walker_first_taken_for_a_cyclist(track_and_decide) == {expected}


@pytest.mark.parametrize("wrong", [P, C])
def test_one_wrong_first_sight_starts_no_memory_of_a_cyclist(wrong):
    """Two sights make a track; when they differ, the newer one is right."""
    track_and_decide = TrackAndDecide(load_config(None), cyclist_box_includes_rider=True)
    right = P if wrong is C else C
    box = np.array([[1880.0, 1500.0, 1960.0, 1800.0]], np.float32)
    for frame in range(20):
        kind = np.array([wrong if frame == 0 else right], np.int8)
        seen = Detections(kind, np.array([0.9], np.float32), box)
        tracking = track_and_decide.update(seen, 3840, 2160, frame / 30, 0.0)
        assert set(tracking.tracks.kind.tolist()) <= {right}
        assert tracking.decision.state in ({State.IDLE, State.SAFE} if right is P else {State.IDLE})


def test_a_reset_forgets_what_was_seen():
    track_and_decide = TrackAndDecide(load_config(None))
    kinds_of_a_walker_first_taken_for_a_cyclist(track_and_decide)
    track_and_decide.reset()
    tracks = track_and_decide.update(Detections.empty(), 3840, 2160, 0.0, 0.0).tracks
    assert len(tracks) == 0


@pytest.mark.parametrize(
    ("latency", "age_s", "ahead_s"),
    [
        (['compensation="off"', "camera_offset_s=0.2"], 0.3, 0.0),
        (["compensation=measured"], 0.3, 0.3),
        (["compensation=measured", "camera_offset_s=0.1"], 0.3, 0.4),  # a delay adds to the age
        (["compensation=measured", "max_s=0.25"], 0.3, 0.25),
        (["compensation=measured", "camera_offset_s=0.2", "max_s=0.25"], 0.1, 0.25),
        (["compensation=frames", "frames=6"], 9.9, 0.2),
        (["compensation=frames", "frames=6", "camera_offset_s=0.1"], 9.9, 0.3),
        (["compensation=frames", "frames=60", "max_s=1.5"], 0.0, 1.5),
    ],
)
def test_the_rule_is_asked_about_the_place_ahead_by_age_and_offset_up_to_the_bound(
    monkeypatch, latency, age_s, ahead_s
):
    """A cyclist at a steady speed: how far the rule's position is ahead of the track's."""
    track_and_decide = TrackAndDecide(
        load_config(None, overrides=[f"latency.{setting}" for setting in latency])
    )
    asked = []
    decide = track_and_decide._decider.decide

    def watched(captured_s, number, kind, xy_m, *more):
        asked.append(xy_m)
        return decide(captured_s, number, kind, xy_m, *more)

    monkeypatch.setattr(track_and_decide._decider, "decide", watched)
    for frame in range(90):
        points = GroundPoints(
            np.array([C], np.int8), np.array([[10.0, 4.0 * frame / 30]]), np.array([0])
        )
        tracking = track_and_decide.update_from_points(points, frame / 30, age_s)
    gap_m = asked[-1][0] - tracking.tracks.xy_m[0]
    assert gap_m == pytest.approx([0.0, 4.0 * ahead_s], abs=0.02)


@pytest.mark.parametrize(("frames", "speed_mps"), [(1, 9.0), (2, 4.5), (4, 2.25)])
def test_the_speed_window_reaches_the_rule(frames, speed_mps):
    """A cyclist at rest who then rides 0.3 m in a frame, and a pedestrian ahead."""
    loaded = load_config(
        None,
        [
            f"tracking.speed_window_frames={frames}",
            "tracking.measurement_noise_cyclist_m=0.00001",  # a track is where it was seen
            "tracking.confirm_hits=1",
            "decision.lookback_frames=1",
            "decision.rule=pairwise",
        ],
    )
    track_and_decide = TrackAndDecide(loaded)
    for frame in range(8):
        xy = np.array([[5.0, 0.3 if frame == 7 else 0.0], [5.0, 5.0]])
        points = GroundPoints(np.array([C, P], np.int8), xy, np.arange(2))
        decision = track_and_decide.update_from_points(points, frame / 30).decision
    assert decision.pair is not None
    assert decision.pair.speed_mps == pytest.approx(speed_mps, rel=1e-4)


def boxes(kinds: list[Kind], confidence: list[float], rng: np.random.Generator) -> Detections:
    """Detections of 3840 x 2160 with their feet in the lower half, most confident first."""
    n = len(kinds)
    feet = np.stack([rng.uniform(400, 3440, n), rng.uniform(1150, 2050, n)], axis=1)
    box = np.hstack([feet - np.array([40, 150]), feet + np.array([40, 0])]).astype(np.float32)
    order = np.argsort(confidence)[::-1]
    kind, score = np.array(kinds, np.int8)[order], np.array(confidence, np.float32)[order]
    return Detections(kind, score, box)


def test_of_two_thousand_detections_the_most_confident_of_each_kind_are_tracked():
    track_and_decide = TrackAndDecide(load_config(None))
    rng = np.random.default_rng(5)
    cyclists = 20  # the faintest of all: vehicles and pedestrians do not push them out
    kinds = [P, Kind.VEHICLE] * 990 + [C] * cyclists
    for frame in range(12):
        confidence = np.linspace(0.9, 0.1, len(kinds)).tolist()
        found = boxes(kinds, confidence, rng)
        tracking = track_and_decide.update(found, 3840, 2160, frame / 30, 0.0)
        points = tracking.points
        count = np.bincount(points.kind, minlength=3)
        assert count[P] == count[Kind.VEHICLE] == MAX_OF_A_KIND
        assert 0 < count[C] <= cyclists
        for kind in (P, Kind.VEHICLE):
            kept = points.detection[points.kind == kind]
            on_ground, _ = track_and_decide.ground_mapper.to_ground(
                found, track_and_decide.ground_mapper.framing_for(3840, 2160)
            )
            assert (
                kept.tolist()
                == on_ground.detection[on_ground.kind == kind][:MAX_OF_A_KIND].tolist()
            )
        assert track_and_decide.fault is CROWDED
        assert len(tracking.tracks.id) <= MAX_TRACKS
        assert track_and_decide.tracker.batch.alive.sum() <= MAX_TRACKS
    assert track_and_decide.capped_frames == 12
    few = boxes([P, C], [0.9, 0.8], rng)
    track_and_decide.update(few, 3840, 2160, 1.0, 0.0)
    assert track_and_decide.fault is None
    assert track_and_decide.capped_frames == 12


def test_of_equally_confident_ones_the_nearest_are_tracked():
    track_and_decide = TrackAndDecide(load_config(None))
    found = boxes([P] * 200, [0.5] * 200, np.random.default_rng(6))
    mapper = track_and_decide.ground_mapper
    every, _ = mapper.to_ground(found, mapper.framing_for(3840, 2160))
    points = track_and_decide.update(found, 3840, 2160, 0.0, 0.0).points
    farthest_m = np.hypot(*points.xy_m.T).max()
    assert np.count_nonzero(np.hypot(*every.xy_m.T) <= farthest_m) == len(points) == MAX_OF_A_KIND
