"""From what a detector claims to corners that can be trusted: ids, repair, refinement, checks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.corners.local_grid import (
    LocalMap,
    crossing,
    local_map,
    misfit,
    places,
    repair,
)
from bikeped.lab.calibration.corners.refine import Refined, fits, refine
from bikeped.types import BoolArray, FloatArray, ImageArray, IntArray

_ROUGH = 0.3  # squares: a candidate's corner further off its neighbours' expectation is wrong ...
_FINE_PX = 1.5  # ... and a refined one further than this ...
_FINE = (0.06, 0.1, 0.2)  # ... plus this share of a square: inside, at an edge, at a board's corner
_REPAIRABLE = 0.15  # of the corners
_KEPT = 0.7  # of the corners must be good in the end
_CROSSES = 0.15  # `crossing` of a corner that can be seen


@dataclass(frozen=True)
class Checked:
    """Good corners: `ids` ascending, `uv_px` [n, 2], blur of the edges, and squares' size."""

    ids: IntArray
    uv_px: FloatArray
    blur_px: float
    spacing_px: float


def check_board(grey: ImageArray, pattern: BoardPattern, uv_px: FloatArray) -> Checked | str:
    """The corners of a candidate [columns * rows, 2], row by row; or why it is none, in words."""
    ids: IntArray = np.arange(pattern.count, dtype=np.int64)
    seen = places(pattern, ids)
    mended = repair(seen, uv_px, _ROUGH, int(_REPAIRABLE * pattern.count))
    if mended is None:
        return "its corners make no regular board"
    uv = arranged(grey, pattern, mended[0])
    near = local_map(seen, seen, uv)
    uv = settled(grey, near, uv)
    refined = refine(grey, seen, uv)
    good, expected = good_corners(grey, seen, refined)
    if not good.all() and good.mean() > 0.5:
        again = refine(grey, seen, np.where(good[:, None], refined.uv_px, expected))
        better, _ = good_corners(grey, seen, again)
        if better.sum() > good.sum():
            refined, good = again, better
    if good.mean() < _KEPT:
        return f"only {int(good.sum())} of {pattern.count} corners can be seen clearly"
    ids, seen, uv = ids[good], seen[good], refined.uv_px[good]
    wrong = _goes_on(grey, pattern, seen, uv)
    if wrong:
        return wrong
    if not good.all():  # a wrong corner has told its neighbours a wrong bend
        refined = refine(grey, seen, uv)
        uv = refined.uv_px
    spacing = local_map(seen, seen, uv).spacing_px.min(1)
    return Checked(ids, uv, float(np.median(refined.blur_px)), float(np.median(spacing)))


def arranged(grey: ImageArray, pattern: BoardPattern, uv_px: FloatArray) -> FloatArray:
    """The same corners with ids that mean the same in every picture, as far as that can be.

    Columns by rows is never a mirror image. Turned by 180 degrees a board with columns + rows odd
    changes its colours: there corner 0 is the one whose outer square is dark. With columns + rows
    even (8x6) the two ways round look alike; the one is taken whose columns run to the right in the
    picture (downward, where they run up and down), which is the same corner as long as nobody turns
    the board by more than 90 degrees. A square pattern is treated likewise.
    """
    grid: FloatArray = uv_px.reshape(pattern.rows, pattern.columns, 2)
    if _handed(grid) < 0:
        grid = grid[:, ::-1]
    ways = [grid, grid[::-1, ::-1]]
    if pattern.columns == pattern.rows:
        ways += [np.rot90(way) for way in ways]
    dark = [_dark_start(grey, pattern, way) for way in ways]
    allowed = [way for way, first in zip(ways, dark, strict=True) if first] or ways
    best = max(allowed, key=_upright)
    return np.asarray(best.reshape(-1, 2))


def _handed(grid: FloatArray) -> float:
    right, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    return float(np.median(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]))


def _upright(grid: FloatArray) -> float:
    along = (grid[:, -1] - grid[:, 0]).mean(0)
    return float(along[0] + 1e-3 * along[1])


def _dark_start(grey: ImageArray, pattern: BoardPattern, grid: FloatArray) -> bool:
    """Whether the outer square beyond corner 0 is dark, told from the squares inside."""
    middle = (grid[:-1, :-1] + grid[:-1, 1:] + grid[1:, :-1] + grid[1:, 1:]) / 4
    at = np.rint(middle).astype(np.intp)
    level = grey[
        np.clip(at[..., 1], 0, grey.shape[0] - 1), np.clip(at[..., 0], 0, grey.shape[1] - 1)
    ].astype(np.float64)
    column, row = np.meshgrid(np.arange(pattern.columns - 1), np.arange(pattern.rows - 1))
    even = (column + row) % 2 == 0
    return bool(level[even].mean() < level[~even].mean())


def settled(grey: ImageArray, near: LocalMap, uv: FloatArray) -> FloatArray:
    """[n, 2] within half a pixel or so, by the gradient method with a window of each corner's own
    size; `uv` [n, 2] where the detector's guess is better."""
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
    grey: ImageArray, seen: FloatArray, refined: Refined
) -> tuple[BoolArray, FloatArray]:
    """[n] which corners are crossings of the right colours where their neighbours expect them, and
    [n, 2] where that is. `seen` [n, 2] column and row of each."""
    near = local_map(seen, seen, refined.uv_px)
    spacing = near.spacing_px.min(1)
    colour = crossing(grey, near) * np.where(seen.sum(1) % 2 == 0, 1.0, -1.0)
    if np.median(colour) < 0:
        colour = -colour
    clear = fits(refined, spacing) & (colour > _CROSSES)
    if clear.mean() < 0.5:
        return clear, refined.uv_px
    off, expected = misfit(seen, refined.uv_px, clear)
    # At an edge the others can only be continued, and a board's corner lies off both ways.
    share = np.array(_FINE)[_edges_touched(seen)]
    return np.asarray(clear & (off * spacing < _FINE_PX + share * spacing)), expected


def _edges_touched(seen: FloatArray) -> IntArray:
    return np.asarray(((seen == seen.min(0)) | (seen == seen.max(0))).sum(1), np.int64)


def _goes_on(grey: ImageArray, pattern: BoardPattern, seen: FloatArray, uv: FloatArray) -> str:
    """Words for a board that has more corners than the pattern beyond one of its sides."""
    columns, rows = pattern.columns, pattern.rows
    sides = (
        [(-1, r) for r in range(rows)],
        [(columns, r) for r in range(rows)],
        [(c, -1) for c in range(columns)],
        [(c, rows) for c in range(columns)],
    )
    for side in sides:
        at = np.array(side, np.float64)
        score = crossing(grey, local_map(at, seen, uv)) * np.where(at.sum(1) % 2 == 0, 1.0, -1.0)
        if (score > 0.4).mean() > 0.7 or (score < -0.4).mean() > 0.7:
            return f"the board has more inner corners than {columns}x{rows}; correct --pattern"
    return ""
