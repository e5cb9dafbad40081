"""A fisheye camera above flat ground: ground to pixel and pixel to ground.

Equations 1 to 5 of the paper. Camera axes and ground axes are both x forward, y right, z up; the
camera ground frame has its origin on the ground below the lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from bikeped.errors import GeometryError
from bikeped.geometry.lens import Lens
from bikeped.types import BoolArray, FloatArray

#: A point must lie this far in front of the lens plane to count as seen (definitions, section 1).
FRONT_MIN_M = 0.01


@dataclass(frozen=True)
class GroundCamera:
    """Lens, optical centre (`cx`, `cy`, crop pixels), height and direction of one camera.

    `pitch_deg`: 0 level, negative looks down. `heading_deg`: the optical axis points this far to
    the right of the ground frame's x axis. `window_px` is the part of the crop that exists on the
    sensor as u0, v0, u1, v1 (end exclusive); None: all of it.
    """

    lens: Lens
    cx: float
    cy: float
    height_m: float
    pitch_deg: float = 0.0
    heading_deg: float = 0.0
    window_px: tuple[float, float, float, float] | None = None
    _to_ground: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.height_m) and self.height_m > 0):
            raise GeometryError(f"height_m: {self.height_m} is not above the ground")
        pitch, heading = math.radians(self.pitch_deg), math.radians(self.heading_deg)
        ca, sa = math.cos(pitch), math.sin(pitch)
        ch, sh = math.cos(heading), math.sin(heading)
        tilt = np.array([[ca, 0, -sa], [0, 1, 0], [sa, 0, ca]])  # equation 3 (pitch)
        turn = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
        object.__setattr__(self, "_to_ground", turn @ tilt)

    def rays(self, uv_px: npt.ArrayLike) -> FloatArray:
        """Unit rays [..., 3] in ground axes of crop pixels [..., 2]; NaN outside the circle."""
        uv = np.asarray(uv_px, dtype=np.float64)
        du, dv = uv[..., 0] - self.cx, uv[..., 1] - self.cy
        radius = np.hypot(du, dv)
        theta = self.lens.theta(radius)
        # sin(theta)/r instead of sin and cos of the azimuth: one division, exact along the axes.
        scale = np.sin(theta) / np.where(radius > 0, radius, 1.0)
        ray = np.stack([np.cos(theta), scale * du, -scale * dv], axis=-1)
        return ray @ self._to_ground.T

    def ground(self, uv_px: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Ground positions [n, 2] in metres of crop pixels [n, 2], and which are valid [n].

        A pixel is invalid (NaN) outside the image circle and on or above the horizon.
        """
        ray = self.rays(uv_px)
        down = ray[..., 2] < -1e-12  # NaN compares false
        reach = np.where(down, -self.height_m / np.where(down, ray[..., 2], 1.0), np.nan)
        return ray[..., :2] * reach[..., None], down

    def project(self, xyz_m: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Crop pixels [n, 2] of points [n, 3] (or [n, 2], on the ground) in metres, and which are
        visible [n]: within the field of view, in front of the lens plane, and on the sensor.

        Other points have the pixel of the lens model where it has one.
        """
        point = np.asarray(xyz_m, dtype=np.float64)
        if point.shape[-1] == 2:
            point = np.concatenate([point, np.zeros((*point.shape[:-1], 1))], axis=-1)
        ray = (point - np.array([0.0, 0.0, self.height_m])) @ self._to_ground
        side = np.hypot(ray[..., 1], ray[..., 2])
        theta = np.arctan2(side, ray[..., 0])
        in_view = theta < self.lens.max_theta_rad
        radius = self.lens.radius(np.minimum(theta, self.lens.max_theta_rad))
        scale = radius / np.where(side > 0, side, 1.0)
        uv = np.stack([self.cx + scale * ray[..., 1], self.cy - scale * ray[..., 2]], axis=-1)
        seen = in_view & (ray[..., 0] > FRONT_MIN_M)
        if self.window_px is not None:
            u0, v0, u1, v1 = self.window_px
            seen &= (uv[..., 0] >= u0) & (uv[..., 0] < u1) & (uv[..., 1] >= v0) & (uv[..., 1] < v1)
        return uv, seen


@dataclass(frozen=True)
class CameraPose:
    """Position (x east, y north, metres) and heading of a camera in the world.

    `heading_deg` is counted from east, counter-clockwise: 90 looks north (+y).
    """

    x_m: float
    y_m: float
    heading_deg: float

    def world_to_ground(self, xy_m: npt.ArrayLike) -> FloatArray:
        """World positions [..., 2] in the camera ground frame (x forward, y right)."""
        delta = np.asarray(xy_m, dtype=np.float64) - np.array([self.x_m, self.y_m])
        return np.asarray(delta @ self._axes().T)

    def turn_to_ground(self, direction: npt.ArrayLike) -> FloatArray:
        """World directions [..., 2] in the camera ground frame."""
        return np.asarray(np.asarray(direction, dtype=np.float64) @ self._axes().T)

    def ground_to_world(self, xy_m: npt.ArrayLike) -> FloatArray:
        """Camera ground positions [..., 2] in the world."""
        turned: FloatArray = np.asarray(xy_m, dtype=np.float64) @ self._axes()
        return np.asarray(turned + np.array([self.x_m, self.y_m]))

    def _axes(self) -> FloatArray:
        c, s = math.cos(math.radians(self.heading_deg)), math.sin(math.radians(self.heading_deg))
        return np.array([[c, s], [s, -c]])
