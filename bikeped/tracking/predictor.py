"""Kinematic prediction over the latency (paper, equation 6 and the second-order variant)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bikeped.types import FloatArray


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
