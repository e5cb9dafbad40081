"""From what a detector claims to corners that can be trusted: ids, repair, refinement, checks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bikeped.lab.calibration.board_view import (
    BoardPattern,
    BoardRefusedError,
    BoardView,
    larger_board,
    too_few_corners,
)
from bikeped.lab.calibration.corners.corner_refinement import (
    RefinedCorners,
    is_edge_crossing,
    refine_corners,
)
from bikeped.lab.calibration.corners.local_grid import (
    LocalMap,
    crossing_score,
    grid_positions,
    local_map,
    nearest_level,
    neighbour_residual,
    repair_corners,
)
from bikeped.types import BoolArray, FloatArray, ImageArray, IntArray

_ROUGH = 0.3  # squares: a candidate's corner further off its neighbours' expectation is wrong ...
_FINE_PX = 1.5  # ... and a refined one further than this ...
_FINE = (0.06, 0.1, 0.2)  # ... plus this share of a square: inside, at an edge, at a board's corner
_REPAIRABLE = 0.15  # of the corners
_KEPT = 0.7  # of the corners must be good in the end
_CROSSES = 0.15  # `crossing` of a corner that can be seen


@dataclass(frozen=True)
class DetectedBoard:
    """Good corners: `ids` ascending, `uv_px` [n, 2], blur of the edges, and squares' size."""

    ids: IntArray
    uv_px: FloatArray
    blur_px: float  #: median standard deviation of the edges' smoothing
    spacing_px: float  #: median of the shorter side of the squares


def check_board(grey: ImageArray, pattern: BoardPattern, uv_px: FloatArray) -> DetectedBoard:
    """The corners of a candidate [columns * rows, 2], row by row.

    BoardRefusedError, with the reason, where it is no board of the pattern.
    """
    ids: IntArray = np.arange(pattern.count, dtype=np.int64)
    position = grid_positions(pattern, ids)
    repaired = repair_corners(position, uv_px, _ROUGH, int(_REPAIRABLE * pattern.count))
    if repaired is None:
        raise BoardRefusedError("its corners make no regular board")
    uv = orient_corners(grey, pattern, repaired)
    near = local_map(position, position, uv)
    uv = refine_by_gradient(grey, near, uv)
    refined = refine_corners(grey, position, uv)
    good, expected = good_corners(grey, position, refined)
    if not good.all() and good.mean() > 0.5:
        again = refine_corners(grey, position, np.where(good[:, None], refined.uv_px, expected))
        better, _ = good_corners(grey, position, again)
        if better.sum() > good.sum():
            refined, good = again, better
    if good.mean() < _KEPT:
        raise BoardRefusedError(too_few_corners(int(good.sum()), pattern))
    ids, position, uv = ids[good], position[good], refined.uv_px[good]
    if _continues_beyond(grey, pattern, position, uv):
        raise BoardRefusedError(larger_board(pattern))
    if not good.all():  # a wrong corner gave its neighbours a wrong bend
        refined = refine_corners(grey, position, uv)
        uv = refined.uv_px
    spacing = local_map(position, position, uv).spacing_px.min(1)
    return DetectedBoard(ids, uv, float(np.median(refined.blur_px)), float(np.median(spacing)))


def rms_shift_px(
    board: DetectedBoard, other: DetectedBoard | BoardView, least_common: float
) -> float:
    """Root mean square distance of the corners that both boards have, in pixels.

    Infinite where they share fewer than `least_common`.
    """
    _, mine, theirs = np.intersect1d(board.ids, other.ids, return_indices=True)
    if len(mine) < least_common:
        return float("inf")
    shift = board.uv_px[mine] - other.uv_px[theirs]
    return float(np.sqrt((shift**2).sum(1).mean()))


def orient_corners(grey: ImageArray, pattern: BoardPattern, uv_px: FloatArray) -> FloatArray:
    """The corners ordered so that an id is the same corner in every image, where that is possible.

    Columns by rows is never a mirror image. Turned by 180 degrees a board with columns + rows odd
    changes its colours: there corner 0 is the one whose outer square is dark. With columns + rows
    even (8x6) the two ways round look alike; the one is taken whose columns run to the right in the
    image (downward, where they run up and down), which is the same corner as long as the board is
    not turned by more than 90 degrees. A square pattern is treated likewise.
    """
    grid: FloatArray = uv_px.reshape(pattern.rows, pattern.columns, 2)
    right, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    if np.median(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]) < 0:
        grid = grid[:, ::-1]
    ways = [grid, grid[::-1, ::-1]]
    if pattern.columns == pattern.rows:
        ways += [np.rot90(way) for way in ways]
    dark = [_starts_dark(grey, pattern, way) for way in ways]
    allowed = [way for way, first in zip(ways, dark, strict=True) if first] or ways
    best = max(allowed, key=_rightward)
    return np.asarray(best.reshape(-1, 2))


def _rightward(grid: FloatArray) -> float:
    along = (grid[:, -1] - grid[:, 0]).mean(0)
    return float(along[0] + 1e-3 * along[1])


def _starts_dark(grey: ImageArray, pattern: BoardPattern, grid: FloatArray) -> bool:
    """Whether the outer square beyond corner 0 is dark, by the squares inside."""
    level = nearest_level(grey, (grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:]) / 4)
    column, row = np.meshgrid(np.arange(pattern.columns - 1), np.arange(pattern.rows - 1))
    even = (column + row) % 2 == 0
    return bool(level[even].mean() < level[~even].mean())


def refine_by_gradient(grey: ImageArray, near: LocalMap, uv: FloatArray) -> FloatArray:
    """[n, 2] corners within half a pixel or so, by cv2.cornerSubPix with a window of each corner's
    own size; `uv` [n, 2] where the detector's guess is better."""
    height, width = grey.shape
    half = np.clip(np.rint(0.2 * near.spacing_px.min(1)), 2, 12).astype(int)
    inside = (uv > 1).all(1) & (uv[:, 0] < width - 2) & (uv[:, 1] < height - 2)
    out = uv.copy()
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.02)
    for size in np.unique(half[inside]):
        which = inside & (half == size)
        start = np.ascontiguousarray(uv[which], np.float32).reshape(-1, 1, 2)
        side = (int(size), int(size))
        out[which] = cv2.cornerSubPix(grey, start, side, (-1, -1), stop).reshape(-1, 2)
    far = np.linalg.norm(out - uv, axis=1) > np.maximum(0.3 * near.spacing_px.min(1), 1.5)
    out[far] = uv[far]
    return out


def good_corners(
    grey: ImageArray, position: FloatArray, refined: RefinedCorners
) -> tuple[BoolArray, FloatArray]:
    """[n] which corners are crossings of the right colours where their neighbours expect them, and
    [n, 2] where that is, in pixels. `position` [n, 2]: column and row of each."""
    near = local_map(position, position, refined.uv_px)
    spacing = near.spacing_px.min(1)
    colour = crossing_score(grey, near) * _checker_sign(position)
    if np.median(colour) < 0:
        colour = -colour
    clear = is_edge_crossing(refined, spacing) & (colour > _CROSSES)
    if clear.mean() < 0.5:
        return clear, refined.uv_px
    off, expected = neighbour_residual(position, refined.uv_px, clear)
    # At an edge the neighbours can only be extrapolated, at a board's corner in both directions.
    edges = ((position == position.min(0)) | (position == position.max(0))).sum(1)
    limit_px = _FINE_PX + np.array(_FINE)[edges] * spacing
    return np.asarray(clear & (off * spacing < limit_px)), expected


def _checker_sign(position: FloatArray) -> FloatArray:
    return np.where(position.sum(1) % 2 == 0, 1.0, -1.0)


def _continues_beyond(
    grey: ImageArray, pattern: BoardPattern, position: FloatArray, uv: FloatArray
) -> bool:
    """Whether one of the board's sides is followed by another line of corners."""
    columns, rows = pattern.columns, pattern.rows
    sides = [[(c, r) for r in range(rows)] for c in (-1, columns)]
    sides += [[(c, r) for c in range(columns)] for r in (-1, rows)]
    for side in sides:
        beyond = np.array(side, np.float64)
        score = crossing_score(grey, local_map(beyond, position, uv)) * _checker_sign(beyond)
        if (score > 0.4).mean() > 0.7 or (score < -0.4).mean() > 0.7:
            return True
    return False
