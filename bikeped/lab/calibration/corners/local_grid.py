"""A board as a grid: the local map from squares to pixels, and corners that do not fit it.

No lens is needed here: over two or three squares a board seen through any lens is close to a cubic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.types import BoolArray, Float32Array, FloatArray, ImageArray, IntArray

_REACH = 0.8  # squares: standard deviation of a neighbour's weight
_RIDGE = 1e-4  # keeps a cubic defined where a partial board has too few neighbours


@dataclass(frozen=True)
class LocalMap:
    """Pixels near each corner: uv = at + along @ step + bend(step), step in squares.

    `at_px` [n, 2], `along_px` [n, 2 (u, v), 2 (columns, rows)], `bend_px` [n, 2, 3] with the
    factors of x^2, xy and y^2.
    """

    at_px: FloatArray
    along_px: FloatArray
    bend_px: FloatArray

    @property
    def spacing_px(self) -> FloatArray:
        """[n, 2] length of a square along columns and along rows."""
        return np.asarray(np.linalg.norm(self.along_px, axis=1))

    def at_steps(self, step: FloatArray) -> FloatArray:
        """[n, k, 2] pixels at `step` [k, 2] or [n, k, 2] squares from each corner."""
        x, y = step[..., 0], step[..., 1]
        square = np.stack([x * x, x * y, y * y], axis=-1)
        out = self.at_px[:, None] + step @ self.along_px.transpose(0, 2, 1)
        return np.asarray(out + square @ self.bend_px.transpose(0, 2, 1))


def grid_positions(pattern: BoardPattern, ids: IntArray) -> FloatArray:
    """[n, 2] column and row of each id."""
    return np.stack([ids % pattern.columns, ids // pattern.columns], axis=-1).astype(np.float64)


def local_map(
    at: FloatArray, position: FloatArray, uv_px: FloatArray, *, without_self: bool = False
) -> LocalMap:
    """The map near places `at` [m, 2] (column, row) from corners at `position` [n, 2],
    seen at `uv_px` [n, 2].

    `without_self` leaves out a corner that lies exactly at the place: it is predicted.
    """
    step = position[None] - at[:, None]
    far = (step**2).sum(-1)
    weight = np.exp(-far / (2 * _REACH**2)) + 1e-7
    if without_self:
        weight[far < 1e-9] = 0.0
    x, y = step[..., 0], step[..., 1]
    one, xx, yy = np.ones_like(x), x * x, y * y
    terms = np.stack([one, x, y, xx, x * y, yy, x * xx, y * xx, x * yy, y * yy], axis=-1)
    weighted = terms * weight[..., None]
    normal = weighted.transpose(0, 2, 1) @ terms
    normal[:, np.arange(3, 10), np.arange(3, 10)] += _RIDGE
    normal += 1e-12 * np.eye(10)
    middle = uv_px.mean(0)
    factor = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ (uv_px - middle))
    return LocalMap(
        factor[:, 0] + middle, factor[:, 1:3].transpose(0, 2, 1), factor[:, 3:6].transpose(0, 2, 1)
    )


def neighbour_residual(
    position: FloatArray, uv_px: FloatArray, trusted: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """[n] how far each corner lies from where its trusted neighbours expect it, in squares, and
    [n, 2] where that is, in pixels."""
    expected = local_map(position, position[trusted], uv_px[trusted], without_self=True)
    off = np.linalg.norm(uv_px - expected.at_px, axis=1)
    return off / np.maximum(expected.spacing_px.min(axis=1), 1e-9), expected.at_px


def repair_corners(
    position: FloatArray, uv_px: FloatArray, limit: float, most: int
) -> FloatArray | None:
    """[n, 2] with the worst corner moved to where its neighbours expect it until all fit.

    `limit`: of `neighbour_residual`, in squares. None when more than `most` would have to be moved.
    """
    uv = uv_px.copy()
    trusted = np.ones(len(uv), np.bool_)
    for _ in range(most + 1):
        # A wrong corner spoils its neighbours' expectation too: one at a time, the worst first.
        off, _ = neighbour_residual(position, uv, trusted)
        off[~trusted] = 0.0
        if off.max() <= limit:
            if not trusted.all():
                moved = local_map(position[~trusted], position[trusted], uv[trusted])
                uv[~trusted] = moved.at_px
            return uv
        trusted[int(off.argmax())] = False
    return None


def quadrants(grey: ImageArray, near: LocalMap) -> FloatArray:
    """[n, 4] grey levels diagonally off each corner, in the squares up-left, up-right, down-left,
    down-right of it; NaN outside the picture."""
    step = 0.3 * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
    return sample(grey, near.at_steps(step))


def sample(grey: ImageArray, uv_px: FloatArray) -> FloatArray:
    """Grey level [...] of the nearest pixel to `uv_px` [..., 2]; NaN outside the image."""
    u, v = np.rint(uv_px[..., 0]), np.rint(uv_px[..., 1])
    inside = (u >= 0) & (v >= 0) & (u < grey.shape[1]) & (v < grey.shape[0])
    level = nearest_level(grey, np.where(inside[..., None], uv_px, 0))
    return np.asarray(np.where(inside, level, np.nan))


def nearest_level(grey: ImageArray | Float32Array, uv_px: FloatArray) -> FloatArray:
    """Grey level [...] of the image's pixel nearest to `uv_px` [..., 2], at its edge outside."""
    at = np.rint(uv_px).astype(np.intp)
    u = np.clip(at[..., 0], 0, grey.shape[1] - 1)
    v = np.clip(at[..., 1], 0, grey.shape[0] - 1)
    return np.asarray(grey[v, u].astype(np.float64))


def crossing_score(grey: ImageArray, near: LocalMap) -> FloatArray:
    """[n] how clearly each place is a corner: 1 for a clean crossing, 0 for none.

    The smallest difference between a dark and a light quadrant, over the largest; the sign is that
    of the colours: positive where the square up-left of the corner is dark.
    """
    level = quadrants(grey, near)
    same = np.minimum(level[:, 1], level[:, 2]) - np.maximum(level[:, 0], level[:, 3])
    other = np.minimum(level[:, 0], level[:, 3]) - np.maximum(level[:, 1], level[:, 2])
    spread = np.maximum(np.nanmax(level, 1, initial=-1) - np.nanmin(level, 1, initial=256), 8.0)
    score = np.where(same > 0, same, np.where(other > 0, -other, 0.0)) / spread
    return np.asarray(np.nan_to_num(score, nan=0.0))
