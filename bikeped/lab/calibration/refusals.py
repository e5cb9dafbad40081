"""Why an image is not used: every refusal of one image is worded here.

The texts are for the person who took the image: what is wrong with it, and what to do.
"""

from __future__ import annotations

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.types import IntArray

#: Corners of an outer row or column that identify it: one or two could be something else.
LEAST_IN_LINE = 3
IRREGULAR = "its corners make no regular board"
BEYOND_MARGIN = "some of its corners lie beyond its white margin: something hides it"
OUTER_LINES_HIDDEN = f"fewer than {LEAST_IN_LINE} corners of its outer rows and columns can be seen"
OUTSIDE_CROP = "lies outside the square crop"


class BoardRefusedError(Exception):
    """No usable board in an image; `reason` is empty where nothing in it looks like one."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def no_board(pattern: BoardPattern, reason: str) -> str:
    """No detector found a board; `reason`: what is wrong with the best candidate, may be empty."""
    return f"no whole {pattern} board found" + (f": {reason}" if reason else "")


def too_few_corners(count: int, pattern: BoardPattern, least: int | None = None) -> str:
    """Only `count` corners of a board are clear."""
    wanted = "" if least is None else f", not {least}"
    return f"only {count} of {pattern.count} corners can be seen clearly{wanted}"


def larger_board(pattern: BoardPattern, size: IntArray | None = None) -> str:
    """The board has more corners than the pattern; `size` [2]: columns and rows seen."""
    known = "" if size is None else f" (at least {max(size)}x{min(size)})"
    return f"the board has more inner corners than {pattern}{known}; correct --pattern"


def ambiguous_place(pattern: BoardPattern, size: IntArray) -> str:
    """A grid of `size` [2] columns and rows fits several places of the board."""
    wanted = (pattern.columns, pattern.rows)
    columns, rows = int(size[0]), int(size[1])
    too_large = columns > wanted[0] or rows > wanted[1]
    other_shape = (columns != rows) != (wanted[0] != wanted[1])
    if (too_large or other_shape) and rows <= wanted[0] and columns <= wanted[1]:
        columns, rows = rows, columns
    parts = [
        f"{have} of {all_} {what}"
        for have, all_, what in zip((columns, rows), wanted, ("columns", "rows"), strict=True)
        if have < all_
    ]
    return (
        f"{' and '.join(parts)} of the {pattern} board are in sight: which ones cannot be known; "
        f"show the whole width and height ({LEAST_IN_LINE} corners of each outer row and column "
        "at least), others may be hidden"
    )


def no_margin(count: int, axis: int) -> str:
    """All columns (`axis` 0) or rows (1) are in sight, but neither edge of the board."""
    return (
        f"{count} {('columns', 'rows')[axis]} are in sight, but no white margin on either side of "
        "them: there may be more; show an outer edge of the board"
    )


def outer_line_missing(pattern: BoardPattern) -> str:
    """No image of the set shows all four outer lines of the pattern.

    A board of 7x6 corners whose far edge is out of sight looks like one of 8x6 that lacks a column.
    """
    return (
        f"a row or column of {pattern} corners is out of sight, and no other picture shows all of "
        "them; take one that does, or correct --pattern"
    )


def blurred(edge_px: float, usual_px: float) -> str:
    """Edges are `edge_px` wide, against the set's usual width."""
    return (
        f"blurred: its edges are {edge_px:.1f} px wide (usual here: {usual_px:.1f}); take it again "
        "with the board held still"
    )


def duplicate(file: str) -> str:
    """The same image as an earlier one."""
    return f"same picture as {file}"


def not_moved(file: str) -> str:
    """A video's frame in which the board stands where it stood before."""
    return f"the board has not moved since {file}"


def contradicts_others(off_px: float) -> str:
    """Most corners are off under the lens that the other boards give."""
    return f"its corners do not fit the other boards (median {off_px:.1f} px off)"
