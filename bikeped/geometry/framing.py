"""Sensor frame, padded square, crop, scaled recordings of it, and its part with the road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.types import FloatArray, Region

MAX_HEIGHT_M = 2.5  #: of a rider on a cycle; higher vehicles are cut off
MARGIN_DEG = 2.0  #: for errors of the camera's pitch and roll
_NEAREST_M = 0.3
_BEARINGS, _DISTANCES = 721, 40


@dataclass(frozen=True)
class Framing:
    """Position of a frame in the crop whose pixels the calibration uses.

    The sensor image (`sensor_w` x `sensor_h`) is centred in a black square of side `pad_size`,
    whose middle square of side `crop_size` is the crop. None leaves a step out. A frame may be a
    scaled copy of the sensor image (a smaller recording): `scale` is sensor over frame pixels.
    """

    sensor_w: int
    sensor_h: int
    pad_size: int | None = None
    crop_size: int | None = None
    scale: float = 1.0

    def __post_init__(self) -> None:
        longest, (width, height) = max(self.sensor_w, self.sensor_h), self._padded
        if self.pad_size is not None and self.pad_size < longest:
            raise GeometryError(
                f"camera.pad_size: {self.pad_size} is smaller than the sensor "
                f"({self.sensor_w} x {self.sensor_h}); use at least {longest}"
            )
        if self.crop_size is not None and self.crop_size > min(width, height):
            raise GeometryError(
                f"camera.crop_size: {self.crop_size} is larger than the frame it is cut from "
                f"({width} x {height}); lower it or raise camera.pad_size"
            )

    @property
    def _padded(self) -> tuple[int, int]:
        side = self.pad_size
        return (self.sensor_w, self.sensor_h) if side is None else (side, side)

    @property
    def crop_wh(self) -> tuple[int, int]:
        """Width and height of the crop, in sensor pixels."""
        return self._padded if self.crop_size is None else (self.crop_size, self.crop_size)

    @property
    def offset_px(self) -> tuple[int, int]:
        """Sensor pixel (0, 0) in the crop."""
        (pw, ph), (cw, ch) = self._padded, self.crop_wh
        left, top = (pw - self.sensor_w) // 2, (ph - self.sensor_h) // 2
        return left - (pw - cw) // 2, top - (ph - ch) // 2

    @property
    def window_px(self) -> tuple[float, float, float, float]:
        """The part of the crop that exists on the sensor: u0, v0, u1, v1, end exclusive."""
        (ox, oy), (cw, ch) = self.offset_px, self.crop_wh
        right, low = min(ox + self.sensor_w, cw), min(oy + self.sensor_h, ch)
        return float(max(ox, 0)), float(max(oy, 0)), float(right), float(low)

    def for_frame(self, frame_w: int, frame_h: int) -> Framing:
        """The framing of frames of this size, scaled copies of the sensor image.

        Raises GeometryError when the proportions differ: the frame is from another camera.
        """
        scale = self.sensor_w / frame_w
        if abs(frame_h * scale - self.sensor_h) > scale + 1e-9:
            raise GeometryError(
                f"camera.width, camera.height: frames are {frame_w} x {frame_h}, the configuration "
                f"says {self.sensor_w} x {self.sensor_h}, of other proportions; set them (and "
                "pad_size, crop_size) to the camera that made the frames"
            )
        return Framing(self.sensor_w, self.sensor_h, self.pad_size, self.crop_size, scale)

    def frame_to_crop(self, uv_px: npt.ArrayLike) -> FloatArray:
        """Frame pixels [..., 2] in the crop."""
        return np.asarray(np.asarray(uv_px, np.float64) * self.scale + self.offset_px)

    def crop_to_frame(self, uv_px: npt.ArrayLike) -> FloatArray:
        """Crop pixels [..., 2] in the frame."""
        return (np.asarray(uv_px, np.float64) - self.offset_px) / self.scale


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
    left, top = np.clip((low - framing.offset_px) / size, 0, 1).tolist()
    right, bottom = np.clip((high - framing.offset_px) / size, 0, 1).tolist()
    return Region(left, top, right, bottom, aspect)
