"""From detections in pixels to points on the ground, by the configured geometry."""

from __future__ import annotations

import numpy as np

from bikeped.config import LoadedConfig, framing, ground_camera
from bikeped.geometry import Framing, GroundTable
from bikeped.types import Detections, GroundPoints


class GroundMapper:
    """The configured camera, its framing and its ground table.

    Raises GeometryError when lens, framing and ground of the configuration do not fit together.
    """

    def __init__(self, loaded: LoadedConfig) -> None:
        self._sensor_framing = framing(loaded)
        self.camera = ground_camera(loaded)
        self.table = GroundTable(
            self.camera, *self._sensor_framing.crop_wh, step_px=loaded.config.camera.table_step_px
        )
        self._max_range_m = loaded.config.tracking.max_range_m
        self._framings: dict[tuple[int, int], Framing] = {}

    def framing_for(self, width: int, height: int) -> Framing:
        """The framing of frames of this size; GeometryError when they are another camera's."""
        known = self._framings.get((width, height))
        if known is None:
            known = self._sensor_framing.for_frame(width, height)
            self._framings = {(width, height): known}
        return known

    def to_ground(self, detections: Detections, frame: Framing) -> tuple[GroundPoints, int]:
        """Ground points within range, and how many detections do not end on the ground."""
        crop = frame.frame_to_crop(detections.bottom_centre_px())
        xy, valid = self.table.lookup(crop)
        near = valid & (np.nan_to_num(np.hypot(xy[:, 0], xy[:, 1]), nan=np.inf) < self._max_range_m)
        index = np.nonzero(near)[0]
        points = GroundPoints(detections.kind[index], xy[index], index.astype(np.int64))
        return points, int((~valid).sum())
