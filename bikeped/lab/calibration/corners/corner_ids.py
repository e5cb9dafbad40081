"""Assigns the board's corner ids to a grid of corners, by its extent or by the board's outer edge.

A grid with all columns and all rows has only one place on the board. With one line missing, an
edge of the board still shows which one: there the outermost squares are followed by the paper's
white margin. A wrong id is worse than none, so anything else is refused, with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.lab.calibration.board_view import (
    LEAST_IN_LINE,
    BoardPattern,
    BoardRefusedError,
    ambiguous_place,
    larger_board,
)
from bikeped.lab.calibration.corners.grid_growing import CornerGrid
from bikeped.lab.calibration.corners.local_grid import quadrants, sample
from bikeped.types import FloatArray, ImageArray, IntArray

_ENDS_AT = 2  # places at which a board is seen to end
_EDGE_AT = 3  # the same where the end identifies the line; and of all places that can be judged ...
_EDGE_SHARE = 0.75  # ... this share
_CONTINUES_AT = 2  # places beyond a line that are crossings, too
_CLEARLY = 0.5  # of the way from the middle grey to light and dark squares
_STEP, _NEAR_STEP = 0.3, 0.18  # squares to either side of an outer edge where grey is sampled


def assign_corner_ids(grey: ImageArray, pattern: BoardPattern, grid: CornerGrid) -> IntArray:
    """[n] the ids of a grid's corners; BoardRefusedError where they cannot be known.

    Ids follow the rule for whole boards (`board_check.orient_corners`): never mirrored, the outer
    square beyond corner 0 dark where the colours can tell, else columns to the right.
    """
    wanted = np.array([pattern.columns, pattern.rows])
    size = _GridBounds.of(grid, 1).size
    if not ((size <= wanted).all() or (size[::-1] <= wanted).all()):
        raise BoardRefusedError(larger_board(pattern, size))
    # Positions [n, 2] (column, row) on the board, whether the outer square beyond corner 0 is dark,
    # as it must be, and how many columns and rows are in sight: with fewer than all, an outer edge
    # placed them.
    orientations: list[tuple[IntArray, bool, IntArray]] = []
    reasons: list[str] = []
    turned = grid
    for turns in range(4):
        if turns:  # counted from the next of its sides: a quarter turn changes the colours
            cell = np.stack([turned.cell[:, 1], -turned.cell[:, 0]], axis=-1)
            turned = CornerGrid(cell, grid.uv_px, not turned.dark)
        bounds = _GridBounds.of(turned, LEAST_IN_LINE)
        if (bounds.size > wanted).any() or (bounds.size < 1).any():
            continue
        try:
            first = _first_cell(grey, pattern, turned, bounds)
        except BoardRefusedError as refused:
            reasons.append(str(refused))
            continue
        position = turned.cell - first
        if (position < 0).any() or (position >= wanted).any():
            reasons.append("some of its corners lie beyond its white margin: something hides it")
            continue
        dark = bool(first.sum() % 2 == 0) == turned.dark
        orientations.append((position, dark, bounds.size))
    if not orientations:
        hidden = f"fewer than {LEAST_IN_LINE} corners of its outer rows and columns can be seen"
        raise BoardRefusedError([*reasons, hidden][0])
    allowed = [position for position, dark, _ in orientations if dark]
    if not allowed and (orientations[0][2] < wanted).any():
        # An edge that is taken for the board's own shifts all by a line, which turns the colours.
        raise BoardRefusedError(ambiguous_place(pattern, orientations[0][2]))
    positions = allowed or [position for position, _, _ in orientations]
    best = max(positions, key=lambda position: _rightward(grid, position))
    return np.asarray(best[:, 1] * pattern.columns + best[:, 0], np.int64)


@dataclass(frozen=True)
class _GridBounds:
    """The first and last column and row that hold enough corners."""

    low: IntArray
    high: IntArray

    @property
    def size(self) -> IntArray:
        return np.asarray(self.high - self.low + 1)

    @staticmethod
    def of(grid: CornerGrid, least: int) -> _GridBounds:
        """Bounds without outer lines of fewer than `least` corners; size 0 where none is left."""
        cell = grid.cell
        while len(cell):
            low, high = cell.min(0), cell.max(0)
            poor = np.zeros(len(cell), np.bool_)
            for line in (low, high):
                on = cell == line
                poor |= (on & (on.sum(0) < least)).any(1)
            if not poor.any():
                return _GridBounds(low, high)
            cell = cell[~poor]
        return _GridBounds(np.zeros(2, np.int64), np.full(2, -1))


def _first_cell(
    grey: ImageArray, pattern: BoardPattern, grid: CornerGrid, bounds: _GridBounds
) -> IntArray:
    """[2] the cell that is the board's corner 0; BoardRefusedError where that is not known."""
    out = bounds.low.copy()
    wanted = np.array([pattern.columns, pattern.rows])
    missing = wanted - bounds.size
    fits_turned = wanted[0] != wanted[1] and bool((bounds.size[::-1] <= wanted).all())
    if missing.sum() > 1 or (missing.any() and fits_turned):
        raise BoardRefusedError(ambiguous_place(pattern, bounds.size))
    for axis in (0, 1):
        edges = [_BoardEdge.of(grey, grid, bounds, axis, way) for way in (-1, 1)]
        if missing[axis]:
            before, after = (edge.is_outer_edge for edge in edges)
            if before == after:
                raise BoardRefusedError(ambiguous_place(pattern, bounds.size))
            out[axis] -= int(after)
        elif any(edge.continues >= _CONTINUES_AT for edge in edges):
            larger = bounds.size + (np.arange(2) == axis)
            raise BoardRefusedError(larger_board(pattern, larger))
        elif all(edge.ends < _ENDS_AT for edge in edges):
            raise BoardRefusedError(
                f"{wanted[axis]} {('columns', 'rows')[axis]} are in sight, but no white margin on "
                "either side of them: there may be more; show an outer edge of the board"
            )
    return out


@dataclass(frozen=True)
class _BoardEdge:
    """What lies beyond an outer line of a grid, counted over the line's corners.

    `visible`: the outer squares are recognised; of these `continues`: with a crossing beyond,
    `ends`: with light on both sides beyond, `white`: the same right at the squares' edge, as a
    margin is.
    """

    visible: int
    continues: int
    ends: int
    white: int

    @property
    def is_outer_edge(self) -> bool:
        """Whether this is the board's own edge."""
        return self.white >= max(_EDGE_AT, _EDGE_SHARE * self.visible)

    @staticmethod
    def of(
        grey: ImageArray, grid: CornerGrid, bounds: _GridBounds, axis: int, way: int
    ) -> _BoardEdge:
        """Beyond the last line of columns (`axis` 0) or rows (1), `way` -1: the first."""
        line = bounds.high[axis] if way > 0 else bounds.low[axis]
        last = grid.cell[grid.cell[:, axis] == line]
        outward = np.zeros(2, np.int64)
        outward[axis] = way
        beyond = last + outward
        near = grid.near(beyond)
        # [n] grey levels of dark and light squares about the corners; NaN at the picture's edge.
        around = quadrants(grey, grid.near(last))
        pairs = np.stack([around[:, [0, 3]].mean(1), around[:, [1, 2]].mean(1)])
        dark, light = pairs.min(0)[:, None], pairs.max(0)[:, None]
        middle, half = (light + dark) / 2, np.maximum(light - dark, 1.0) / 2
        visible, white = np.ones(len(last), np.bool_), np.ones(len(last), np.bool_)
        for share in (_NEAR_STEP, _STEP):
            inner, outer = (_steps(axis, side * way, share) for side in (-1, 1))
            # On a scale from -1 as the dark squares to 1 as the light ones.
            levels = (sample(grey, near.at_steps(step)) for step in (inner, outer))
            here, there = ((level - middle) / half for level in levels)
            visible &= (here * grid.lights(beyond, inner) > _CLEARLY).all(1)
            # As light as the board's own squares: the same paper, not a sheet or a glare over it.
            white &= (np.abs(there - 1) < 1 - _CLEARLY).all(1)
            crosses = (there * grid.lights(beyond, outer) > _CLEARLY).all(1)
            ends = (there > 0).all(1)
        return _BoardEdge(*(int((visible & how).sum()) for how in (True, crosses, ends, white)))


def _steps(axis: int, way: int, share: float) -> FloatArray:
    """[2, 2] to the middle of the two squares on one side of a corner, or toward it."""
    step: FloatArray = np.full((2, 2), share)
    step[:, axis] = way * share
    step[0, 1 - axis] = -share
    return step


def _rightward(grid: CornerGrid, position: IntArray) -> float:
    """How far columns run to the right in the image, or downward: as `orient_corners` has it."""
    uv_at = {(int(c), int(r)): uv for (c, r), uv in zip(position, grid.uv_px, strict=True)}
    steps = [uv_at[c + 1, r] - uv for (c, r), uv in uv_at.items() if (c + 1, r) in uv_at]
    along = np.mean(steps, axis=0) if steps else np.zeros(2)
    return float(along[0] + 1e-3 * along[1])
