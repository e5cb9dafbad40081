"""The pole's tracker: one lane, with position history and windowed velocity."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.types import FloatArray, GroundPoints, Tracks

_EPSILON_S = 1e-6


class Tracker:
    """`update(points, time_s)` once a frame gives the tracks.

    The velocity reported is the displacement over `speed_window_s` (the paper: positions 4 frames
    apart over the elapsed time), or over the track's life while it is shorter; the smoothed
    velocity that coasting and prediction use is in `lanes`.
    """

    def __init__(
        self,
        settings: TrackerSettings,
        speed_window_s: float = 4 / 30,
        history_length: int = 30,
    ) -> None:
        self.lanes = BatchTracker(settings)
        self._speed_window_s = speed_window_s
        self._paths: dict[int, deque[tuple[float, float, float]]] = {}
        self._history_length = history_length

    def update(self, points: GroundPoints, time_s: float) -> Tracks:
        """Tracks at `time_s` seconds after the detections `points` of that moment."""
        lanes = self.lanes
        lanes.update(time_s, points.xy_m[None], points.kind[None])
        slot = lanes.reported[0].nonzero()[0]
        slot = slot[lanes.id[0][slot].argsort(kind="stable")]
        ids = lanes.id[0][slot]
        xy = lanes.xy_m[0][slot]
        velocity = self._remember(ids.tolist(), xy, time_s)
        matched = lanes.detection[0][slot]
        # Index -1 reads the last detection; the extra -1 at the end makes that "none".
        detection = np.append(points.detection, -1)[matched]
        self._slot = slot
        return Tracks(
            time_s=time_s,
            id=ids,
            kind=lanes.kind[0][slot],
            xy_m=xy,
            velocity_mps=velocity,
            unseen_s=np.maximum(time_s - lanes.seen_s[0][slot], 0.0),
            detection=detection,
        )

    def smoothed(self) -> tuple[FloatArray, FloatArray]:
        """Smoothed velocity and acceleration [n, 2] of the tracks of the last update."""
        slot = self._slot
        return self.lanes.velocity_mps[0][slot], self.lanes.acceleration_mps2[0][slot]

    def history(self) -> Mapping[int, list[list[float]]]:
        """Positions [x, y] of every present track, oldest first."""
        return {key: [[x, y] for _, x, y in path] for key, path in self._paths.items()}

    def _remember(self, ids: list[int], xy: FloatArray, time_s: float) -> FloatArray:
        known = self._paths
        self._paths = {}
        velocity = []
        target = time_s - self._speed_window_s + _EPSILON_S
        for key, (x, y) in zip(ids, xy.tolist(), strict=True):
            path = known.get(key)
            if path is None:
                path = deque(maxlen=self._history_length)
            then, px, py = time_s, x, y
            for then, px, py in reversed(path):  # noqa: B007  the last one looked at is used below
                if then <= target:
                    break
            elapsed = time_s - then
            velocity.append(((x - px) / elapsed, (y - py) / elapsed) if elapsed > 0 else (0.0, 0.0))
            path.append((time_s, x, y))
            self._paths[key] = path
        return np.asarray(velocity, np.float64).reshape(-1, 2)
