"""Which corners of a board a grid holds: whatever is hidden, every way round, and never a guess."""

from __future__ import annotations

import cv2
import numpy as np
from calibration_scenes import refusal_of
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.lab.calibration.board_view import BoardPattern, BoardRefusedError
from bikeped.lab.calibration.corners.corner_ids import LEAST_IN_LINE, assign_corner_ids
from bikeped.lab.calibration.corners.grid_growing import CornerGrid
from bikeped.types import BoolArray, ImageArray, IntArray

SIDE = 12


def picture(columns: int, rows: int) -> ImageArray:
    """A board seen straight on: squares of SIDE pixels, the first dark, and a white margin."""
    squares = np.indices((rows + 1, columns + 1)).sum(0) % 2 * 180 + 40
    large = np.kron(squares, np.ones((SIDE, SIDE)))
    out = np.pad(large, SIDE, constant_values=220).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(out, (0, 0), 0.6), np.uint8)


def grid_of(
    pattern: BoardPattern, keep: BoolArray, turns: int, shift: tuple[int, int]
) -> CornerGrid:
    """The corners [rows, columns] to keep, counted from anywhere and from any side."""
    row, column = np.nonzero(keep)
    place = np.stack([column, row], axis=-1).astype(np.int64)
    uv = (place + 2.0) * SIDE - 0.5
    cell, dark = place, True
    for _ in range(turns):
        cell, dark = np.stack([cell[:, 1], -cell[:, 0]], axis=-1), not dark
    moved = cell + np.array(shift)
    return CornerGrid(moved, uv, dark if sum(shift) % 2 == 0 else not dark)


def truth(pattern: BoardPattern, keep: BoolArray) -> IntArray:
    return np.flatnonzero(keep.ravel()).astype(np.int64)


def numbered(answer: IntArray, pattern: BoardPattern, keep: BoolArray) -> bool:
    """Whether the ids are right, or right for a board that looks the same turned by half."""
    ids = truth(pattern, keep)
    turned = (pattern.columns + pattern.rows) % 2 == 0
    return bool((answer == ids).all() or (turned and (answer == pattern.count - 1 - ids).all()))


patterns = st.sampled_from([BoardPattern(8, 6), BoardPattern(7, 6), BoardPattern(5, 9)])


@given(
    pattern=patterns,
    turns=st.integers(0, 3),
    shift=st.tuples(st.integers(-9, 9), st.integers(-9, 9)),
    holes=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), max_size=14),
)
@settings(max_examples=60, deadline=None)
def test_ids_are_right_or_none(
    pattern: BoardPattern, turns: int, shift: tuple[int, int], holes: list[tuple[int, int]]
) -> None:
    """Whatever is hidden of a board in a clear picture, its corners get their own numbers; only an
    outer line of which fewer than three corners are seen may cost them."""
    keep = np.ones((pattern.rows, pattern.columns), np.bool_)
    for column, row in holes:
        keep[row % pattern.rows, column % pattern.columns] = False
    lines = (keep[0], keep[-1], keep[:, 0], keep[:, -1])
    try:
        answer = assign_corner_ids(
            picture(pattern.columns, pattern.rows), pattern, grid_of(pattern, keep, turns, shift)
        )
    except BoardRefusedError:
        assert any(line.sum() < LEAST_IN_LINE for line in lines)
    else:
        assert numbered(answer, pattern, keep)


@given(turns=st.integers(0, 3), first=st.booleans(), rows=st.booleans())
@settings(max_examples=16, deadline=None)
def test_one_hidden_line_is_told_by_the_margin_on_the_other_side(
    turns: int, first: bool, rows: bool
) -> None:
    for pattern in (BoardPattern(8, 6), BoardPattern(9, 6)):
        keep = np.ones((pattern.rows, pattern.columns), np.bool_)
        grey = picture(pattern.columns, pattern.rows)
        # The line and all beyond it lie behind something dark.
        at = int(2.5 * SIDE)
        hidden = slice(0, at) if first else slice(-at, None)
        if rows:
            keep[0 if first else -1] = False
            grey[hidden] = 60
        else:
            keep[:, 0 if first else -1] = False
            grey[:, hidden] = 60
        assert numbered(
            assign_corner_ids(grey, pattern, grid_of(pattern, keep, turns, (0, 0))), pattern, keep
        )


def test_an_ambiguous_place_is_refused_with_the_reason() -> None:
    pattern = BoardPattern(8, 6)
    keep = np.ones((6, 8), np.bool_)
    keep[:, 7] = False
    dark = picture(8, 6)
    dark[:, :SIDE] = dark[:, -2 * SIDE :] = 60  # no margin on either side
    words = refusal_of(assign_corner_ids, dark, pattern, grid_of(pattern, keep, 0, (0, 0)))
    assert words.startswith("7 of 8 columns of the 8x6 board are in sight: which ones cannot be")
    keep[5] = False
    words = refusal_of(assign_corner_ids, picture(8, 6), pattern, grid_of(pattern, keep, 1, (0, 0)))
    assert words.startswith("7 of 8 columns and 5 of 6 rows of the 8x6 board are in sight")
    # Six by six: are these rows or columns?
    keep = np.ones((6, 8), np.bool_)
    keep[:, :2] = False
    words = refusal_of(assign_corner_ids, picture(8, 6), pattern, grid_of(pattern, keep, 0, (0, 0)))
    assert words.startswith("6 of 8 columns of the 8x6 board are in sight")


def test_a_margin_on_the_wrong_side_shows_in_the_colours() -> None:
    """A white sheet along the second column looks like an edge, but there the corner is light."""
    pattern = BoardPattern(8, 6)
    keep = np.ones((6, 8), np.bool_)
    keep[:, 0] = False
    grey = picture(8, 6)
    grey[:, : 2 * SIDE] = 220
    grey[:, -SIDE:] = 60  # the true margin opposite is out of sight
    assert refusal_of(assign_corner_ids, grey, pattern, grid_of(pattern, keep, 0, (0, 0)))


def test_a_board_with_more_corners_is_named() -> None:
    larger = BoardPattern(9, 7)
    keep = np.ones((7, 9), np.bool_)
    keep[2:5, 3] = False
    words = refusal_of(
        assign_corner_ids, picture(9, 7), BoardPattern(8, 6), grid_of(larger, keep, 0, (3, 2))
    )
    assert "more inner corners than 8x6 (at least 9x7)" in words
    # Eight of its nine columns and six of its seven rows: the picture shows that it goes on.
    keep[:, 8] = keep[6] = False
    words = refusal_of(
        assign_corner_ids, picture(9, 7), BoardPattern(8, 6), grid_of(larger, keep, 0, (0, 0))
    )
    assert "more inner corners than 8x6" in words


def test_a_floor_of_squares_is_no_board() -> None:
    """Eight by six corners, with squares and nothing white on all sides."""
    grey = picture(12, 10)
    keep = np.zeros((10, 12), np.bool_)
    keep[2:8, 2:10] = True
    grid = grid_of(BoardPattern(12, 10), keep, 0, (0, 0))
    assert refusal_of(assign_corner_ids, grey, BoardPattern(8, 6), grid)
    grey[: 3 * SIDE] = grey[-3 * SIDE :] = 60
    grey[:, : 3 * SIDE] = grey[:, -3 * SIDE :] = 60
    words = refusal_of(
        assign_corner_ids, grey, BoardPattern(8, 6), grid_of(BoardPattern(12, 10), keep, 0, (0, 0))
    )
    assert "no white margin on either side" in words
