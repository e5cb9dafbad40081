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
_SAMPLES = 2048


class _Formula(NamedTuple):
    """A projection for f = 1 without radial terms, angles in radians."""

    limit_rad: float  #: the angle from the axis at which it ends
    radius: Callable[[FloatArray], FloatArray]  #: g(theta), the image radius
    slope: Callable[[FloatArray], FloatArray]  #: dg/dtheta
    theta: Callable[[FloatArray], FloatArray]  #: of a radius; beyond the range, its limit


PROJECTIONS: dict[str, _Formula] = {
    "equidistant": _Formula(math.pi, lambda t: t, np.ones_like, lambda r: r),
    "equisolid": _Formula(
        math.pi,
        lambda t: 2 * np.sin(t / 2),
        lambda t: np.cos(t / 2),
        lambda r: 2 * np.arcsin(np.minimum(r / 2, 1.0)),
    ),
    "stereographic": _Formula(
        math.radians(179.0),  # less than 180 degrees, where r is infinite
        lambda t: 2 * np.tan(t / 2),
        lambda t: 1 / np.cos(t / 2) ** 2,
        lambda r: 2 * np.arctan(r / 2),
    ),
    "orthographic": _Formula(math.pi / 2, np.sin, np.cos, lambda r: np.arcsin(np.minimum(r, 1.0))),
    "perspective": _Formula(math.radians(89.5), np.tan, lambda t: 1 / np.cos(t) ** 2, np.arctan),
}


def canonical_projection(name: str) -> Projection:
    """The canonical name of a projection; also accepts `linear` and `equalarea`.

    Raises GeometryError for an unknown name.
    """
    proper = _ALIASES.get(name, name)
    if proper not in PROJECTIONS:
        raise GeometryError(
            f"projection: unknown model {name!r}; use one of {', '.join(sorted(PROJECTIONS))}"
        )
    return cast(Projection, proper)


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
        limit = PROJECTIONS[self.projection].limit_rad
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
        formula = PROJECTIONS[proper]
        unit = float(formula.radius(np.asarray(min(half, formula.limit_rad))))
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
        base = PROJECTIONS[self.projection].radius(angle)
        if any(self.k):
            base = base * self._gain(angle)
        return self.focal_px * base

    def theta(self, radius_px: npt.ArrayLike) -> FloatArray:
        """Angles in radians at image radii `radius_px` (any shape); NaN outside the image circle.

        Closed form without radial terms, else Newton's method from a table, to 1e-12 of the radius.
        """
        radius = np.asarray(radius_px, dtype=np.float64)
        inside = radius <= self.max_radius_px * (1 + 1e-12)
        unit, formula = radius / self.focal_px, PROJECTIONS[self.projection]
        if not any(self.k):
            angle = formula.theta(unit)
        else:
            angle = np.interp(radius, self._radius_table, self._theta_table)
            for _ in range(4):  # quadratic from 1e-3 at worst: four steps reach the last bit
                gain, gain_slope = self._gain(angle), self._gain_slope(angle)
                base = formula.radius(angle)
                slope = formula.slope(angle) * gain + base * gain_slope
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
