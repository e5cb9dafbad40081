"""Corners that cannot be where they were said to be, and pictures that are no help.

Found once, with the most flexible lens, so that every model is judged on the same corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.lab.calibration.solver.bundle_adjustment import Adjusted
from bikeped.lab.calibration.solver.lens_model import Sightings
from bikeped.types import BoolArray

#: A corner is wrong beyond this many standard deviations, and beyond GROSS_PX. Plain noise of two
#: coordinates reaches seven once in 10^10.
GROSS_SIGMAS, GROSS_PX = 7.0, 1.0
#: Nor is a corner wrong within this share of its picture's squares: so far boards bend.
_BENDS_SHARE = 0.04
#: A picture with fewer good corners, or a smaller share of them, is not used.
FEWEST_CORNERS, LEAST_SHARE = 8, 0.5


@dataclass(frozen=True)
class LeftOut:
    """One corner that is not used: how far from where it must be."""

    name: str
    corner: int
    off_px: float


def wrong_corners(fitted: Adjusted, sightings: Sightings) -> BoolArray:
    """[V, C] which corners are off by more than noise explains."""
    distance = np.hypot(fitted.residuals_px[..., 0], fitted.residuals_px[..., 1])
    bends = _BENDS_SHARE * sightings.square_px[:, None]
    far = np.maximum(bends, max(GROSS_SIGMAS * fitted.sigma_px, GROSS_PX))
    return np.asarray(sightings.seen & (distance > far))


def useless_pictures(sightings: Sightings, wrong: BoolArray) -> BoolArray:
    """[V] which pictures keep too few corners."""
    good = (sightings.seen & ~wrong).sum(1)
    return np.asarray((good < FEWEST_CORNERS) | (good < LEAST_SHARE * sightings.seen.sum(1)))


def named(fitted: Adjusted, sightings: Sightings, wrong: BoolArray) -> list[LeftOut]:
    """Each wrong corner, for people."""
    distance = np.hypot(fitted.residuals_px[..., 0], fitted.residuals_px[..., 1])
    return [
        LeftOut(sightings.names[view], int(corner), float(distance[view, corner]))
        for view, corner in np.argwhere(wrong)
    ]
