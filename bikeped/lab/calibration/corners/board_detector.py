"""The board of one image: detectors in order of cost, each candidate checked and refined.

The first detector whose candidate passes the checks decides. Where none finds a whole board, a grid
is grown from the visible corners, and `corner_ids` finds its place on the board.
"""

from __future__ import annotations

import itertools

import numpy as np

from bikeped.errors import CalibrationError
from bikeped.lab.calibration.board_view import BoardPattern, BoardRefusedError, too_few_corners
from bikeped.lab.calibration.corners.board_check import (
    DetectedBoard,
    check_board,
    good_corners,
    refine_by_gradient,
)
from bikeped.lab.calibration.corners.candidates import (
    LARGEST_SIDE_PX,
    first_scale,
    quick_candidates,
    raw_candidates,
    remapped_candidates,
    resized,
)
from bikeped.lab.calibration.corners.corner_ids import assign_corner_ids
from bikeped.lab.calibration.corners.corner_refinement import refine_corners
from bikeped.lab.calibration.corners.grid_growing import CornerGrid, find_grids
from bikeped.lab.calibration.corners.local_grid import local_map
from bikeped.types import BoolArray, FloatArray, ImageArray, IntArray

_SCALES = (1.0, 2.0, 0.5)  # relative to the scale at which an image is searched first
#: Of the board's corners: with fewer, chance could make the outer lines, and little is gained.
LEAST_SHARE = 0.5
_BOARD_SHARE = 1 / 3  # of the corners: fewer are no board, and need no reason
_STRANGE_TIMES, _STRANGE = 3.0, 0.1  # residual of a refined corner: times the usual, at least
_BESIDE_TIMES, _BESIDE = 1.7, 0.015  # the same beside a hidden one
_USUAL = 0.25  # quantile: more than half of the corners may be disturbed
_PASSES = 3


def check_pattern(pattern: BoardPattern) -> None:
    """CalibrationError for a pattern that no detector can find."""
    if min(pattern.columns, pattern.rows) < 3:
        raise CalibrationError(
            f"--pattern {pattern}: a board needs at least 3x3 inner corners (a corner is where "
            "four squares meet)"
        )


def detect_board(
    grey: ImageArray, pattern: BoardPattern, *, thorough: bool = True
) -> DetectedBoard:
    """The board in a grey image [height, width]; BoardRefusedError, with the reason, without one.

    `thorough` False, for live frames: only the quickest detector, and only whole boards.
    """
    candidates = quick_candidates(grey, pattern)
    if thorough:
        candidates = itertools.chain(
            raw_candidates(grey, pattern), remapped_candidates(grey, pattern)
        )
    reason = ""
    for candidate in candidates:
        try:
            return check_board(grey, pattern, candidate)
        except BoardRefusedError as refused:  # noqa: PERF203  (a detection takes far longer)
            reason = reason or str(refused)
    if thorough:
        try:
            return partial_board(grey, pattern)
        except BoardRefusedError as refused:
            reason = str(refused) or reason
    raise BoardRefusedError(f"no whole {pattern} board found" + (f": {reason}" if reason else ""))


def partial_board(grey: ImageArray, pattern: BoardPattern) -> DetectedBoard:
    """The corners of a board that is partly visible; BoardRefusedError where ids are not known.

    The reason is the largest grid's, empty where nothing in the image looks like a board.
    """
    reason, most = "", 0
    first = first_scale(grey)
    for scale in (first * scale for scale in _SCALES):
        if scale > first and max(grey.shape) * scale > LARGEST_SIDE_PX:
            continue
        small, to_full = resized(grey, scale)
        for grid in find_grids(small):
            try:
                return number_grid(
                    grey, pattern, CornerGrid(grid.cell, to_full(grid.uv_px), grid.dark)
                )
            except BoardRefusedError as refused:  # noqa: PERF203  (a grid takes far longer)
                if str(refused) and len(grid) > most:
                    reason, most = str(refused), len(grid)
    raise BoardRefusedError(reason)


def number_grid(grey: ImageArray, pattern: BoardPattern, grid: CornerGrid) -> DetectedBoard:
    """A grown grid refined and numbered; BoardRefusedError, without a reason for a mere scrap."""
    fewest = _BOARD_SHARE * pattern.count
    if len(grid) < fewest:
        raise BoardRefusedError("")
    position = grid.cell.astype(np.float64)
    uv = refine_by_gradient(grey, grid.near(grid.cell), grid.uv_px)
    beside = _beside_hidden(grid.cell)
    for _ in range(_PASSES):
        refined = refine_corners(grey, position, uv)
        good, _ = good_corners(grey, position, refined)
        good &= _undisturbed(refined.residual, beside)
        position, uv, beside = position[good], refined.uv_px[good], beside[good]
        if good.all() or len(position) < fewest:
            break
    if len(position) < fewest:
        raise BoardRefusedError("")
    ids = assign_corner_ids(grey, pattern, CornerGrid(position.astype(np.int64), uv, grid.dark))
    least = int(np.ceil(LEAST_SHARE * pattern.count))
    if len(ids) < least:
        raise BoardRefusedError(too_few_corners(len(ids), pattern, least))
    spacing = local_map(position, position, uv).spacing_px.min(1)
    order = np.argsort(ids)
    blur = float(np.median(refined.blur_px[good]))
    return DetectedBoard(ids[order], uv[order], blur, float(np.median(spacing)))


def _beside_hidden(cell: IntArray) -> BoolArray:
    """[n] which of a grid's cells [n, 2] have a neighbour missing within its outer lines."""
    low, high = cell.min(0) - 1, cell.max(0) + 1
    place = cell - low
    held: BoolArray = np.ones(high - low + 1, np.bool_)
    held[1:-1, 1:-1] = False
    held[place[:, 0], place[:, 1]] = True
    beside = np.zeros(len(cell), np.bool_)
    for column in (-1, 0, 1):
        for row in (-1, 0, 1):
            beside |= ~held[place[:, 0] + column, place[:, 1] + row]
    return beside


def _undisturbed(residual: FloatArray, beside: BoolArray) -> BoolArray:
    """[n] which corners are not moved by the edge of an occluding object.

    Where that edge runs along an edge of the board it moves a corner by half a pixel and leaves
    little residual, so a corner with a hidden neighbour has to fit as well as the usual ones.
    """
    usual = float(np.quantile(residual, _USUAL))
    most = np.where(
        beside, max(_BESIDE_TIMES * usual, _BESIDE), max(_STRANGE_TIMES * usual, _STRANGE)
    )
    return np.asarray(residual < most)
