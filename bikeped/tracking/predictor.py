"""Kinematic prediction over the latency (paper, equation 6 and the second-order variant)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bikeped.types import FloatArray


def predict(
    xy_m: FloatArray,
    velocity_mps: FloatArray,
    acceleration_mps2: FloatArray | None,
    ahead_s: npt.ArrayLike,
    order: int = 1,
) -> FloatArray:
    """Positions [..., 2] after `ahead_s` seconds (a number, or an array that broadcasts).

    `order` 0 leaves them, 1 adds the velocity, 2 also half the acceleration times the square. The
    paper finds second order worse: the quadratic term amplifies the noise of the acceleration.
    """
    if order not in (0, 1, 2):
        raise ValueError(f"order: expected 0, 1 or 2, got {order}")
    if order == 0:
        return xy_m
    ahead = np.asarray(ahead_s, dtype=np.float64)
    moved = xy_m + velocity_mps * ahead
    if order == 2 and acceleration_mps2 is not None:
        moved = moved + 0.5 * acceleration_mps2 * ahead * ahead
    return np.asarray(moved)
