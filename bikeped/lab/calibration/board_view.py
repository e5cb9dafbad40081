"""The board's pattern, and where its corners were detected in each image.

Pixels have their origin in the middle of the top left pixel (OpenCV's convention), u right, v down.
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

    def __post_init__(self) -> None:
        if self.uv_px.shape != (len(self.ids), 2):
            raise ValueError(
                f"BoardView.uv_px: expected shape ({len(self.ids)}, 2), got {self.uv_px.shape}"
            )

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
