"""People in front of the deployed tracker and decision: who is lost, who rides, what is parked."""

import numpy as np

from bikeped.config.load import load_config
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.types import GroundPoints, Kind

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


def rider_with_a_person_box(seed):
    """A rider whom the detector boxes twice, as cyclist and as person, with noise and misses."""
    rng = np.random.default_rng(seed)
    speed, side = rng.uniform(2, 8), rng.uniform(2, 12)
    noise = rng.normal(0, 0.12, (200, 2, 2))
    misses = rng.random((200, 2)) < 0.25

    def scene(t):
        i = round(t * 30)
        x = 12 - speed * t
        both = [
            (C, x + noise[i, 0, 0], side + noise[i, 0, 1]),
            (P, x + 0.3 + noise[i, 1, 0], side + 0.2 + noise[i, 1, 1]),
        ]
        return [one for one, missed in zip(both, misses[i], strict=True) if not missed]

    return scene


def parked(t):
    """A bicycle that stands, and a pedestrian who walks by again and again."""
    return [(C, 8.0 + 0.05 * np.sin(97 * t), 3.0), (P, 6.0, -4 + 1.2 * (t % 8))]
