"""Detectors on the picture as it is, cheapest first: classic at several scales, then sector-based.

Each candidate is all corners of the pattern, row by row, in pixels of the full picture and about a
pixel good (a few at worst): `corners.py` checks and refines them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.types import FloatArray, ImageArray

Detector = Callable[[ImageArray, BoardPattern], "FloatArray | None"]

#: Longest side at which a picture is looked at first; larger ones are made smaller.
FIRST_SIDE_PX = 1100
_SCALES = (1.0, 0.5, 2.0, 0.35)  # of that; twice only while the result stays below _LARGEST
_SECTOR_SCALES = (0.5, 1.0)
_LARGEST_PX = 2300
_QUICK_PX = 640


def raw_candidates(grey: ImageArray, pattern: BoardPattern) -> Iterator[FloatArray]:
    """What the detectors find, one after the other, cheapest first; computed as it is asked for."""
    first = min(1.0, FIRST_SIDE_PX / max(grey.shape))
    for detector, scales in ((classic, _SCALES), (sectors, _SECTOR_SCALES)):
        for scale in scales:
            if scale > 1 and max(grey.shape) * first * scale > _LARGEST_PX:
                continue
            found = at_scale(detector, grey, pattern, first * scale)
            if found is not None:
                yield found
    if first < 1.0:
        found = at_scale(classic, grey, pattern, min(1.0, 2 * first))
        if found is not None:
            yield found


def quick_candidates(grey: ImageArray, pattern: BoardPattern) -> Iterator[FloatArray]:
    """For live frames, most of which hold no board: small and with a quick way out, then full."""
    for side in (_QUICK_PX, FIRST_SIDE_PX):
        found = at_scale(in_a_hurry, grey, pattern, min(1.0, side / max(grey.shape)))
        if found is not None:
            yield found


def at_scale(
    detector: Detector, grey: ImageArray, pattern: BoardPattern, scale: float
) -> FloatArray | None:
    """What a detector finds on the picture made `scale` times as large, in full pixels [n, 2]."""
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    if size == (grey.shape[1], grey.shape[0]):
        return detector(grey, pattern)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    found = detector(np.asarray(cv2.resize(grey, size, interpolation=how), np.uint8), pattern)
    if found is None:
        return None
    ratio = np.array([grey.shape[1] / size[0], grey.shape[0] / size[1]])
    return np.asarray((found + 0.5) * ratio - 0.5)


def classic(grey: ImageArray, pattern: BoardPattern) -> FloatArray | None:
    """OpenCV's search for dark quadrangles: a few milliseconds where it succeeds."""
    return _corners(
        cv2.findChessboardCorners(
            grey, (pattern.columns, pattern.rows), flags=cv2.CALIB_CB_ADAPTIVE_THRESH
        ),
        pattern,
    )


def in_a_hurry(grey: ImageArray, pattern: BoardPattern) -> FloatArray | None:
    """As `classic`, but gives up where the picture does not look as if it held a board."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK
    size = (pattern.columns, pattern.rows)
    return _corners(cv2.findChessboardCorners(grey, size, flags=flags), pattern)


def sectors(grey: ImageArray, pattern: BoardPattern) -> FloatArray | None:
    """OpenCV's sector-based search (Duda and Frese, 2018): slower, stands blur and poor light."""
    return _corners(
        cv2.findChessboardCornersSB(
            grey, (pattern.columns, pattern.rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
        ),
        pattern,
    )


def _corners(answer: object, pattern: BoardPattern) -> FloatArray | None:
    found, corners = answer if isinstance(answer, tuple) else (False, None)
    if not found or corners is None or len(corners) != pattern.count:
        return None
    out = np.asarray(corners, np.float64).reshape(-1, 2)
    return out if np.isfinite(out).all() else None
