"""The device's tracker (a batch of one scene, with history and windowed velocity) and predictor."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.types import BoolArray, FloatArray, GroundPoints, Tracks

_EPSILON_S = 1e-6


class Tracker:
    """`update(points, time_s)` once a frame gives the tracks.

    The velocity reported is the displacement over `speed_window_s` (paper: positions 4 frames apart
    over the elapsed time), of a younger track over that window all the same, for its first step may
    be a wrong match; the filter's velocity, which coasting, prediction and rules use, is that of
    `batch`.
    """

    def __init__(
        self, settings: TrackerSettings, speed_window_s: float = 4 / 30, history_length: int = 30
    ) -> None:
        self.batch = BatchTracker(settings)
        self._speed_window_s = speed_window_s
        self._paths: dict[int, deque[tuple[float, float, float]]] = {}
        self._history_length = history_length

    def update(self, points: GroundPoints, time_s: float) -> Tracks:
        """Tracks at `time_s` (seconds), updated with that frame's ground points."""
        batch = self.batch
        ridden = None if points.ridden is None else points.ridden[None]
        confidence = None if points.confidence is None else points.confidence[None]
        batch.update(time_s, points.xy_m[None], points.kind[None], ridden, confidence)
        slot = batch.reported[0].nonzero()[0]
        slot = slot[batch.id[0][slot].argsort(kind="stable")]
        ids = batch.id[0][slot]
        xy = batch.xy_m[0][slot]
        velocity = self._window_velocity(ids.tolist(), xy, time_s)
        matched = batch.detection[0][slot]
        # Index -1 reads the last detection; the extra -1 at the end makes that "none".
        detection = np.append(points.detection, -1)[matched]
        self._slot = slot
        return Tracks(
            time_s=time_s,
            id=ids,
            kind=batch.kind[0][slot],
            xy_m=xy,
            velocity_mps=velocity,
            unseen_s=np.maximum(time_s - batch.seen_s[0][slot], 0.0),
            detection=detection,
        )

    def smoothed(self) -> tuple[FloatArray, FloatArray]:
        """Smoothed velocity (m/s) and acceleration (m/s^2) [n, 2] of the last update's tracks."""
        slot = self._slot
        return self.batch.velocity_mps[0][slot], self.batch.acceleration_mps2[0][slot]

    def parked(self) -> BoolArray:
        """Which of the last update's tracks [n] are cycles that stand without a person."""
        return np.asarray(self.batch.parked[0][self._slot])

    def history(self) -> Mapping[int, list[list[float]]]:
        """Positions [x, y] (m) of every present track by id, oldest first."""
        return {key: [[x, y] for _, x, y in path] for key, path in self._paths.items()}

    def _window_velocity(self, ids: list[int], xy: FloatArray, time_s: float) -> FloatArray:
        known = self._paths
        self._paths = {}
        past = []
        target = time_s - self._speed_window_s + _EPSILON_S
        for key, (x, y) in zip(ids, xy.tolist(), strict=True):
            path = known.get(key) or deque(maxlen=self._history_length)
            then = now = (time_s, x, y)
            for then in reversed(path):
                if then[0] <= target:
                    break
            past.append(then)
            path.append(now)
            self._paths[key] = path
        before = np.asarray(past, np.float64).reshape(-1, 3)
        elapsed_s = np.maximum(time_s - before[:, :1], self._speed_window_s)
        return np.asarray((xy - before[:, 1:]) / elapsed_s)


def predict(
    xy_m: FloatArray,
    velocity_mps: FloatArray,
    acceleration_mps2: FloatArray | None,
    horizon_s: npt.ArrayLike,
    order: int = 1,
) -> FloatArray:
    """Positions [..., 2] after `horizon_s` seconds (a number, or an array that broadcasts).

    `order` 0 leaves them, 1 adds velocity * horizon, 2 also acceleration * horizon^2 / 2. The paper
    finds second order worse: the quadratic term amplifies the noise of the acceleration.
    """
    if order not in (0, 1, 2):
        raise ValueError(f"order: expected 0, 1 or 2, got {order}")
    if order == 0:
        return xy_m
    horizon = np.asarray(horizon_s, dtype=np.float64)
    predicted = xy_m + velocity_mps * horizon
    if order == 2 and acceleration_mps2 is not None:
        predicted = predicted + 0.5 * acceleration_mps2 * horizon * horizon
    return np.asarray(predicted)
