"""Which part of the picture road users within range can be in: the rest needs no looking at. Pure.

A camera that hangs above everybody's head sees them all below the horizon. Half of its picture is
sky and house fronts, and beside the image circle it is black: both cost a detector as much as the
street does.
"""

from __future__ import annotations

import numpy as np

from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.types import Region

TALLEST_M = 2.5  #: a tall rider on a tall cycle; lorries are cut off where they are higher
MARGIN_DEG = 2.0  #: what pitch and roll of the camera may be off by
_NEAREST_M = 0.3
_BEARINGS, _DISTANCES = 721, 40


def road_region(camera: GroundCamera, framing: Framing, range_m: float) -> Region:
    """The rectangle with everybody up to `TALLEST_M` tall and `range_m` away, in all directions.

    Distances are along the ground from below the lens. `MARGIN_DEG` is added on every side, as far
    as the lens reaches. The whole picture where nobody would be in it.
    """
    size = np.array([framing.sensor_w, framing.sensor_h], np.float64)
    aspect = framing.sensor_w / framing.sensor_h
    bearing = np.linspace(-np.pi, np.pi, _BEARINGS)
    away = np.geomspace(_NEAREST_M, max(range_m, 2 * _NEAREST_M), _DISTANCES)
    tall = np.array([0.0, TALLEST_M / 2, TALLEST_M])
    turn, reach, up = (a.ravel() for a in np.meshgrid(bearing, away, tall, indexing="ij"))
    uv, _ = camera.project(np.stack([reach * np.cos(turn), reach * np.sin(turn), up], axis=1))
    margin = camera.lens.focal_px * np.radians(MARGIN_DEG)
    axis, rim = np.array([camera.cx, camera.cy]), camera.lens.max_radius_px
    # Also beside the lens, where a wide one still sees: `project` calls only those before it seen.
    seen = np.hypot(*(uv - axis).T) < rim * (1 - 1e-9)
    if camera.window_px is not None:
        low, high = np.array(camera.window_px[:2]), np.array(camera.window_px[2:])
        seen &= ((uv >= low) & (uv < high)).all(axis=1)
    if not seen.any():
        return Region(0.0, 0.0, 1.0, 1.0, aspect)
    low = np.maximum(uv[seen].min(axis=0) - margin, axis - rim)
    high = np.minimum(uv[seen].max(axis=0) + margin, axis + rim)
    offset = np.asarray(framing.offset_px, np.float64)
    left, top = np.clip((low - offset) / size, 0, 1).tolist()
    right, bottom = np.clip((high - offset) / size, 0, 1).tolist()
    return Region(left, top, right, bottom, aspect)
