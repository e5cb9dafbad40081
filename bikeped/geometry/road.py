"""Which rows of the picture road users within range can be in: the rest needs no looking at. Pure.

A camera that hangs above everybody's head sees them all below the horizon. Half of its picture is
sky and house fronts, and costs a detector as much as the street.
"""

from __future__ import annotations

import numpy as np

from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.types import Strip

TALLEST_M = 2.5  #: a tall rider on a tall cycle; lorries are cut off where they are higher
MARGIN_DEG = 2.0  #: what pitch and roll of the camera may be off by
_NEAREST_M = 0.3
_BEARINGS, _DISTANCES = 181, 40


def road_strip(camera: GroundCamera, framing: Framing, range_m: float) -> Strip:
    """Rows that hold everybody up to `TALLEST_M` tall and `range_m` away, in all directions.

    Distances are along the ground from below the lens. `MARGIN_DEG` is added above and below. The
    whole picture where nobody would be in it.
    """
    width, height = framing.sensor_w, framing.sensor_h
    bearing = np.linspace(-np.pi, np.pi, _BEARINGS)
    away = np.geomspace(_NEAREST_M, max(range_m, 2 * _NEAREST_M), _DISTANCES)
    tall = np.array([0.0, TALLEST_M / 2, TALLEST_M])
    turn, reach, up = (a.ravel() for a in np.meshgrid(bearing, away, tall, indexing="ij"))
    uv, seen = camera.project(np.stack([reach * np.cos(turn), reach * np.sin(turn), up], axis=1))
    if not seen.any():
        return Strip(0.0, 1.0, width / height)
    row = (uv[seen, 1] - framing.offset_px[1]) / height
    margin = camera.lens.focal_px * np.radians(MARGIN_DEG) / height
    top, bottom = float(np.clip(row.min() - margin, 0, 1)), float(np.clip(row.max() + margin, 0, 1))
    return Strip(top, bottom, width / height)
