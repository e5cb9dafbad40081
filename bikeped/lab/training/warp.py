"""Warps an ordinary picture and its boxes as if taken through a fisheye lens.

The picture is treated as a perspective view of `picture_fov_deg` over its longer side, turned about
its axis (roll), up or down (pitch) and about the vertical (yaw), and seen through a fisheye lens
whose image circle lies in a square of `size_px`. So upright people lean in the picture as before a
level camera on a pole.

Both cameras are `GroundCamera`s, with the directions of the deployed ground table. A box becomes
the tight upright rectangle of its mapped outline: its four edges, or its object's polygons, densely
sampled and cut by the image circle and the picture. The four corners alone would miss the bulge of
an edge by tens of pixels.

Points are in pixels from the upper left corner, as COCO's boxes are: the middle of the first pixel
is (0.5, 0.5).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.lens import Lens, canonical_projection
from bikeped.types import BoolArray, Float32Array, FloatArray, ImageArray

#: Samples of a box's edge, of an object's outline, and of the image circle's rim.
EDGE_SAMPLES, OUTLINE_SAMPLES, RIM_SAMPLES = 256, 1024, 4096
#: Grey of the image circle outside the picture: the padding of letterboxed detector inputs.
FILL = 114
_HALVINGS = 24  # bisection steps to the point where a curve leaves the visible part
_SHARE_GRID = 24  # points a side to measure the visible share of a box
_WIDEST = {"orthographic": 178.0, "stereographic": 300.0}  # short of the model's limit
_ROOM = 359.0
_WIDEST_PICTURE = 160.0

Range = tuple[float, float]
Size = tuple[int, int]  #: width, height in pixels


@dataclass(frozen=True)
class WarpRanges:
    """Ranges (least, most) that `sample_warp` samples uniformly.

    `radius_share` and `shift_share` are the circle's radius and the offset of its centre on each
    axis, as shares of `size_px`. `fov_deg` of the circle is limited to what the projection can
    show (orthographic: 180).
    """

    projections: tuple[str, ...] = ("equidistant", "equisolid", "stereographic", "orthographic")
    fov_deg: Range = (170.0, 210.0)
    picture_fov_deg: Range = (90.0, 150.0)
    yaw_deg: Range = (-50.0, 50.0)
    pitch_deg: Range = (-40.0, 15.0)
    roll_deg: Range = (-10.0, 10.0)
    radius_share: Range = (0.42, 0.55)
    shift_share: Range = (-0.04, 0.04)
    size_px: int = 1280

    def __post_init__(self) -> None:
        if not self.projections:
            raise GeometryError("projection: none is given; name one or more")
        for name in self.projections:
            if canonical_projection(name) == "perspective":
                raise GeometryError("projection: perspective is no fisheye lens; name one of those")
        for key, (least, most), low, high in (
            ("fov-deg", self.fov_deg, 60.0, _ROOM),
            ("picture-fov-deg", self.picture_fov_deg, 10.0, _WIDEST_PICTURE),
            ("yaw-deg", self.yaw_deg, -180.0, 180.0),
            ("pitch-deg", self.pitch_deg, -90.0, 90.0),
            ("roll-deg", self.roll_deg, -180.0, 180.0),
            ("radius", self.radius_share, 0.1, 2.0),
            ("shift", self.shift_share, -0.5, 0.5),
        ):
            if not low <= least <= most <= high:  # NaN compares false
                raise GeometryError(
                    f"{key}: {least:g} to {most:g} is no range within {low:g} to {high:g}; "
                    "give the smaller number first"
                )
        if not 64 <= self.size_px <= 8192:
            raise GeometryError(f"size: {self.size_px} is not 64 to 8192 pixels")


@dataclass(frozen=True)
class Warp:
    """A sampled lens and direction; see the module. Angles as in `GroundCamera`."""

    lens: Lens
    centre_px: tuple[float, float]
    size_px: int
    picture_fov_deg: float
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    _fisheye: GroundCamera = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0 < self.picture_fov_deg <= _WIDEST_PICTURE:
            raise GeometryError(
                f"picture-fov-deg: {self.picture_fov_deg:g} is not within 0 to {_WIDEST_PICTURE:g}"
            )
        object.__setattr__(self, "_fisheye", GroundCamera(self.lens, *self.centre_px, height_m=1.0))

    def forward(self, xy_px: FloatArray, picture_wh: Size) -> tuple[FloatArray, BoolArray]:
        """Maps points [..., 2] of the picture; also which are visible (in circle and square)."""
        ray = _picture_camera(picture_wh, self.picture_fov_deg, self.pitch_deg, self.yaw_deg).rays(
            self._rolled(xy_px, picture_wh, self.roll_deg)
        )
        uv, _ = self._fisheye.project(ray + np.array([0.0, 0.0, 1.0]))
        seen = ray[..., 0] > math.cos(self.lens.max_theta_rad)
        return uv, seen & ((uv >= 0) & (uv <= self.size_px)).all(axis=-1)

    def inverse(self, uv_px: FloatArray, picture_wh: Size) -> tuple[FloatArray, BoolArray]:
        """Maps points [..., 2] back to the picture, NaN outside the image circle; also which of
        them lie in the picture."""
        ray = self._fisheye.rays(uv_px)
        picture = _picture_camera(picture_wh, self.picture_fov_deg, self.pitch_deg, self.yaw_deg)
        xy, ahead = picture.project(ray + np.array([0.0, 0.0, 1.0]))
        xy = self._rolled(xy, picture_wh, -self.roll_deg)
        inside = ((xy >= 0) & (xy <= np.asarray(picture_wh, np.float64))).all(axis=-1)
        return xy, ahead & inside

    def as_dict(self) -> dict[str, Any]:
        """For the record in an augmented picture's entry."""
        return {
            "projection": self.lens.projection,
            "fov_deg": round(math.degrees(2 * self.lens.max_theta_rad), 3),
            "radius_px": round(self.lens.max_radius_px, 3),
            "centre_px": [round(value, 3) for value in self.centre_px],
            "picture_fov_deg": round(self.picture_fov_deg, 3),
            "yaw_deg": round(self.yaw_deg, 3),
            "pitch_deg": round(self.pitch_deg, 3),
            "roll_deg": round(self.roll_deg, 3),
        }

    def _rolled(self, xy_px: FloatArray, picture_wh: Size, angle_deg: float) -> FloatArray:
        """Points turned clockwise about the picture's middle."""
        if angle_deg == 0:
            return xy_px
        c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        middle = np.asarray(picture_wh, np.float64) / 2
        return np.asarray((xy_px - middle) @ np.array([[c, s], [-s, c]]) + middle)


@functools.lru_cache(maxsize=64)
def _picture_camera(
    picture_wh: Size, fov_deg: float, pitch_deg: float, yaw_deg: float
) -> GroundCamera:
    """The perspective camera of the picture, a metre above its own ground."""
    wide, high = picture_wh
    focal = max(wide, high) / 2 / math.tan(math.radians(fov_deg) / 2)
    lens = Lens("perspective", focal, math.radians(89.5))
    return GroundCamera(lens, wide / 2, high / 2, 1.0, pitch_deg, yaw_deg)


def sample_warp(rng: np.random.Generator, ranges: WarpRanges) -> Warp:
    """A random warp; the same generator state gives the same warp."""
    projection = ranges.projections[int(rng.integers(len(ranges.projections)))]
    widest = _WIDEST.get(canonical_projection(projection), _ROOM)
    least, most = (min(angle, widest) for angle in ranges.fov_deg)
    fov_deg = float(rng.uniform(least, most))
    size = ranges.size_px
    lens = Lens.from_circle(projection, size * float(rng.uniform(*ranges.radius_share)), fov_deg)
    shift_x, shift_y = (float(rng.uniform(*ranges.shift_share)) for _ in range(2))
    picture_fov, yaw, pitch, roll = (
        float(rng.uniform(*bounds))
        for bounds in (ranges.picture_fov_deg, ranges.yaw_deg, ranges.pitch_deg, ranges.roll_deg)
    )
    centre = (size * (0.5 + shift_x), size * (0.5 + shift_y))
    return Warp(lens, centre, size, picture_fov, yaw, pitch, roll)


def warp_picture(image: ImageArray, warp: Warp) -> ImageArray:
    """The picture [h, w, 3] through the lens: [size, size, 3], black outside the image circle.

    Where the lens shrinks, pixels are interpolated between levels of an image pyramid, by the local
    scale (the root of the area that a pixel covers); bilinear otherwise.
    """
    high, wide = image.shape[:2]
    size = warp.size_px
    axis = np.arange(size) + 0.5
    across, down = ((axis - middle) ** 2 for middle in warp.centre_px)
    circle = across[None, :] + down[:, None] <= warp.lens.max_radius_px**2
    out: ImageArray = np.zeros((size, size, 3), np.uint8)
    out[circle] = FILL
    left, top, right, low = _picture_window(warp, (wide, high))
    if right <= left or low <= top:
        return out
    window = np.stack(np.meshgrid(axis[left:right], axis[top:low]), axis=-1)
    xy, inside = warp.inverse(window, (wide, high))
    if not inside.any():
        return out
    level = _pyramid_level(xy, inside)
    part = out[top:low, left:right]
    part[inside] = _sample_pyramid(image, xy.astype(np.float32), level, inside)[inside]
    return out


def _picture_window(warp: Warp, picture_wh: Size) -> tuple[int, int, int, int]:
    """Bounds of the picture in the square: left, top, right, bottom (exclusive)."""
    whole = np.array([[0.0, 0.0, picture_wh[0], picture_wh[1]]])
    box, share = warp_boxes(warp, picture_wh, whole)
    if share[0] == 0 and not np.isfinite(box).all():
        return 0, 0, 0, 0
    limit = warp.size_px
    left, top = (max(math.floor(value) - 1, 0) for value in box[0, :2])
    right, low = (min(math.ceil(value) + 1, limit) for value in box[0, 2:])
    return left, top, right, low


def _pyramid_level(xy: FloatArray, inside: BoolArray) -> Float32Array:
    """[h, w] log2 of the local downscaling, 0 where the lens enlarges."""
    if min(xy.shape[:2]) < 2:
        return np.zeros(xy.shape[:2], np.float32)
    x, y = xy[..., 0], xy[..., 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        x_v, x_u = np.gradient(x)
        y_v, y_u = np.gradient(y)
        area = np.abs(x_u * y_v - x_v * y_u)
        level = 0.5 * np.log2(np.maximum(area, 1.0))
    return np.where(inside & np.isfinite(level), level, 0.0).astype(np.float32)


def _sample_pyramid(
    image: ImageArray, xy: Float32Array, level: Float32Array, inside: BoolArray
) -> ImageArray:
    """The picture sampled at `xy`, each pixel from the two pyramid levels around its own."""
    high, wide = image.shape[:2]
    most = max(0, math.floor(math.log2(max(min(high, wide) / 4, 1))))
    level = np.minimum(level, most)
    top = math.ceil(float(level.max()))
    xy = np.where(inside[..., None], xy, np.float32(0))
    mean = np.zeros((*xy.shape[:2], 3), np.float32)
    copy = image
    for step in range(top + 1):
        if step:
            half = (max(copy.shape[1] // 2, 1), max(copy.shape[0] // 2, 1))
            copy = np.asarray(cv2.resize(copy, half, interpolation=cv2.INTER_AREA), np.uint8)
        weight = np.maximum(1 - np.abs(level - step), 0)
        if not weight.any():
            continue
        # remap counts from the middle of the first pixel.
        across = xy[..., 0] * np.float32(copy.shape[1] / wide) - np.float32(0.5)
        down = xy[..., 1] * np.float32(copy.shape[0] / high) - np.float32(0.5)
        read = cv2.remap(copy, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        mean += read * weight[..., None]
    return np.asarray(np.rint(mean), np.uint8)


def warp_boxes(
    warp: Warp,
    picture_wh: Size,
    box_px: npt.ArrayLike,
    polygons: Sequence[Sequence[FloatArray]] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Warps boxes [n, 4] (x1, y1, x2, y2); also the visible share [n] of each original area.

    `polygons` are each object's outlines; without any its box's edges are used. A box of which
    nothing is visible is NaN.
    """
    boxes = np.asarray(box_px, np.float64).reshape(-1, 4)
    result = np.full((len(boxes), 4), np.nan)
    share = np.zeros(len(boxes))
    border: tuple[FloatArray, FloatArray] | None = None
    for index, box in enumerate(boxes):
        rings = polygons[index] if polygons is not None else ()
        curves = [_box_edges(box)] if len(rings) == 0 else [*map(_outline, rings)]
        mapped = [warp.forward(curve, picture_wh) for curve in curves]
        points = np.concatenate([uv[seen] for uv, seen in mapped])
        if all(seen.all() for _, seen in mapped):
            share[index] = 1.0
        else:
            if border is None:
                border = _visible_border(warp, picture_wh)
            edge_uv, edge_xy = border
            ends = [
                _exit_points(warp, picture_wh, curve, seen)
                for curve, (_, seen) in zip(curves, mapped, strict=True)
            ]
            points = np.concatenate([points, *ends, edge_uv[_in_object(edge_xy, box, rings)]])
            share[index] = _visible_share(warp, picture_wh, box, rings)
        if len(points):
            result[index, :2], result[index, 2:] = points.min(axis=0), points.max(axis=0)
    return result, share


def _box_edges(box: FloatArray) -> FloatArray:
    """[4 * EDGE_SAMPLES, 2] points along the four edges."""
    x1, y1, x2, y2 = box
    corners = np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]])
    along = np.linspace(0, 1, EDGE_SAMPLES, endpoint=False)[None, :, None]
    start, end = corners[:-1, None], corners[1:, None]
    return np.asarray((start + (end - start) * along).reshape(-1, 2))


def _outline(ring: FloatArray) -> FloatArray:
    """A closed outline, resampled evenly."""
    step = np.roll(ring, -1, axis=0) - ring
    length = np.hypot(step[:, 0], step[:, 1])
    spacing = max(float(length.sum()) / OUTLINE_SAMPLES, 1e-9)
    parts = np.maximum(np.ceil(length / spacing), 1).astype(np.int64)
    first = np.repeat(np.cumsum(parts) - parts, parts)
    along = (np.arange(int(parts.sum())) - first) / np.repeat(parts, parts)
    start, step = np.repeat(ring, parts, axis=0), np.repeat(step, parts, axis=0)
    return np.asarray(start + step * along[:, None])


def _exit_points(warp: Warp, picture_wh: Size, curve: FloatArray, seen: BoolArray) -> FloatArray:
    """[k, 2] the points where a closed curve leaves the visible part."""
    after = np.roll(seen, -1)
    leaves = np.nonzero(seen != after)[0]
    here, there = curve[leaves], np.roll(curve, -1, axis=0)[leaves]
    turned = ~seen[leaves][:, None]
    inner, outer = np.where(turned, there, here), np.where(turned, here, there)
    for _ in range(_HALVINGS):
        middle = (inner + outer) / 2
        is_seen = warp.forward(middle, picture_wh)[1][:, None]
        inner, outer = np.where(is_seen, middle, inner), np.where(is_seen, outer, middle)
    return warp.forward(inner, picture_wh)[0]


def _visible_border(warp: Warp, picture_wh: Size) -> tuple[FloatArray, FloatArray]:
    """Points along the border of the visible part: in the square, and in the picture."""
    size = float(warp.size_px)
    turn = np.linspace(0, 2 * math.pi, RIM_SAMPLES, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn)], -1) * (warp.lens.max_radius_px * (1 - 1e-9))
    rim += np.asarray(warp.centre_px)
    fine = np.linspace(0, size, 2 * warp.size_px + 1)
    ends = np.zeros_like(fine), np.full_like(fine, size)
    edges = np.concatenate(
        [np.stack([fine, end], -1) for end in ends] + [np.stack([end, fine], -1) for end in ends]
    )
    uv = np.concatenate([rim[((rim >= 0) & (rim <= size)).all(axis=1)], edges])
    xy, inside = warp.inverse(uv, picture_wh)
    return uv[inside], xy[inside]


def _in_object(xy: FloatArray, box: FloatArray, rings: Sequence[FloatArray]) -> BoolArray:
    """Which points [n, 2] of the picture lie in the object."""
    inside: BoolArray = np.asarray(
        (xy[:, 0] >= box[0]) & (xy[:, 1] >= box[1]) & (xy[:, 0] <= box[2]) & (xy[:, 1] <= box[3])
    )
    if len(rings) == 0 or not inside.any():
        return inside
    few = np.nonzero(inside)[0]
    inside[few] = np.any([_in_polygon(xy[few], ring) for ring in rings], axis=0)
    return inside


def _in_polygon(xy: FloatArray, ring: FloatArray) -> BoolArray:
    """Which points lie inside a closed outline, by the even-odd rule."""
    x, y = xy[:, 0, None], xy[:, 1, None]
    x1, y1 = ring[:, 0], ring[:, 1]
    x2, y2 = np.roll(x1, -1), np.roll(y1, -1)
    spans = (y1 > y) != (y2 > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = x1 + (y - y1) * (x2 - x1) / (y2 - y1)
    return np.asarray((spans & (x < crossing)).sum(axis=1) % 2 == 1)


def _visible_share(
    warp: Warp, picture_wh: Size, box: FloatArray, rings: Sequence[FloatArray]
) -> float:
    """Visible share of the object's area in the picture, on a grid of points."""
    step = (np.arange(_SHARE_GRID) + 0.5) / _SHARE_GRID
    x, y = box[0] + (box[2] - box[0]) * step, box[1] + (box[3] - box[1]) * step
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    own = grid[_in_object(grid, box, rings)]
    if len(own) == 0:  # thinner than the grid
        own = grid
    return float(warp.forward(own, picture_wh)[1].mean())
