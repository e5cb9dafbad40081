"""Whom the decision counts: people seen a moment ago, no parked cycles, no riders twice."""

import numpy as np
import pytest

from bikeped.config.load import load_config
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.types import GroundPoints, Kind, State

P, C = int(Kind.PEDESTRIAN), int(Kind.CYCLIST)


def decisions(scene, seconds, overrides=()):
    """Decisions of the deployed code; `scene(t)` lists (kind, x, y[, ridden]) in camera metres."""
    track_and_decide = TrackAndDecide(load_config(None, list(overrides)))
    found = []
    for frame in range(round(seconds * 30)):
        here = scene(frame / 30)
        xy = np.array([h[1:3] for h in here], np.float64).reshape(-1, 2)
        kind = np.array([h[0] for h in here], np.int8)
        ridden = np.array([len(h) > 3 for h in here], bool)
        points = GroundPoints(kind, xy, np.arange(len(here)), ridden)
        found.append(track_and_decide.update_from_points(points, frame / 30))
    return found


def lost(seed, kind):
    """A cyclist and a pedestrian who come together; one of them is lost at 1 s."""
    rng = np.random.default_rng(seed)
    speed = rng.uniform(3, 8)
    walk = rng.uniform(-1.5, 1.5)
    start = rng.uniform(10, 20)
    noise = rng.normal(0, 0.05, (400, 2, 2))

    def scene(t):
        jitter = noise[round(t * 30)]
        both = [
            (C, start - speed * t + jitter[0, 0], 1 + jitter[0, 1]),
            (P, 4 + jitter[1, 0], walk * (t - 1) + jitter[1, 1]),
        ]
        return [one for one in both if t < 1 or one[0] != kind]

    return scene


@pytest.mark.parametrize("kind", [C, P])
def test_no_alert_comes_from_a_track_unseen_for_over_a_second(kind):
    alerts = 0
    for seed in range(200):
        for result in decisions(lost(seed, kind), 3.5):
            decision, tracks = result.decision, result.tracks
            if decision.raw is not State.ALERT:
                continue
            alerts += 1
            pair = [decision.pair.cyclist_id, decision.pair.pedestrian_id]
            assert (tracks.unseen_s[np.isin(tracks.id, pair)] <= 1 + 1e-6).all()
    assert alerts > 500


def test_a_lost_pedestrian_and_cyclist_are_gone_after_a_second():
    states = [r.decision.state for r in decisions(lost(3, P), 6)]
    assert set(states[round(2.2 * 30) + 45 :]) == {State.IDLE}


def test_a_rider_with_a_person_box_of_his_own_never_alerts():
    for seed in range(150):
        rng = np.random.default_rng(seed)
        speed, side = rng.uniform(2, 8), rng.uniform(2, 12)
        noise = rng.normal(0, 0.12, (200, 2, 2))
        misses = rng.random((200, 2)) < 0.25

        def scene(t, speed=speed, side=side, noise=noise, misses=misses):
            i = round(t * 30)
            x = 12 - speed * t
            both = [
                (C, x + noise[i, 0, 0], side + noise[i, 0, 1]),
                (P, x + 0.3 + noise[i, 1, 0], side + 0.2 + noise[i, 1, 1]),
            ]
            return [one for one, missed in zip(both, misses[i], strict=True) if not missed]

        assert State.ALERT not in {r.decision.state for r in decisions(scene, 3.5)}, seed


def test_a_parked_bicycle_leaves_the_light_green_after_ten_seconds():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.05, (900, 2))

    def scene(t):
        return [(C, 8.0 + noise[round(t * 30), 0], 3.0), (P, 6.0, -4 + 1.2 * (t % 8))]

    states = [r.decision.state for r in decisions(scene, 20)]
    assert set(states[round(12.2 * 30) :]) == {State.SAFE}
    assert State.SAFE not in set(states[5 : 9 * 30])


@pytest.mark.parametrize("rider", ["beside", "joined"])
def test_a_rider_who_waits_at_a_signal_is_not_parked(rider):
    def scene(t):
        cycle = (C, 8.0, 3.0, "ridden") if rider == "joined" else (C, 8.0, 3.0)
        rest = [(P, 8.2, 3.2)] if rider == "beside" and round(t * 30) % 4 else []
        return [cycle, *rest, (P, 6.0, -4.0)]

    states = [r.decision.state for r in decisions(scene, 20)]
    assert set(states[5:]) == {State.WARNING}


def test_a_parked_bicycle_counts_again_once_it_moves():
    def scene(t):
        return [(C, 8.0 - 4 * max(t - 14, 0), 3.0), (P, -6.0, 3.0)]

    states = [r.decision.state for r in decisions(scene, 16)]
    assert states[round(13.9 * 30)] is State.SAFE
    assert states[round(14.5 * 30)] in (State.WARNING, State.ALERT)


def test_a_walker_whom_a_cyclist_overtakes_within_a_metre_is_warned():
    def scene(t):
        return [(C, 22 - 5 * t, 0.9), (P, 6 - 1.2 * t, 0.0)]

    states = [r.decision.state for r in decisions(scene, 3)]
    assert State.ALERT in states
    assert states.index(State.ALERT) < 30
