"""The part of the image in which road users within range can appear. Pure.

A camera above head height sees them below the horizon. Half of its image is sky and house fronts,
and outside the image circle it is black: both cost a detector as much time as the street does.
"""

from __future__ import annotations

import numpy as np

from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.types import Region

MAX_HEIGHT_M = 2.5  #: of a rider on a cycle; higher vehicles are cut off
MARGIN_DEG = 2.0  #: for errors of the camera's pitch and roll
_NEAREST_M = 0.3
_BEARINGS, _DISTANCES = 721, 40


def road_region(camera: GroundCamera, framing: Framing, range_m: float) -> Region:
    """The rectangle of all points up to `MAX_HEIGHT_M` high and `range_m` away from the pole.

    `MARGIN_DEG` is added on every side, up to the image circle. The whole frame where no such point
    is visible.
    """
    size = np.array([framing.sensor_w, framing.sensor_h], np.float64)
    aspect = framing.sensor_w / framing.sensor_h
    bearing = np.linspace(-np.pi, np.pi, _BEARINGS)
    away = np.geomspace(_NEAREST_M, max(range_m, 2 * _NEAREST_M), _DISTANCES)
    tall = np.array([0.0, MAX_HEIGHT_M / 2, MAX_HEIGHT_M])
    turn, reach, up = (a.ravel() for a in np.meshgrid(bearing, away, tall, indexing="ij"))
    uv, _ = camera.project(np.stack([reach * np.cos(turn), reach * np.sin(turn), up], axis=1))
    margin = camera.lens.focal_px * np.radians(MARGIN_DEG)
    axis, rim = np.array([camera.cx, camera.cy]), camera.lens.max_radius_px
    # Also behind the lens plane, which a wide lens sees and `project` calls not visible.
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
