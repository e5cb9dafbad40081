"""Boards with known truth: exact corners through a known lens, out to the rim of the image circle.

What no real set here reaches (a 200 degree lens, a board at 95 degrees from the axis, a known bend)
is drawn. Camera axes: x right, y down, z along the optical axis (OpenCV's). A board's pose takes
board coordinates (`BoardPattern.corners_m`: x along columns, y along rows, z away from the camera
when the board faces it) to camera coordinates. `render.py` makes pictures of the same scenes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.errors import GeometryError
from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern, BoardView
from bikeped.types import BoolArray, FloatArray

_GOLDEN = math.pi * (3 - math.sqrt(5))
_TRIES = 60


@dataclass(frozen=True)
class DrawnCamera:
    """The truth that a calibration has to find again: lens, optical centre, picture size."""

    lens: Lens
    cx: float
    cy: float
    width: int
    height: int

    def project(self, xyz_m: npt.ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Pixels [n, 2] of camera points [n, 3], and which are in the field and the picture [n]."""
        point = np.asarray(xyz_m, dtype=np.float64)
        side = np.hypot(point[..., 0], point[..., 1])
        theta = np.arctan2(side, point[..., 2])
        radius = self.lens.radius(np.minimum(theta, self.lens.max_theta_rad))
        scale = radius / np.where(side > 0, side, 1.0)
        uv = np.stack([self.cx + scale * point[..., 0], self.cy + scale * point[..., 1]], axis=-1)
        inside = (uv >= 0).all(-1) & (uv[..., 0] <= self.width - 1)
        inside &= (uv[..., 1] <= self.height - 1) & (theta <= self.lens.max_theta_rad)
        return uv, inside

    def rays(self, uv_px: npt.ArrayLike) -> FloatArray:
        """Unit directions [..., 3] of pixels [..., 2]; NaN outside the image circle."""
        uv = np.asarray(uv_px, dtype=np.float64)
        du, dv = uv[..., 0] - self.cx, uv[..., 1] - self.cy
        radius = np.hypot(du, dv)
        theta = self.lens.theta(radius)
        scale = np.sin(theta) / np.where(radius > 0, radius, 1.0)
        return np.stack([scale * du, scale * dv, np.cos(theta)], axis=-1)


@dataclass(frozen=True)
class BoardBend:
    """How far a board leaves its plane, in squares at its edge; parabolas and a twist.

    z = square * (along_columns * x^2 + along_rows * y^2 + twist * x * y), x and y from -1 to 1
    between the outermost inner corners.
    """

    along_columns: float = 0.0
    along_rows: float = 0.0
    twist: float = 0.0

    def depth_m(self, pattern: BoardPattern, xy_m: FloatArray) -> FloatArray:
        """z [...] in metres over board positions [..., 2]."""
        half = np.array([pattern.columns - 1, pattern.rows - 1]) * pattern.square_m / 2
        x, y = np.moveaxis(xy_m / half, -1, 0)
        bend = self.along_columns * x * x + self.along_rows * y * y + self.twist * x * y
        return np.asarray(pattern.square_m * bend)


FLAT = BoardBend()


@dataclass(frozen=True)
class BoardPose:
    """Camera point = `rotation` [3, 3] @ board point + `translation_m` [3]."""

    rotation: FloatArray
    translation_m: FloatArray

    def to_camera(self, xyz_m: FloatArray) -> FloatArray:
        """Board points [..., 3] in camera axes."""
        return np.asarray(xyz_m @ self.rotation.T + self.translation_m)


def true_corners(
    camera: DrawnCamera, pattern: BoardPattern, pose: BoardPose, bend: BoardBend = FLAT
) -> tuple[FloatArray, BoolArray]:
    """Where the corners [n, 2] of a board lie in the picture, by id, and which are seen [n].

    A corner that faces away from the camera is not seen.
    """
    board = pattern.corners_m()
    board[:, 2] = bend.depth_m(pattern, board[:, :2])
    point = pose.to_camera(board)
    uv, seen = camera.project(point)
    facing = point @ pose.rotation[:, 2] > 0
    return uv, seen & facing


def spread_poses(
    camera: DrawnCamera,
    pattern: BoardPattern,
    count: int,
    *,
    seed: int = 0,
    span_deg: tuple[float, float] = (25.0, 60.0),
    tilt_deg: float = 35.0,
    margin_px: float = 0.0,
) -> list[BoardPose]:
    """`count` poses that cover the image circle, every corner seen, a third of them at the rim.

    `span_deg`: the angle that the board's diagonal takes up; `tilt_deg`: how far its normal leaves
    the line of sight, at most. A board that would come nearer than `margin_px` to the picture's
    edge is moved toward the axis. GeometryError where no place is found: the spans are too wide.
    """
    rng = np.random.default_rng(seed)
    poses = []
    for number in range(count):
        # Even over the solid angle of the lens; the last third is pushed out to where it just fits.
        share = (number + 0.5) / count
        half = camera.lens.max_theta_rad
        theta = math.acos(1 - share * (1 - math.cos(half)))
        phi = number * _GOLDEN + rng.uniform(-0.2, 0.2)
        for _ in range(_TRIES):
            shape = _Shape(
                span=math.radians(rng.uniform(*span_deg)),
                roll=rng.uniform(-math.pi, math.pi),
                tilt=math.radians(rng.uniform(0.2, 1.0) * tilt_deg),
                tilt_toward=rng.uniform(-math.pi, math.pi),
            )
            angle = theta if share < 2 / 3 else half
            pose = _outermost(camera, pattern, angle, phi, shape, margin_px)
            if pose is not None:
                poses.append(pose)
                break
        else:
            raise GeometryError(
                f"span_deg: a board of {span_deg[0]:g} to {span_deg[1]:g} degrees has no place in "
                f"a field of {math.degrees(2 * half):.0f}; use smaller ones"
            )
    return poses


def draw_views(
    camera: DrawnCamera,
    pattern: BoardPattern,
    poses: Sequence[BoardPose],
    *,
    noise_px: float = 0.0,
    outlier_share: float = 0.0,
    outlier_px: float = 20.0,
    bend: BoardBend = FLAT,
    seed: int = 0,
) -> list[BoardView]:
    """The corners of each pose as the corner finder would hand them over, unseen ones left out.

    `noise_px`: standard deviation of each coordinate. `outlier_share` of all corners, chosen at
    random, are thrown off by `outlier_px` to five times that, in any direction.
    """
    rng = np.random.default_rng(seed)
    views = []
    for number, pose in enumerate(poses):
        uv, seen = true_corners(camera, pattern, pose, bend)
        uv = uv + rng.normal(0.0, 1.0, uv.shape) * noise_px
        thrown = rng.random(len(uv)) < outlier_share
        far, way = rng.uniform(1, 5, len(uv)) * outlier_px, rng.uniform(0, 2 * math.pi, len(uv))
        uv = uv + thrown[:, None] * far[:, None] * np.stack([np.cos(way), np.sin(way)], axis=-1)
        ids = np.flatnonzero(seen).astype(np.int64)
        views.append(
            BoardView(f"drawn {number + 1:02d}", ids, uv[ids], camera.width, camera.height)
        )
    return views


@dataclass(frozen=True)
class _Shape:
    span: float
    roll: float
    tilt: float
    tilt_toward: float


def _outermost(
    camera: DrawnCamera,
    pattern: BoardPattern,
    theta: float,
    phi: float,
    shape: _Shape,
    margin_px: float,
) -> BoardPose | None:
    """The pose at the largest angle up to `theta` at which the whole board is seen."""
    far = np.array([camera.width, camera.height]) - 1 - margin_px

    def is_edge_crossing(angle: float) -> BoardPose | None:
        pose = _pose_at(pattern, angle, phi, shape)
        uv, seen = true_corners(camera, pattern, pose)
        free = (uv >= margin_px).all() and (uv <= far).all()
        return pose if free and seen.all() else None

    best = is_edge_crossing(theta)
    if best is not None:
        return best
    inner, outer = 0.0, theta
    best = is_edge_crossing(inner)
    if best is None:
        return None
    for _ in range(20):
        middle = (inner + outer) / 2
        pose = is_edge_crossing(middle)
        if pose is None:
            outer = middle
        else:
            inner, best = middle, pose
    return best


def _pose_at(pattern: BoardPattern, theta: float, phi: float, shape: _Shape) -> BoardPose:
    sight = np.array(
        [math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]
    )
    out = np.array(
        [math.cos(theta) * math.cos(phi), math.cos(theta) * math.sin(phi), -math.sin(theta)]
    )
    facing = np.stack([out, np.cross(sight, out), sight], axis=1)
    rotation = facing @ turn(_axis(shape.tilt_toward) * shape.tilt) @ turn([0, 0, shape.roll])
    size = math.hypot(pattern.columns - 1, pattern.rows - 1) * pattern.square_m
    return BoardPose(rotation, sight * (size / 2 / math.tan(shape.span / 2)))


def _axis(angle: float) -> FloatArray:
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def turn(vector: npt.ArrayLike) -> FloatArray:
    """Rotation matrix [3, 3] of a rotation vector (axis times angle in radians), Rodrigues."""
    axis = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(axis))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = axis / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    out: FloatArray = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return out
