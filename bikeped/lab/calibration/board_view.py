"""The board's pattern, where its corners were detected in each image, and why an image is refused.

Pixels have their origin in the middle of the top left pixel (OpenCV's convention), u right, v down.
Texts of refusals are for the person who took the image: what is wrong with it, and what to do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bikeped.types import FloatArray, IntArray


@dataclass(frozen=True)
class BoardPattern:
    """A checkerboard by its inner corners: `columns` x `rows`, squares of `square_m` metres.

    Corner `id` lies in column id % columns and row id // columns. Without a measured square the
    board's own unit (1.0) serves: intrinsics do not depend on it.
    """

    columns: int
    rows: int
    square_m: float = 1.0

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows}"

    @property
    def count(self) -> int:
        return self.columns * self.rows

    def corners_m(self) -> FloatArray:
        """[columns * rows, 3] the flat board's corners by id, z = 0, the middle as origin."""
        column, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        flat = np.stack([column.ravel(), row.ravel(), np.zeros(self.count)], axis=1)
        middle = np.array([(self.columns - 1) / 2, (self.rows - 1) / 2, 0.0])
        out: FloatArray = (flat - middle) * self.square_m
        return out


@dataclass(frozen=True)
class BoardView:
    """One image's corners: `ids` [n] ascending and unique, `uv_px` [n, 2]; n may be partial."""

    name: str  #: the image's path, or `clip.mp4 frame 120`
    ids: IntArray
    uv_px: FloatArray
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class RefusedImage:
    """An image that is not used: its file (or `clip.mp4 frame 120`), and the reason."""

    file: str
    reason: str


@dataclass(frozen=True)
class DetectedBoards:
    """The boards of a set of images of one size, and the images without one."""

    pattern: BoardPattern
    views: Sequence[BoardView]
    refused: Sequence[RefusedImage]
    images: int  #: of the set, refused ones included
    images_hash: str  #: SHA-256 over the images' bytes, in order of name


#: Corners of an outer row or column that identify it: one or two could be something else.
LEAST_IN_LINE = 3


class BoardRefusedError(Exception):
    """No usable board in an image, and why; empty where nothing in it looks like one."""


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
