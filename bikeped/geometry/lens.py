"""Radial lens models: image radius as a function of the angle from the optical axis.

The four fisheye projections of Kannala and Brandt (2006) and the perspective projection, each with
up to four radial terms:

    r(theta) = f * g(theta) * (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

which for the equidistant lens is the paper's r = f (theta + k1 theta^3 + k2 theta^5 ...).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from bikeped.errors import GeometryError
from bikeped.types import FloatArray

Projection = Literal["equidistant", "equisolid", "stereographic", "orthographic", "perspective"]

_ALIASES = {"linear": "equidistant", "equalarea": "equisolid"}
#: The angle from the axis at which each projection ends, radians.
LIMITS: dict[str, float] = {
    "equidistant": math.pi,
    "equisolid": math.pi,
    # Less than 180 degrees, where r is infinite.
    "stereographic": math.radians(179.0),
    "orthographic": math.pi / 2,
    "perspective": math.radians(89.5),
}
_SAMPLES = 2048


class _Functions(NamedTuple):
    """g(theta) for f = 1 without radial terms, its derivative, and its inverse."""

    radius: Callable[[FloatArray], FloatArray]
    slope: Callable[[FloatArray], FloatArray]
    angle: Callable[[FloatArray], FloatArray]


_FUNCTIONS = {
    "equidistant": _Functions(lambda t: t, np.ones_like, lambda r: r),
    "equisolid": _Functions(
        lambda t: 2 * np.sin(t / 2),
        lambda t: np.cos(t / 2),
        lambda r: 2 * np.arcsin(np.minimum(r / 2, 1.0)),
    ),
    "stereographic": _Functions(
        lambda t: 2 * np.tan(t / 2),
        lambda t: 1 / np.cos(t / 2) ** 2,
        lambda r: 2 * np.arctan(r / 2),
    ),
    "orthographic": _Functions(np.sin, np.cos, lambda r: np.arcsin(np.minimum(r, 1.0))),
    "perspective": _Functions(np.tan, lambda t: 1 / np.cos(t) ** 2, np.arctan),
}


def canonical_projection(name: str) -> Projection:
    """The canonical name of a projection; also accepts `linear` and `equalarea`.

    Raises GeometryError for an unknown name.
    """
    proper = _ALIASES.get(name, name)
    if proper not in LIMITS:
        raise GeometryError(
            f"projection: unknown model {name!r}; use one of {', '.join(sorted(LIMITS))}"
        )
    return cast(Projection, proper)


def unit_radius(projection: str, theta: FloatArray) -> FloatArray:
    """g(theta): image radius at angle `theta` (rad) for f = 1 without radial terms."""
    return np.asarray(_FUNCTIONS[projection].radius(theta))


def unit_radius_slope(projection: str, theta: FloatArray) -> FloatArray:
    """dg/dtheta."""
    return np.asarray(_FUNCTIONS[projection].slope(theta))


def unit_angle(projection: str, radius: FloatArray) -> FloatArray:
    """theta (rad) for f = 1 without radial terms; beyond the projection's range, its limit."""
    return np.asarray(_FUNCTIONS[projection].angle(radius))


@dataclass(frozen=True)
class Lens:
    """A lens: projection, focal length in pixels, radial terms k1..k4, half the field of view.

    Beyond `max_theta_rad` a radius is outside the image circle and `theta` is NaN. Raises
    GeometryError when the radius does not increase with the angle up to there: a pixel would have
    two directions.
    """

    projection: Projection
    focal_px: float
    max_theta_rad: float
    k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    _theta_table: FloatArray = field(init=False, repr=False, compare=False)
    _radius_table: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.focal_px) and self.focal_px > 0):
            raise GeometryError(
                f"focal length: {self.focal_px} px is not a positive number; check radius_px, "
                "fov_deg and the calibration's focal_length"
            )
        limit = LIMITS[self.projection]
        if not 0 < self.max_theta_rad <= limit + 1e-9:
            raise GeometryError(
                f"fov_deg: {math.degrees(2 * self.max_theta_rad):.1f} is outside what a "
                f"{self.projection} lens can show (0 to {math.degrees(2 * limit):.0f})"
            )
        theta = np.linspace(0, min(self.max_theta_rad, limit), _SAMPLES)
        radius = self.radius(theta)
        if not np.all(np.diff(radius) > 0):
            bad = math.degrees(theta[int(np.argmin(np.diff(radius) > 0))])
            raise GeometryError(
                f"k1..k4: the image radius stops growing at {bad:.1f} degrees from the axis, "
                "inside the field of view; lower fov_deg or correct the radial terms"
            )
        object.__setattr__(self, "_theta_table", theta)
        object.__setattr__(self, "_radius_table", radius)

    @staticmethod
    def from_circle(
        projection: str,
        radius_px: float,
        fov_deg: float,
        k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    ) -> Lens:
        """The lens whose field of view `fov_deg` ends at `radius_px`: f = R / g(fov / 2).

        `radius_px` is without the radial terms, as in the calibration file.
        """
        proper = canonical_projection(projection)
        half = math.radians(fov_deg) / 2
        unit = float(
            unit_radius(proper, np.asarray([min(half, LIMITS[proper])], dtype=np.float64))[0]
        )
        if unit <= 0:
            raise GeometryError(f"fov_deg: {fov_deg} gives no focal length; use a positive angle")
        return Lens(proper, radius_px / unit, half, k)

    @property
    def max_radius_px(self) -> float:
        """Radius of the image circle, radial terms included."""
        return float(self._radius_table[-1])

    def radius(self, theta: npt.ArrayLike) -> FloatArray:
        """Image radius in pixels at angles `theta` (radians, any shape)."""
        angle = np.asarray(theta, dtype=np.float64)
        base = unit_radius(self.projection, angle)
        if any(self.k):
            base = base * self._gain(angle)
        return self.focal_px * base

    def theta(self, radius_px: npt.ArrayLike) -> FloatArray:
        """Angles in radians at image radii `radius_px` (any shape); NaN outside the image circle.

        Closed form without radial terms, else Newton's method from a table, to 1e-12 of the radius.
        """
        radius = np.asarray(radius_px, dtype=np.float64)
        inside = radius <= self.max_radius_px * (1 + 1e-12)
        unit = radius / self.focal_px
        if not any(self.k):
            angle = unit_angle(self.projection, unit)
        else:
            angle = np.interp(radius, self._radius_table, self._theta_table)
            for _ in range(4):  # quadratic from 1e-3 at worst: four steps reach the last bit
                gain, gain_slope = self._gain(angle), self._gain_slope(angle)
                base = unit_radius(self.projection, angle)
                slope = unit_radius_slope(self.projection, angle) * gain + base * gain_slope
                with np.errstate(divide="ignore", invalid="ignore"):
                    step = np.where(slope > 1e-9, (base * gain - unit) / slope, 0.0)
                angle = np.clip(angle - step, 0, self.max_theta_rad)
        return np.where(inside, angle, np.nan)

    def _gain(self, theta: FloatArray) -> FloatArray:
        k1, k2, k3, k4 = self.k
        sq = theta * theta
        return 1 + sq * (k1 + sq * (k2 + sq * (k3 + sq * k4)))

    def _gain_slope(self, theta: FloatArray) -> FloatArray:
        k1, k2, k3, k4 = self.k
        sq = theta * theta
        return theta * (2 * k1 + sq * (4 * k2 + sq * (6 * k3 + sq * 8 * k4)))
