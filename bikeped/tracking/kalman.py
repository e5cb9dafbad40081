"""The Kalman filter of a track: constant velocity, disturbed by random accelerations. Pure.

Both axes have the same noise, so one covariance serves both: the variance of the position (m^2),
that of position with velocity (m^2/s), and that of the velocity (m^2/s^2). The acceleration is
white, so that a gap of any length, in one step or in many, gives the same prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.types import FloatArray


@dataclass(frozen=True)
class MotionNoise:
    """Standard deviations by kind (pedestrian, cyclist, vehicle).

    `measured_m`: of a detection's place, on each axis. `acceleration_mps2`: of the acceleration,
    drawn anew every nominal frame. `first_speed_mps`: of a velocity of which nothing is known: it
    is what keeps the first steps of a track, in which a wrong match weighs most, from being
    believed.
    """

    measured_m: tuple[float, float, float] = (0.10, 0.12, 0.12)
    acceleration_mps2: tuple[float, float, float] = (2.5, 5.0, 5.0)
    first_speed_mps: tuple[float, float, float] = (2.0, 6.0, 6.0)

    def noise(self, frame_s: float) -> FloatArray:
        """[kinds, 2]: variance of a detection's place, m^2, and what a second of acceleration adds
        to the variance of the velocity, m^2/s^3."""
        acceleration = np.square(self.acceleration_mps2) * frame_s
        return np.stack([np.square(self.measured_m), acceleration], axis=1)

    def first_covariance(self) -> FloatArray:
        """[kinds, 3]: the covariance after a first detection."""
        measured = np.square(self.measured_m)
        return np.stack([measured, 0 * measured, np.square(self.first_speed_mps)], axis=1)


def predict_covariance(
    covariance: FloatArray, elapsed_s: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The three parts [n] of `covariance` [n, 3] after `elapsed_s` [n] without a detection.

    `noise` [n, 2] is that of `MotionNoise.noise`, for the kind of each track.
    """
    place, mixed, speed = covariance[:, 0], covariance[:, 1], covariance[:, 2]
    added = noise[:, 1] * elapsed_s
    place = place + elapsed_s * (2 * mixed + elapsed_s * (speed + added / 3))
    mixed = mixed + elapsed_s * (speed + added / 2)
    return place, mixed, speed + added


def correct(
    xy_m: FloatArray,
    velocity_mps: FloatArray,
    covariance: FloatArray,
    measured_m: FloatArray,
    elapsed_s: FloatArray,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, velocity [n, 2] and covariance [n, 3] after detections at `measured_m` [n, 2].

    `xy_m` is the position predicted for now; `covariance` that of `elapsed_s` [n] ago, after the
    last detection; `noise` as in `predict_covariance`.
    """
    place, mixed, speed = predict_covariance(covariance, elapsed_s, noise)
    total = place + noise[:, 0]
    gain, speed_gain = place / total, mixed / total
    after = np.empty_like(covariance)
    after[:, 0] = gain * noise[:, 0]
    after[:, 1] = speed_gain * noise[:, 0]
    after[:, 2] = speed - speed_gain * mixed
    missed = measured_m - xy_m
    return xy_m + gain[:, None] * missed, velocity_mps + speed_gain[:, None] * missed, after
