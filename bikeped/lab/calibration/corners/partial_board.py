"""Boards of which a part is hidden: their corners get ids only where the pattern pins them.

A grid that was grown from what can be seen counts from anywhere. Its place on the board is known
when it has all columns and all rows, or where the squares of an outer edge are followed by the
paper's white margin. Else the picture is refused, with the reason: which corner is which would be a
guess.
"""

from __future__ import annotations

import cv2
import numpy as np

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.corners.board_check import Checked, good_corners, settled
from bikeped.lab.calibration.corners.corner_ids import pin
from bikeped.lab.calibration.corners.detect_raw import FIRST_SIDE_PX
from bikeped.lab.calibration.corners.grid_growing import Grid, grids
from bikeped.lab.calibration.corners.local_grid import local_map
from bikeped.lab.calibration.corners.refine import refine
from bikeped.types import BoolArray, FloatArray, ImageArray, IntArray

_SCALES = (1.0, 2.0, 0.5)  # of a picture made FIRST_SIDE_PX large; no more than _LARGEST_PX
_LARGEST_PX = 2300
#: Of the board's corners: with fewer, chance could make the outer lines, and little is gained.
LEAST_SHARE = 0.5
_BOARD_SHARE = 1 / 3  # of the corners: in sight, and worth a word on what is missing
_STRANGE_TIMES, _STRANGE = 3.0, 0.1  # what a refined corner may leave: times the usual, at least
_BESIDE_TIMES, _BESIDE = 1.7, 0.015  # the same beside a hidden one
_USUAL = 0.25  # quantile: more than half of the corners may be disturbed
_PASSES = 3


def partial_board(grey: ImageArray, pattern: BoardPattern) -> Checked | str:
    """The corners of a board that is partly in sight; or why its ids cannot be known, in words.

    The words are empty where nothing in the picture looks like a board.
    """
    why, most = "", 0
    first = min(1.0, FIRST_SIDE_PX / max(grey.shape))
    for scale in (first * scale for scale in _SCALES):
        if scale > first and max(grey.shape) * scale > _LARGEST_PX:
            continue
        for grid in _at_scale(grey, scale):
            answer = placed(grey, pattern, grid)
            if isinstance(answer, Checked):
                return answer
            if answer and len(grid) > most:
                why, most = answer, len(grid)
    return why


def _at_scale(grey: ImageArray, scale: float) -> list[Grid]:
    """The picture's grids as seen `scale` times as large, in pixels of the full picture."""
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    if size == (grey.shape[1], grey.shape[0]):
        return grids(grey)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = np.asarray(cv2.resize(grey, size, interpolation=how), np.uint8)
    ratio = np.array([grey.shape[1] / size[0], grey.shape[0] / size[1]])
    return [Grid(one.cell, (one.uv_px + 0.5) * ratio - 0.5, one.dark) for one in grids(small)]


def placed(grey: ImageArray, pattern: BoardPattern, grid: Grid) -> Checked | str:
    """A grown grid refined and numbered; or why it cannot be, in words (none for a mere scrap)."""
    if len(grid) < _BOARD_SHARE * pattern.count:
        return ""
    seen = grid.cell.astype(np.float64)
    uv = settled(grey, grid.near(grid.cell), grid.uv_px)
    beside = _beside_hidden(grid.cell)
    for _ in range(_PASSES):
        refined = refine(grey, seen, uv)
        good, _ = good_corners(grey, seen, refined)
        good &= _undisturbed(refined.residual, beside)
        seen, uv, beside = seen[good], refined.uv_px[good], beside[good]
        if good.all() or len(seen) < _BOARD_SHARE * pattern.count:
            break
    if len(seen) < _BOARD_SHARE * pattern.count:
        return ""
    found = Grid(seen.astype(np.int64), uv, grid.dark)
    ids = pin(grey, pattern, found)
    if isinstance(ids, str):
        return ids
    least = int(np.ceil(LEAST_SHARE * pattern.count))
    if len(ids) < least:
        return f"only {len(ids)} of {pattern.count} corners can be seen clearly, not {least}"
    spacing = local_map(seen, seen, uv).spacing_px.min(1)
    order = np.argsort(ids)
    blur = float(np.median(refined.blur_px[good]))
    return Checked(ids[order], uv[order], blur, float(np.median(spacing)))


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
    """[n] which corners the edge of what hides the others does not touch.

    Where it runs along an edge of the board it moves a corner by half a pixel and leaves little
    that the model cannot explain: a corner with a hidden neighbour has to fit as the usual ones do.
    """
    usual = float(np.quantile(residual, _USUAL))
    most = np.where(
        beside, max(_BESIDE_TIMES * usual, _BESIDE), max(_STRANGE_TIMES * usual, _STRANGE)
    )
    return np.asarray(residual < most)
