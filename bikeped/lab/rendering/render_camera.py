"""The camera that draws: the lens, framing and pose that the device maps boxes to the ground with.

Pixels of a picture are measured from its edges: the middle of the first pixel is at (0.5, 0.5),
as boxes and `Framing` have it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np

from bikeped.config.build import framing, ground_camera
from bikeped.config.load import LoadedConfig
from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.geometry.lens import Lens
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.types import BoolArray, Float32Array, FloatArray

#: Where the paper's simulation camera stands: south of the crossing, looking north.
DEFAULT_POSE = CameraPose(5.0, -13.0, 90.0)
_LATTICE_PX = 4


@dataclass(frozen=True)
class SceneCamera:
    """Lens above ground, its framing for pictures of `size` (width, height), its pose."""

    camera: GroundCamera
    framing: Framing
    pose: CameraPose
    size: tuple[int, int]

    def __post_init__(self) -> None:
        width, height = self.size
        if not (16 <= width <= 8192 and 16 <= height <= 8192):
            raise GeometryError(f"size: {width} x {height} is not a picture of 16 to 8192 pixels")

    @cached_property
    def eye_m(self) -> FloatArray:
        """The lens in the world [3]."""
        return np.array([self.pose.x_m, self.pose.y_m, self.camera.height_m])

    @cached_property
    def focal_px(self) -> float:
        """Picture pixels a radian near the axis."""
        return self.camera.lens.focal_px / self.framing.scale

    @cached_property
    def _unbounded(self) -> GroundCamera:
        return replace(self.camera, window_px=None)

    def pixels(self, xyz_m: FloatArray) -> FloatArray:
        """Picture pixels [n, 2] of world points [n, 3]; NaN outside the image circle.

        Points beside the sensor keep their pixel: things are drawn across the picture's edge.
        """
        ground = np.concatenate([self.pose.world_to_ground(xyz_m[:, :2]), xyz_m[:, 2:]], axis=1)
        uv, _ = self._unbounded.project(ground)
        radius = np.hypot(uv[:, 0] - self.camera.cx, uv[:, 1] - self.camera.cy)
        inside = radius < self.camera.lens.max_radius_px * (1 - 1e-9)
        return np.where(inside[:, None], self.framing.crop_to_frame(uv), np.nan)

    def window(self) -> tuple[float, float, float, float]:
        """The part of the picture that the crop covers: u1, v1, u2, v2."""
        corners = np.array(self.framing.window_px).reshape(2, 2)
        low, high = np.clip(self.framing.crop_to_frame(corners), 0, self.size).tolist()
        return low[0], low[1], high[0], high[1]


@dataclass(frozen=True)
class Rays:
    """Every pixel's direction: `world` [h, w, 3] unit vectors, `lit` [h, w] inside the image
    circle, `vignette` [h, w] factor. Directions beyond the rim are the rim's."""

    world: Float32Array
    lit: BoolArray
    vignette: Float32Array


def scene_camera(
    loaded: LoadedConfig, size: tuple[int, int] = (1920, 1080), pose: CameraPose = DEFAULT_POSE
) -> SceneCamera:
    """The configured camera, for pictures of `size`: any scaled copy of the sensor's picture.

    Raises GeometryError when `size` has other proportions than the sensor.
    """
    return SceneCamera(ground_camera(loaded), framing(loaded).for_frame(*size), pose, size)


def lens_camera(
    lens: Lens,
    size: tuple[int, int] = (1920, 1080),
    *,
    height_m: float = 3.6576,
    pitch_deg: float = 0.0,
    pose: CameraPose = DEFAULT_POSE,
) -> SceneCamera:
    """Any lens (its focal length in pixels of `size`) with its axis in the picture's middle."""
    width, height = size
    frame = Framing(width, height)
    centre = width / 2, height / 2
    camera = GroundCamera(lens, *centre, height_m, pitch_deg, window_px=frame.window_px)
    return SceneCamera(camera, frame, pose, size)


def rectilinear_camera(
    fov_deg: float = 90.0,
    size: tuple[int, int] = (1920, 1080),
    *,
    height_m: float = 3.6576,
    pitch_deg: float = -15.0,
    pose: CameraPose = DEFAULT_POSE,
) -> SceneCamera:
    """An ordinary camera in which straight lines stay straight, `fov_deg` wide horizontally."""
    if not 10 <= fov_deg <= 150:
        raise GeometryError(f"fov_deg: {fov_deg} is not 10 to 150 for an ordinary camera")
    width, height = size
    focal = width / 2 / math.tan(math.radians(fov_deg) / 2)
    corner = math.atan(math.hypot(width, height) / 2 / focal)
    lens = Lens("perspective", focal, min(corner * 1.02, math.radians(89)))
    return lens_camera(lens, size, height_m=height_m, pitch_deg=pitch_deg, pose=pose)


@lru_cache(maxsize=3)
def rays(view: SceneCamera) -> Rays:
    """The rays of a camera's pixels, interpolated from a lattice as the ground table does it."""
    width, height = view.size
    columns, rows = -(-width // _LATTICE_PX) + 2, -(-height // _LATTICE_PX) + 2
    u, v = np.meshgrid(np.arange(columns) * _LATTICE_PX, np.arange(rows) * _LATTICE_PX)
    crop = view.framing.frame_to_crop(np.stack([u, v], axis=-1).astype(np.float64))
    centre = np.array([view.camera.cx, view.camera.cy])
    rim = view.camera.lens.max_radius_px * (1 - 1e-9)
    reach = np.hypot(*np.moveaxis(crop - centre, -1, 0))
    crop = centre + (crop - centre) * np.minimum(1.0, rim / np.maximum(reach, 1e-9))[..., None]
    ground = view.camera.rays(crop)
    level = view.pose.ground_to_world(ground[..., :2]) - (view.pose.x_m, view.pose.y_m)
    world = np.concatenate([level, ground[..., 2:]], axis=-1).astype(np.float32)
    theta = np.arccos(np.clip(world @ _axis(view), -1, 1)) / view.camera.lens.max_theta_rad
    coarse = np.dstack([world, reach.astype(np.float32), theta.astype(np.float32)])
    # Lattice nodes lie on pixel edges; a pixel's middle is half a pixel further.
    at_u = ((np.arange(width) + 0.5) / _LATTICE_PX).astype(np.float32)
    at_v = ((np.arange(height) + 0.5) / _LATTICE_PX).astype(np.float32)
    map_u, map_v = np.meshgrid(at_u, at_v)
    parts = (np.ascontiguousarray(part) for part in (coarse[..., :3], coarse[..., 3:5]))
    fine = np.dstack(
        [np.asarray(cv2.remap(part, map_u, map_v, cv2.INTER_LINEAR)) for part in parts]
    )
    lit = fine[..., 3] < rim
    u1, v1, u2, v2 = view.window()
    lit[: round(v1)] = lit[round(v2) :] = False
    lit[:, : round(u1)] = lit[:, round(u2) :] = False
    edge = fine[..., 4]
    vignette = (1.0 - 0.42 * edge**3) * np.clip((1.0 - edge) * 40, 0, 1)
    if view.camera.lens.projection == "perspective":
        vignette = 1.0 - 0.25 * edge**3
    return Rays(np.ascontiguousarray(fine[..., :3]), np.asarray(lit), vignette.astype(np.float32))


def _axis(view: SceneCamera) -> Float32Array:
    """The optical axis in the world [3]."""
    pitch, heading = math.radians(view.camera.pitch_deg), math.radians(view.camera.heading_deg)
    level = np.array([math.cos(pitch) * math.cos(heading), math.cos(pitch) * math.sin(heading)])
    world = view.pose.ground_to_world(level) - (view.pose.x_m, view.pose.y_m)
    return np.array([*world, math.sin(pitch)], np.float32)
