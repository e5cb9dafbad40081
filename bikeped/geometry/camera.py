"""A fisheye camera above flat ground: ground to pixel and pixel to ground.

Equations 1 to 5 of the paper. Camera axes and ground axes are both x forward, y right, z up; the
camera ground frame has its origin on the ground below the lens.

`GroundTable` holds precomputed rays. Ground positions grow without bound toward the horizon and
interpolate badly; ray directions do not. Unit rays on a coarse lattice (8 px: 2.3 MB for a 3500 px
crop) are interpolated bilinearly over 8 px, which changes a ray by some 1e-5 rad, about a
millimetre at 25 m; the intersection with the ground is one division at look-up. Cells where the
lens bends faster (the rim of an orthographic lens, a tiny image) are found while building, by
comparing the middle of each cell with the closed form, and are then computed in closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from bikeped.errors import GeometryError
from bikeped.geometry.lens import Lens
from bikeped.types import BoolArray, Float32Array, FloatArray

#: A point must lie this far in front of the lens plane to count as seen (definitions, section 1).
FRONT_MIN_M = 0.01
#: A cell whose middle is off by more than this (within REACH_M) is computed in closed form.
TOLERANCE_M = 0.005
REACH_M = 26.0
_ROWS_AT_ONCE = 64  # keeps the temporary arrays in the cache, and the peak of memory low


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


class GroundTable:
    """Pixel to ground positions for one camera's crop. Immutable after building."""

    def __init__(self, camera: GroundCamera, width: int, height: int, step_px: int = 8) -> None:
        """Builds the table of a `width` x `height` crop with a lattice of `step_px` pixels."""
        if width < 2 or height < 2 or step_px < 1:
            raise GeometryError(
                f"ground table: {width} x {height} at a step of {step_px} px is not an image"
            )
        self.camera = camera
        self.width, self.height, self.step_px = width, height, step_px
        columns, rows = -(-width // step_px) + 1, -(-height // step_px) + 1
        u = np.arange(columns, dtype=np.float64) * step_px
        v = np.arange(rows, dtype=np.float64) * step_px
        self._rays: Float32Array = np.empty((rows, columns, 3), np.float32)
        for first in range(0, rows, _ROWS_AT_ONCE):
            last = min(first + _ROWS_AT_ONCE, rows)
            self._rays[first:last] = camera.rays(np.stack(np.meshgrid(u, v[first:last]), axis=-1))
        self._exact: BoolArray = np.ones((rows - 1, columns - 1), np.bool_)
        half = step_px / 2
        for first in range(0, rows - 1, _ROWS_AT_ONCE):
            last = min(first + _ROWS_AT_ONCE, rows - 1)
            middle = np.meshgrid(u[:-1] + half, v[first:last] + half)
            truth = camera.rays(np.stack(middle, axis=-1))
            block = self._rays[first : last + 1]
            mean = (block[:-1, :-1] + block[:-1, 1:] + block[1:, :-1] + block[1:, 1:]) / 4
            self._exact[first:last] = ~_close(mean, truth, camera.height_m)

    @property
    def nbytes(self) -> int:
        """Memory of the table in bytes."""
        return self._rays.nbytes + self._exact.nbytes

    def lookup(self, uv_px: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Ground positions [n, 2] in metres of crop pixels [n, 2], and which are valid [n].

        Within 1 cm of `GroundCamera.ground` up to 25 m. Invalid (NaN): outside the crop or the
        image circle, on or above the horizon. The crop's far edges are inside: a box cut off by the
        lower edge of the image ends on it.
        """
        uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
        u, v = uv[:, 0], uv[:, 1]
        inside = (u >= 0) & (v >= 0) & (u <= self.width) & (v <= self.height)
        gu = np.where(inside, u, 0.0) / self.step_px
        gv = np.where(inside, v, 0.0) / self.step_px
        column = np.minimum(gu.astype(np.intp), self._rays.shape[1] - 2)
        row = np.minimum(gv.astype(np.intp), self._rays.shape[0] - 2)
        fu, fv = (gu - column)[:, None], (gv - row)[:, None]
        top = self._rays[row, column] * (1 - fu) + self._rays[row, column + 1] * fu
        low = self._rays[row + 1, column] * (1 - fu) + self._rays[row + 1, column + 1] * fu
        ray = top * (1 - fv) + low * fv
        down = inside & (ray[:, 2] < -1e-6)
        reach = np.where(down, -self.camera.height_m / np.where(down, ray[:, 2], 1.0), np.nan)
        xy = ray[:, :2] * reach[:, None]
        exact = inside & self._exact[row, column]
        if exact.any():
            xy[exact], down[exact] = self.camera.ground(uv[exact])
        return xy, down


def _close(ray: npt.NDArray[np.floating], truth: FloatArray, height_m: float) -> BoolArray:
    """Whether `ray` meets the ground within TOLERANCE_M of the true ray [...].

    To first order the ground error is |d ray| * slant^2 / height along the line of sight. Rays
    beyond REACH_M have the tolerance of REACH_M; NaN (the rim of the image circle) is not close.
    """
    error = np.sqrt(((ray - truth) ** 2).sum(-1))
    slant_sq = (height_m / np.maximum(-truth[..., 2], 1e-9)) ** 2
    slant_sq = np.minimum(slant_sq, REACH_M**2 + height_m**2)
    return np.asarray(error * slant_sq / height_m <= TOLERANCE_M)
