"""The field of view: the image circle in the images, and how far the fitted lens may be used."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from bikeped.geometry.lens import LIMITS
from bikeped.lab.calibration.solver.lens_fit import LensFit
from bikeped.types import FloatArray, ImageArray

#: The rim is searched along so many directions.
_SECTORS = 180
#: Dark is below this share of the 90th percentile of the grey levels.
_DARK_SHARE = 0.5
#: The rim must be visible in so many directions, and dark outside it for so many pixels.
_FEWEST_SECTORS = 12
_DARK_PX = 4
#: The field of view ends where a pixel spans this many times the angle that it spans in the middle.
_LEAST_SLOPE = 0.1
#: ... or where the radius, extrapolated beyond the corners, is known no better than this share.
_MOST_SIGMA_SHARE = 1 / 300
ENDS_SLOW = "the angle where the fitted radius stops growing"
ENDS_VAGUE = "the angle where the boards no longer say what the radius is"
_SAMPLES = 4000


@dataclass(frozen=True)
class FieldOfView:
    """Half the field of view, and what limits it."""

    half_rad: float
    circle_px: float  #: radius of the image circle, radial terms included
    ends_at: str  #: the image circle, the image's corner, or the model

    @property
    def fov_deg(self) -> float:
        return math.degrees(2 * self.half_rad)


def field_of_view(
    fit: LensFit, circle_px: float | None, window_px: tuple[float, float, float, float]
) -> FieldOfView:
    """How far the fitted lens may be used.

    Out to the image circle where the images show it (`circle_px`), else to the farthest pixel of
    `window_px` (u0, v0, u1, v1), but never to where the model's radius hardly grows any more, nor
    to where the radius, extrapolated beyond the boards, is too uncertain.
    """
    u0, v0, u1, v1 = window_px
    far = math.hypot(max(fit.cx - u0, u1 - fit.cx), max(fit.cy - v0, v1 - fit.cy))
    radius, ends_at = far, "the corner of the picture"
    if circle_px is not None and circle_px < far:
        radius, ends_at = circle_px, "the image circle"
    limit = LIMITS[fit.model.projection]
    theta: FloatArray = np.linspace(0.0, limit, _SAMPLES, dtype=np.float64)
    grown = fit.state.radius_px(theta)
    slow = np.diff(grown, append=np.inf) < _LEAST_SLOPE * fit.focal_px * theta[1]
    vague = fit.radius_sigma_px(theta) > _MOST_SIGMA_SHARE * grown
    vague &= theta > fit.measured_to_rad
    ends = np.flatnonzero(slow | vague)
    reach = int(ends[0]) if len(ends) else _SAMPLES - 1
    if grown[reach] <= radius:
        ends_at = ENDS_VAGUE if vague[reach] else ENDS_SLOW
        radius, half = float(grown[reach]), float(theta[reach])
    else:
        half = float(np.interp(radius, grown[: reach + 1], theta[: reach + 1]))
    return FieldOfView(half, radius, ends_at)


def brightest_pixels(greys: Iterable[ImageArray]) -> ImageArray:
    """[h, w] each pixel's brightest value over the images: dark only outside the image circle."""
    return functools.reduce(np.maximum, greys)


def circle_radius_px(bright: ImageArray, centre_px: FloatArray) -> float | None:
    """Radius of the image circle about `centre_px`; None where the images do not show its rim.

    Each direction is followed outwards to where it stays dark. Directions in which the image ends
    first do not count. The rim is the upper quartile of the others, because a dark object at the
    rim ends some directions early.
    """
    height, width = bright.shape
    level = float(np.percentile(bright, 90)) * _DARK_SHARE
    reach = int(np.hypot(width, height))
    step = np.arange(reach)
    rims = []
    for angle in np.arange(_SECTORS) * 2 * np.pi / _SECTORS:
        u = np.rint(centre_px[0] + step * np.cos(angle)).astype(np.int64)
        v = np.rint(centre_px[1] + step * np.sin(angle)).astype(np.int64)
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        lit = bright[v[inside], u[inside]] > level
        if not lit.any():
            continue
        last = int(np.flatnonzero(lit)[-1])
        if last + _DARK_PX < int(inside.sum()):
            rims.append(last + 0.5)
    if len(rims) < _FEWEST_SECTORS:
        return None
    return float(np.percentile(rims, 75))
