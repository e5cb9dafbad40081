"""The ground table: precomputed rays on a pixel lattice, interpolated bilinearly.

Ground positions grow without bound toward the horizon and interpolate badly; ray directions do not.
The table holds unit rays on a coarse lattice (8 px: 2.3 MB for a 3500 px crop); the intersection
with the ground is one division at look-up. Interpolation over 8 px changes a ray by some 1e-5 rad,
about a millimetre at 25 m. Cells where the lens bends faster (the rim of an orthographic lens, a
tiny image) are found while building, by comparing the middle of each cell with the closed form, and
are then always computed in closed form.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.types import BoolArray, Float32Array, FloatArray

#: A cell whose middle is off by more than this (within REACH_M) is computed in closed form.
TOLERANCE_M = 0.005
REACH_M = 26.0
_ROWS_AT_ONCE = 64  # keeps the temporary arrays in the cache, and the peak of memory low


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
            self._rays[first:last] = camera.rays(_grid(u, v[first:last]))
        self._exact: BoolArray = np.ones((rows - 1, columns - 1), np.bool_)
        half = step_px / 2
        for first in range(0, rows - 1, _ROWS_AT_ONCE):
            last = min(first + _ROWS_AT_ONCE, rows - 1)
            truth = camera.rays(_grid(u[:-1] + half, v[first:last] + half))
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


def _grid(u: FloatArray, v: FloatArray) -> FloatArray:
    """[len(v), len(u), 2] pixels."""
    grid = np.empty((len(v), len(u), 2))
    grid[..., 0] = u
    grid[..., 1] = v[:, None]
    return grid


def _close(ray: npt.NDArray[np.floating], truth: FloatArray, height_m: float) -> BoolArray:
    """Whether `ray` meets the ground within TOLERANCE_M of the true ray [...].

    To first order the ground error is |d ray| * slant^2 / height along the line of sight. Rays
    beyond REACH_M have the tolerance of REACH_M; NaN (the rim of the image circle) is not close.
    """
    error = np.sqrt(((ray - truth) ** 2).sum(-1))
    slant_sq = (height_m / np.maximum(-truth[..., 2], 1e-9)) ** 2
    slant_sq = np.minimum(slant_sq, REACH_M**2 + height_m**2)
    return np.asarray(error * slant_sq / height_m <= TOLERANCE_M)
