"""Small copies of a picture that keep what picture health is judged by.

Only about 160 whole rows are read, in the green channel: an 8-megapixel picture costs no more than
a small one, and edges keep their sharpness along the rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from bikeped.types import BoolArray, Float32Array, ImageArray

TILE = 8  #: pixels of `Reduced.coarse` that a tile is wide and high
_COARSE = 160  #: its longer side
_ROWS = 160
_WIDTH = 960  #: about as wide as the detector sees the picture
_MIN_PX = 48

#: The image circle: centre u, v and radius as shares of the picture's width, height and width.
Circle = tuple[float, float, float]


@dataclass(frozen=True)
class Reduced:
    """`lines` [160 to 320, at most 1440]: rows with their edges. `coarse` [8 m, 8 n]: the whole
    picture, 160 pixels long. Both uint8, green."""

    lines: ImageArray
    coarse: ImageArray


def usable(rgb: ImageArray) -> bool:
    """Whether this is a picture [h, w, 3] large enough to judge."""
    colours = rgb.ndim == 3 and rgb.shape[2] == 3 and rgb.dtype == np.uint8
    return colours and min(rgb.shape[:2]) >= _MIN_PX


def reduce(rgb: ImageArray) -> Reduced:
    """The reduced copies of a usable picture [h, w, 3] uint8."""
    height, width = rgb.shape[:2]
    step = max(1, height // _ROWS)
    # The row step is a view: OpenCV reads the rows that it needs and no others.
    green = cv2.extractChannel(np.asarray(rgb[step // 2 :: step]), 1)
    across = width // max(1, round(width / _WIDTH))
    # At half the width, linear is the mean of two; OpenCV's mean of an area is slow.
    lines = cv2.resize(green, (across, green.shape[0]), interpolation=cv2.INTER_LINEAR)
    rows, columns = tile_grid(height, width)
    whole = max(1, across // (columns * TILE))
    narrow = np.asarray(lines[:, : across // whole * whole])
    narrow = cv2.resize(narrow, (across // whole, len(lines)), interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(narrow, (columns * TILE, rows * TILE), interpolation=cv2.INTER_AREA)
    return Reduced(np.asarray(lines, np.uint8), np.asarray(coarse, np.uint8))


def tile_grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of tiles of a picture of this size."""
    scale = min(1.0, _COARSE / max(height, width)) / TILE
    return max(2, int(height * scale)), max(2, int(width * scale))


def tiles(coarse: Float32Array) -> Float32Array:
    """A coarse picture [8 m, 8 n] as tiles [m, n, 64]."""
    rows, columns = coarse.shape[0] // TILE, coarse.shape[1] // TILE
    cut = coarse.reshape(rows, TILE, columns, TILE).swapaxes(1, 2)
    return cut.reshape(rows, columns, TILE * TILE)


@lru_cache(maxsize=4)
def inside(rows: int, columns: int, circle: Circle | None, aspect: float) -> BoolArray:
    """Which cells of a grid [rows, columns] over the picture lie wholly inside the image circle.

    `aspect`: the picture's width over its height. All, where there is no circle or nothing in it.
    """
    found: BoolArray = np.ones((rows, columns), np.bool_)
    if circle is None:
        return found
    u, v, radius = circle
    x = np.abs((np.arange(columns) + 0.5) / columns - u) + 0.5 / columns
    y = (np.abs((np.arange(rows) + 0.5) / rows - v) + 0.5 / rows) / aspect
    within = np.hypot(x[None], y[:, None]) < radius
    return within if within.any() else found
