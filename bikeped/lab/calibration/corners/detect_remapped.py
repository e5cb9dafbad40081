"""Detectors on views with straight edges: the paper's perspective remapping, and a wide one.

Before the lens is known an equidistant one is assumed, whose field of 190 degrees fills the longer
side of the picture. That is wrong by ten or twenty per cent and good enough: edges become straight
enough to be found, and corners are mapped back and refined on the original.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.corners.detect_raw import at_scale, classic, sectors
from bikeped.lab.calibration.synthetic import turn
from bikeped.types import Float32Array, FloatArray, ImageArray

_ASSUMED_HALF_RAD = math.radians(95.0)
_SIDE_PX = 800
_RING_DEG = 50.0
_RING = 8
_NO_MAP: Any = None  # the map holds both coordinates; the type stubs want an array


@dataclass(frozen=True)
class Gaze:
    """One remapped view: where it looks (degrees from the axis, and round it), how wide, and how.

    `wide`: stereographic, which keeps squares square however far they are from its middle, instead
    of perspective, which keeps edges straight.
    """

    away_deg: float
    round_deg: float
    width_deg: float
    wide: bool = False


#: In order of cost and use: close boards fill wide views, far and slanting ones sit in narrow ones.
GAZES = (
    Gaze(0, 0, 110),
    Gaze(0, 0, 140),
    Gaze(0, 0, 180, wide=True),
    *(Gaze(_RING_DEG, 360 / _RING * k, 90) for k in range(_RING)),
    *(Gaze(35, 360 / _RING * (k + 0.5), 125) for k in range(0, _RING, 2)),
    *(Gaze(60, 360 / _RING * k, 150, wide=True) for k in range(0, _RING, 2)),
)


def remapped_candidates(grey: ImageArray, pattern: BoardPattern) -> Iterator[FloatArray]:
    """What the classic detector, then the sector-based one, finds in the remapped views."""
    for detector in (classic, sectors):
        for gaze in GAZES if detector is classic else GAZES[:3]:
            at = positions(gaze, grey.shape[1], grey.shape[0])
            view = cv2.remap(grey, at, _NO_MAP, cv2.INTER_LINEAR)
            found = at_scale(detector, np.asarray(view, np.uint8), pattern, 1.0)
            if found is not None:
                yield _back(found, at)


def positions(gaze: Gaze, width: int, height: int) -> Float32Array:
    """[side, side, 2] the picture's pixels under those of the remapped view."""
    half = math.radians(gaze.width_deg) / 2
    step = np.linspace(-1, 1, _SIDE_PX)
    x, y = np.meshgrid(step, step)
    if gaze.wide:
        radius = np.hypot(x, y)
        angle = 2 * np.arctan(radius * math.tan(half / 2))
        scale = np.sin(angle) / np.maximum(radius, 1e-12)
        ray = np.stack([scale * x, scale * y, np.cos(angle)], axis=-1)
    else:
        reach = math.tan(half)
        ray = np.stack([x * reach, y * reach, np.ones_like(x)], axis=-1)
    away, about = math.radians(gaze.away_deg), math.radians(gaze.round_deg)
    # Turned about the axis at right angles to where it looks: the view stays upright.
    ray = ray @ turn([-away * math.sin(about), away * math.cos(about), 0.0]).T
    side = np.hypot(ray[..., 0], ray[..., 1])
    focal = max(width, height) / 2 / _ASSUMED_HALF_RAD
    scale = focal * np.arctan2(side, ray[..., 2]) / np.maximum(side, 1e-12)
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    return np.asarray(ray[..., :2] * scale[..., None] + middle, np.float32)


def _back(found: FloatArray, at: Float32Array) -> FloatArray:
    u, v = (found[:, k].astype(np.float32)[:, None] for k in (0, 1))
    sides = [cv2.remap(np.ascontiguousarray(at[..., k]), u, v, cv2.INTER_LINEAR) for k in (0, 1)]
    return np.stack([np.asarray(side, np.float64).ravel() for side in sides], axis=-1)
