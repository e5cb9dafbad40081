"""Radial lens models: image radius against angle from the optical axis.

The four fisheye projections of Kannala and Brandt (2006) and the ordinary perspective one, each
with up to four radial terms:

    r(theta) = f * g(theta) * (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

which for the equidistant lens is the paper's r = f (theta + k1 theta^3 + k2 theta^5 ...).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, cast

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
    # Short of the pole at infinity, so that r stays finite.
    "stereographic": math.radians(179.0),
    "orthographic": math.pi / 2,
    "perspective": math.radians(89.5),
}
_SAMPLES = 2048


def canonical_projection(name: str) -> Projection:
    """The proper name of a projection; `linear` and `equalarea` are accepted beside it.

    Raises GeometryError for a name that is none of them.
    """
    proper = _ALIASES.get(name, name)
    if proper not in LIMITS:
        raise GeometryError(
            f"projection: unknown model {name!r}; use one of {', '.join(sorted(LIMITS))}"
        )
    return cast(Projection, proper)


def curve(projection: str, theta: FloatArray) -> FloatArray:
    """g(theta), the radius for f = 1 without radial terms."""
    if projection == "equidistant":
        return theta
    if projection == "equisolid":
        return np.asarray(2 * np.sin(theta / 2))
    if projection == "stereographic":
        return np.asarray(2 * np.tan(theta / 2))
    if projection == "orthographic":
        return np.asarray(np.sin(theta))
    return np.asarray(np.tan(theta))


def curve_slope(projection: str, theta: FloatArray) -> FloatArray:
    """dg/dtheta."""
    if projection == "equidistant":
        return np.ones_like(theta)
    if projection == "equisolid":
        return np.asarray(np.cos(theta / 2))
    if projection == "stereographic":
        return np.asarray(1 / np.cos(theta / 2) ** 2)
    if projection == "orthographic":
        return np.asarray(np.cos(theta))
    return np.asarray(1 / np.cos(theta) ** 2)


def inverse_curve(projection: str, radius: FloatArray) -> FloatArray:
    """theta for f = 1 without radial terms; radii outside the model give its limit."""
    if projection == "equidistant":
        return radius
    if projection == "equisolid":
        return np.asarray(2 * np.arcsin(np.minimum(radius / 2, 1.0)))
    if projection == "stereographic":
        return np.asarray(2 * np.arctan(radius / 2))
    if projection == "orthographic":
        return np.asarray(np.arcsin(np.minimum(radius, 1.0)))
    return np.asarray(np.arctan(radius))


@dataclass(frozen=True)
class Lens:
    """One lens: projection, focal length in pixels, radial terms, and the widest angle it answers.

    `max_theta_rad` (half the field of view) bounds what `theta` answers: beyond it the radius is
    outside the image circle and the answer is NaN. Raises GeometryError when the radius does not
    grow with the angle over that range, for then a pixel would have two directions.
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
        """The lens whose field of view ends at `radius_px`: f = 2R * 180 / (fov pi), equidistant.

        The focal length is that of the plain projection; radial terms bend it afterwards, as the
        calibration file's convention has it.
        """
        proper = canonical_projection(projection)
        half = math.radians(fov_deg) / 2
        unit = float(curve(proper, np.asarray([min(half, LIMITS[proper])], dtype=np.float64))[0])
        if unit <= 0:
            raise GeometryError(f"fov_deg: {fov_deg} gives no focal length; use a positive angle")
        return Lens(proper, radius_px / unit, half, k)

    @property
    def max_radius_px(self) -> float:
        """Radius of the image circle at the edge of the field of view."""
        return float(self._radius_table[-1])

    def radius(self, theta: npt.ArrayLike) -> FloatArray:
        """Image radius in pixels at angles `theta` (radians, any shape)."""
        angle = np.asarray(theta, dtype=np.float64)
        base = curve(self.projection, angle)
        if any(self.k):
            base = base * self._gain(angle)
        return self.focal_px * base

    def theta(self, radius_px: npt.ArrayLike) -> FloatArray:
        """Angle in radians at image radii (any shape); NaN outside the image circle.

        Without radial terms in closed form; with them by Newton's method from a table, to 1e-12
        of the radius.
        """
        radius = np.asarray(radius_px, dtype=np.float64)
        inside = radius <= self.max_radius_px * (1 + 1e-12)
        unit = radius / self.focal_px
        if not any(self.k):
            angle = inverse_curve(self.projection, unit)
        else:
            angle = np.interp(radius, self._radius_table, self._theta_table)
            for _ in range(4):  # quadratic from 1e-3 at worst: four steps reach the last bit
                gain, bend = self._gain(angle), self._bend(angle)
                base = curve(self.projection, angle)
                slope = curve_slope(self.projection, angle) * gain + base * bend
                with np.errstate(divide="ignore", invalid="ignore"):
                    step = np.where(slope > 1e-9, (base * gain - unit) / slope, 0.0)
                angle = np.clip(angle - step, 0, self.max_theta_rad)
        return np.where(inside, angle, np.nan)

    def _gain(self, theta: FloatArray) -> FloatArray:
        k1, k2, k3, k4 = self.k
        sq = theta * theta
        return 1 + sq * (k1 + sq * (k2 + sq * (k3 + sq * k4)))

    def _bend(self, theta: FloatArray) -> FloatArray:
        """Derivative of the gain."""
        k1, k2, k3, k4 = self.k
        sq = theta * theta
        return theta * (2 * k1 + sq * (4 * k2 + sq * (6 * k3 + sq * 8 * k4)))
