"""Which corners of the board a grid holds: told by its extent, or by the board's own outer edge.

A grid with all columns and all rows has only one place on the board. With one line too few, an
edge of the board still says which one is missing: there the outermost squares are followed by the
paper's white margin. A wrong number is worse than none, so all else is refused, with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.corners.grid_growing import Grid
from bikeped.lab.calibration.corners.local_grid import quadrants, sample
from bikeped.types import FloatArray, ImageArray, IntArray

#: Corners of an outer line that show it: one or two could be something else.
LEAST_IN_LINE = 3
_ENDS_AT = 2  # places where a board is seen to end
_PINNED_AT = (
    3  # the same where the end must say which line it is; and of all that can be judged ...
)
_PINNED_SHARE = 0.75  # ... this share
_GOES_ON_AT = 2  # places beyond a line that are crossings, too
_CLEARLY = 0.5  # of the way from the middle to what light and dark squares are
_STEP, _TIGHT = 0.3, 0.18  # squares to either side of an outer edge, where it is looked at


def pin(grey: ImageArray, pattern: BoardPattern, grid: Grid) -> IntArray | str:
    """[n] the ids of a grid's corners; or why they cannot be known, in words.

    Ids follow the rule for whole boards (`check.arranged`): never mirrored, the outer square beyond
    corner 0 dark where the colours can tell, else columns to the right.
    """
    whole = _Extent.of(grid, 1)
    if not _within(whole.size, pattern):
        return _more(pattern, whole.size)
    wanted = np.array([pattern.columns, pattern.rows])
    ways: list[_Way] = []
    reasons: list[str] = []
    for turns in range(4):
        turned = _turned(grid, turns)
        extent = _Extent.of(turned, LEAST_IN_LINE)
        if (extent.size > wanted).any() or (extent.size < 1).any():
            continue
        first = _first(grey, pattern, turned, extent)
        if isinstance(first, str):
            reasons.append(first)
            continue
        at = turned.cell - first
        if (at < 0).any() or (at >= wanted).any():
            reasons.append("some of its corners lie beyond its white margin: something hides it")
            continue
        dark = bool(first.sum() % 2 == 0) == turned.dark
        ways.append(_Way(at, dark, extent.size))
    if not ways:
        few = f"fewer than {LEAST_IN_LINE} corners of its outer rows and columns can be seen"
        return reasons[0] if reasons else few
    allowed = [way for way in ways if way.dark]
    if not allowed and (ways[0].size < wanted).any():
        # An edge that is taken for the board's own shifts all by a line, which turns the colours.
        return _short(pattern, ways[0].size)
    best = max(allowed or ways, key=lambda way: _upright(grid, way.at))
    return np.asarray(best.at[:, 1] * pattern.columns + best.at[:, 0], np.int64)


@dataclass(frozen=True)
class _Way:
    """One numbering: places on the board [n, 2], and what speaks for it."""

    at: IntArray
    dark: bool  #: whether the outer square beyond corner 0 is
    size: IntArray  #: columns and rows in sight: with fewer than all, an outer edge placed it


@dataclass(frozen=True)
class _Extent:
    """The first and last column and row that hold enough corners."""

    low: IntArray
    high: IntArray

    @property
    def size(self) -> IntArray:
        return np.asarray(self.high - self.low + 1)

    @staticmethod
    def of(grid: Grid, least: int) -> _Extent:
        cell = grid.cell
        while len(cell):
            low, high = cell.min(0), cell.max(0)
            poor = np.zeros(len(cell), np.bool_)
            for line in (low, high):
                on = cell == line
                poor |= (on & (on.sum(0) < least)).any(1)
            if not poor.any():
                return _Extent(low, high)
            cell = cell[~poor]
        return _Extent(np.zeros(2, np.int64), np.full(2, -1))


def _within(size: IntArray, pattern: BoardPattern) -> bool:
    wanted = [pattern.columns, pattern.rows]
    return bool((size <= wanted).all() or (size[::-1] <= wanted).all())


def _turned(grid: Grid, turns: int) -> Grid:
    """The same grid counted from another of its four sides; a quarter turn changes the colours."""
    cell = grid.cell
    for _ in range(turns):
        cell = np.stack([cell[:, 1], -cell[:, 0]], axis=-1)
    return Grid(cell, grid.uv_px, grid.dark ^ bool(turns % 2))


def _first(grey: ImageArray, pattern: BoardPattern, grid: Grid, extent: _Extent) -> IntArray | str:
    """[2] the cell that is the board's corner 0; or why that is not known."""
    out = extent.low.copy()
    wanted = np.array([pattern.columns, pattern.rows])
    missing = wanted - extent.size
    if missing.sum() > 1 or (missing.any() and _fits_turned(extent.size, wanted)):
        return _short(pattern, extent.size)
    for axis in (0, 1):
        ends = [_End.of(grey, grid, extent, axis, way) for way in (-1, 1)]
        if missing[axis]:
            before, after = (end.pins for end in ends)
            if before == after:
                return _short(pattern, extent.size)
            out[axis] -= int(after)
        elif any(end.goes_on >= _GOES_ON_AT for end in ends):
            return _more(pattern, extent.size + (np.arange(2) == axis))
        elif all(end.ends < _ENDS_AT for end in ends):
            what = ("columns", "rows")[axis]
            return (
                f"{wanted[axis]} {what} are in sight, but no white margin on either side of them: "
                "there may be more; show an outer edge of the board"
            )
    return out


def _fits_turned(size: IntArray, wanted: IntArray) -> bool:
    """Whether a grid fits with columns for rows, too, where that is another place."""
    return wanted[0] != wanted[1] and bool((size[::-1] <= wanted).all())


@dataclass(frozen=True)
class _End:
    """What lies beyond an outer line of a grid, counted over the line's corners.

    `seen`: where the outer squares are; of these `goes_on`: with a crossing beyond, `ends`: with
    light on both sides beyond, `white`: the same right at the squares' edge, as a margin is.
    """

    seen: int
    goes_on: int
    ends: int
    white: int

    @property
    def pins(self) -> bool:
        """Whether this is the board's own edge."""
        return self.white >= max(_PINNED_AT, _PINNED_SHARE * self.seen)

    @staticmethod
    def of(grey: ImageArray, grid: Grid, extent: _Extent, axis: int, way: int) -> _End:
        """Beyond the last line of columns (`axis` 0) or rows (1), `way` -1: the first."""
        line = extent.high[axis] if way > 0 else extent.low[axis]
        last = grid.cell[grid.cell[:, axis] == line]
        outward = np.zeros(2, np.int64)
        outward[axis] = way
        beyond = last + outward
        near = grid.near(beyond)
        dark, light = _levels(grey, grid, last)
        seen, white = np.ones(len(last), np.bool_), np.ones(len(last), np.bool_)
        for share in (_TIGHT, _STEP):
            inner, outer = (_steps(axis, side * way, share) for side in (-1, 1))
            here, there = (
                _shade(sample(grey, near.at_steps(step)), dark, light) for step in (inner, outer)
            )
            seen &= (here * grid.lights(beyond, inner) > _CLEARLY).all(1)
            # As light as the board's own squares: the same paper, not a sheet or a glare over it.
            white &= (np.abs(there - 1) < 1 - _CLEARLY).all(1)
            crosses = (there * grid.lights(beyond, outer) > _CLEARLY).all(1)
            ends = (there > 0).all(1)
        return _End(
            int(seen.sum()),
            int((seen & crosses).sum()),
            int((seen & ends).sum()),
            int((seen & white).sum()),
        )


def _shade(level: FloatArray, dark: FloatArray, light: FloatArray) -> FloatArray:
    """Grey levels [n, k] on a scale from -1 as the dark squares [n] to 1 as the light ones."""
    half = np.maximum(light - dark, 1.0)[:, None] / 2
    return np.asarray((level - (light + dark)[:, None] / 2) / half)


def _steps(axis: int, way: int, share: float) -> FloatArray:
    """[2, 2] to the middle of the two squares on one side of a corner, or toward it."""
    step: FloatArray = np.full((2, 2), share)
    step[:, axis] = way * share
    step[0, 1 - axis] = -share
    return step


def _levels(grey: ImageArray, grid: Grid, cell: IntArray) -> tuple[FloatArray, FloatArray]:
    """[n] grey levels of dark and light squares about corners; NaN at the picture's edge."""
    around = quadrants(grey, grid.near(cell))
    pairs = np.stack([around[:, [0, 3]].mean(1), around[:, [1, 2]].mean(1)])
    return np.asarray(pairs.min(0)), np.asarray(pairs.max(0))


def _upright(grid: Grid, at: IntArray) -> float:
    """How far columns run to the right in the picture, or downward: as `check.arranged` has it."""
    place = {(int(c), int(r)): uv for (c, r), uv in zip(at, grid.uv_px, strict=True)}
    steps = [place[c + 1, r] - uv for (c, r), uv in place.items() if (c + 1, r) in place]
    along = np.mean(steps, axis=0) if steps else np.zeros(2)
    return float(along[0] + 1e-3 * along[1])


def _short(pattern: BoardPattern, size: IntArray) -> str:
    """Words for a grid that fits several places."""
    wanted = np.array([pattern.columns, pattern.rows])
    if (size > wanted).any() or (size < size[::-1]).any() != (wanted < wanted[::-1]).any():
        size = size[::-1] if (size[::-1] <= wanted).all() else size
    parts = [
        f"{have} of {all_} {what}"
        for have, all_, what in zip(size, wanted, ("columns", "rows"), strict=True)
        if have < all_
    ]
    return (
        f"{' and '.join(parts)} of the {pattern.columns}x{pattern.rows} board are in sight: which "
        f"ones cannot be known; show the whole width and height ({LEAST_IN_LINE} corners of each "
        "outer row and column at least), others may be hidden"
    )


def _more(pattern: BoardPattern, size: IntArray) -> str:
    return (
        f"the board has more inner corners than {pattern.columns}x{pattern.rows} (at least "
        f"{max(size)}x{min(size)}); correct --pattern"
    )
