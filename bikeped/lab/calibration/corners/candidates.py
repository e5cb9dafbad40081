"""Candidate boards by OpenCV's detectors, cheapest first, on the raw and on remapped images.

Each candidate is every corner of the pattern, row by row, in pixels of the full image, accurate to
about a pixel (a few at worst): `board_check` checks and refines them.

The remapped views have straight edges (the paper's perspective remapping) or keep squares square
(stereographic). The lens is not known yet, so the equidistant `assumed_lens` stands in for it. It
is wrong by ten or twenty per cent, which is good enough to find corners.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.types import Float32Array, FloatArray, ImageArray

Detector = Callable[[ImageArray, BoardPattern], "FloatArray | None"]

#: Longest side in pixels at which an image is searched first; larger images are scaled down.
FIRST_SIDE_PX = 1100
#: An image is scaled up only while its longest side stays below this.
LARGEST_SIDE_PX = 2300
_SCALES = (1.0, 0.5, 2.0, 0.35)  # relative to the first scale
_SECTOR_SCALES = (0.5, 1.0)
_QUICK_SIDE_PX = 640
_VIEW_SIDE_PX = 800
_RING = 8
_NO_MAP: Any = None  # the map holds both coordinates; the type stubs want an array


@dataclass(frozen=True)
class ViewDirection:
    """One remapped view: its direction from the optical axis and around it, and its field.

    `stereographic` keeps squares square far from the middle; perspective keeps edges straight.
    """

    polar_deg: float
    azimuth_deg: float
    width_deg: float
    stereographic: bool = False


#: In order of cost and use: near boards fill wide views, far and slanting ones narrow views.
VIEWS = (
    ViewDirection(0, 0, 110),
    ViewDirection(0, 0, 140),
    ViewDirection(0, 0, 180, stereographic=True),
    *(ViewDirection(50, 360 / _RING * k, 90) for k in range(_RING)),
    *(ViewDirection(35, 360 / _RING * (k + 0.5), 125) for k in range(0, _RING, 2)),
    *(ViewDirection(60, 360 / _RING * k, 150, stereographic=True) for k in range(0, _RING, 2)),
)


def assumed_lens(width: int, height: int) -> tuple[Lens, tuple[float, float]]:
    """Equidistant lens of 190 degrees across the longer side, and its centre (u, v) in pixels."""
    half = math.radians(95.0)
    lens = Lens("equidistant", max(width, height) / 2 / half, half)
    return lens, ((width - 1) / 2, (height - 1) / 2)


def raw_candidates(grey: ImageArray, pattern: BoardPattern) -> Iterator[FloatArray]:
    """[columns * rows, 2] corners of each candidate on the image itself, computed on demand."""
    first = first_scale(grey)
    for detector, scales in ((classic, _SCALES), (sectors, _SECTOR_SCALES)):
        for scale in scales:
            if scale > 1 and max(grey.shape) * first * scale > LARGEST_SIDE_PX:
                continue
            yield from at_scale(detector, grey, pattern, first * scale)
    if first < 1.0:
        yield from at_scale(classic, grey, pattern, min(1.0, 2 * first))


def remapped_candidates(grey: ImageArray, pattern: BoardPattern) -> Iterator[FloatArray]:
    """The same on the remapped views: by the classic detector, then by the sector-based one."""
    for detector in (classic, sectors):
        for view in VIEWS if detector is classic else VIEWS[:3]:
            uv_px = view_pixels(view, grey.shape[1], grey.shape[0])
            remapped = cv2.remap(grey, uv_px, _NO_MAP, cv2.INTER_LINEAR)
            found = detector(np.asarray(remapped, np.uint8), pattern)
            if found is not None:
                yield _to_image(found, uv_px)


def quick_candidates(grey: ImageArray, pattern: BoardPattern) -> Iterator[FloatArray]:
    """For live frames, most of which hold no board: the fast check at two scales only."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_FAST_CHECK
    for side in (_QUICK_SIDE_PX, FIRST_SIDE_PX):
        scale = min(1.0, side / max(grey.shape))
        yield from at_scale(functools.partial(classic, flags=flags), grey, pattern, scale)


def first_scale(grey: ImageArray) -> float:
    """The scale at which an image is searched first, at most 1."""
    return min(1.0, FIRST_SIDE_PX / max(grey.shape))


def resized(
    grey: ImageArray, scale: float
) -> tuple[ImageArray, Callable[[FloatArray], FloatArray]]:
    """The image `scale` times as large, and a function from its pixels to the full image's."""
    size = max(1, round(grey.shape[1] * scale)), max(1, round(grey.shape[0] * scale))
    if size == (grey.shape[1], grey.shape[0]):
        return grey, lambda uv_px: uv_px
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    factors = np.array([grey.shape[1] / size[0], grey.shape[0] / size[1]])
    small = np.asarray(cv2.resize(grey, size, interpolation=how), np.uint8)
    return small, lambda uv_px: np.asarray((uv_px + 0.5) * factors - 0.5)


def at_scale(
    detector: Detector, grey: ImageArray, pattern: BoardPattern, scale: float
) -> Iterator[FloatArray]:
    """What a detector finds on the image `scale` times as large, in full pixels [n, 2], if any."""
    small, to_full = resized(grey, scale)
    found = detector(small, pattern)
    if found is not None:
        yield to_full(found)


def classic(
    grey: ImageArray, pattern: BoardPattern, flags: int = cv2.CALIB_CB_ADAPTIVE_THRESH
) -> FloatArray | None:
    """OpenCV's search for dark quadrangles: a few milliseconds where it succeeds."""
    size = (pattern.columns, pattern.rows)
    return _corners(cv2.findChessboardCorners(grey, size, flags=flags), pattern)


def sectors(grey: ImageArray, pattern: BoardPattern) -> FloatArray | None:
    """OpenCV's sector-based search (Duda and Frese, 2018): slower, robust to blur, poor light."""
    size, flags = (pattern.columns, pattern.rows), cv2.CALIB_CB_NORMALIZE_IMAGE
    return _corners(cv2.findChessboardCornersSB(grey, size, flags=flags), pattern)


def view_pixels(view: ViewDirection, width: int, height: int) -> Float32Array:
    """[side, side, 2] the image's pixel under each pixel of a remapped view."""
    half = math.radians(view.width_deg) / 2
    step = np.linspace(-1, 1, _VIEW_SIDE_PX)
    x, y = np.meshgrid(step, step)
    if view.stereographic:
        radius = np.hypot(x, y)
        angle = 2 * np.arctan(radius * math.tan(half / 2))
        scale = np.sin(angle) / np.maximum(radius, 1e-12)
        ray = np.stack([scale * x, scale * y, np.cos(angle)], axis=-1)
    else:
        reach = math.tan(half)
        ray = np.stack([x * reach, y * reach, np.ones_like(x)], axis=-1)
    polar, azimuth = math.radians(view.polar_deg), math.radians(view.azimuth_deg)
    # Turned about the axis at right angles to its direction: the view stays upright.
    turn, _ = cv2.Rodrigues(np.array([-math.sin(azimuth), math.cos(azimuth), 0.0]) * polar)
    ray = ray @ np.asarray(turn).T
    lens, centre = assumed_lens(width, height)
    side = np.hypot(ray[..., 0], ray[..., 1])
    scale = lens.focal_px * np.arctan2(side, ray[..., 2]) / np.maximum(side, 1e-12)
    return np.asarray(ray[..., :2] * scale[..., None] + np.array(centre), np.float32)


def _to_image(corners: FloatArray, uv_px: Float32Array) -> FloatArray:
    """[n, 2] positions in a remapped view as pixels of the image."""
    u, v = (corners[:, k].astype(np.float32)[:, None] for k in (0, 1))
    sides = [cv2.remap(np.ascontiguousarray(uv_px[..., k]), u, v, cv2.INTER_LINEAR) for k in (0, 1)]
    return np.stack([np.asarray(side, np.float64).ravel() for side in sides], axis=-1)


def _corners(answer: object, pattern: BoardPattern) -> FloatArray | None:
    found, corners = answer if isinstance(answer, tuple) else (False, None)
    if not found or corners is None or len(corners) != pattern.count:
        return None
    out = np.asarray(corners, np.float64).reshape(-1, 2)
    return out if np.isfinite(out).all() else None
