"""A mesh as the camera sees it: colour and coverage of a small part of the picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from bikeped.lab.rendering.conditions import Lighting
from bikeped.lab.rendering.mesh import Mesh, normals
from bikeped.lab.rendering.render_camera import SceneCamera
from bikeped.types import BoolArray, Float32Array, FloatArray, ImageArray

_SHIFT = 5
_MARGIN_PX = 2
#: A sprite may reach this far beyond the picture, as a share of it: what lies there counts as cut
#: off. More would cost memory for a bus at arm's length.
_BEYOND = 0.35


@dataclass(frozen=True)
class Sprite:
    """`colour` [h, w, 3] uint8, already multiplied by `alpha` [h, w] uint8 (255 is covered), with
    its upper left corner at pixel (`left`, `top`), which may lie outside the picture.

    `full_box_px`: u1, v1, u2, v2 of the whole silhouette; `distance_m`: order of occlusion.
    """

    left: int
    top: int
    colour: ImageArray
    alpha: ImageArray
    full_box_px: tuple[float, float, float, float]
    distance_m: float

    @property
    def area_px(self) -> float:
        """Covered pixels."""
        return float(self.alpha.sum(dtype=np.int64)) / 255


def rasterise(
    mesh: Mesh,
    view: SceneCamera,
    light: Lighting,
    *,
    local: FloatArray | None = None,
    distance_m: float,
) -> Sprite | None:
    """Draws `mesh` (world metres); None when nothing of it is in or near the picture.

    `local` [3] is light from lamps at its place, added to the ambient light.
    """
    eye = view.eye_m
    quads: FloatArray = mesh.quads
    normal = normals(quads)
    facing = np.einsum("ij,ij->i", eye - quads[:, 0], normal) > 0
    if not facing.any():
        return None
    pixels: FloatArray = view.pixels(quads[facing].reshape(-1, 3)).reshape(-1, 4, 2)
    kept = np.flatnonzero(facing)
    whole = _finite_faces(pixels)
    if not whole.all():
        kept, pixels = kept[whole], pixels[whole]
    if len(kept) == 0:
        return None
    low, high = pixels.min(axis=(0, 1)), pixels.max(axis=(0, 1))
    bounds = _bounds(low, high, view.size)
    if bounds is None:
        return None
    part = quads[kept]
    sight = 0.25 * (part[:, 0] + part[:, 1] + part[:, 2] + part[:, 3]) - eye
    away = np.einsum("ij,ij->i", sight, sight)
    order = np.lexsort((-away, mesh.layer[kept]))
    colour = shade_faces(mesh, normal, kept, light, local)[order]
    scale = _supersampling(float((high - low).max()))
    canvas = _filled(
        pixels[order], bounds, scale, np.pad(colour, ((0, 0), (0, 1)), constant_values=255)
    )
    box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    rgb, alpha = np.ascontiguousarray(canvas[..., :3]), np.ascontiguousarray(canvas[..., 3])
    return Sprite(bounds[0], bounds[1], rgb, alpha, box, distance_m)


def shade_faces(
    mesh: Mesh,
    normal: FloatArray,
    kept: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    light: Lighting,
    local: FloatArray | None,
) -> FloatArray:
    """Colours [m, 3] of the faces `kept` under the light: sky from above, sun from its side."""
    n = normal[kept]
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    ambient = light.ambient if local is None else light.ambient + local
    factor = (
        ambient * (0.86 + 0.20 * n[:, 2:]) + light.sun * np.clip(n @ light.to_sun, 0, 1)[:, None]
    )
    glow = mesh.glow[kept][:, None]
    out: FloatArray = np.clip(mesh.colours[kept] * (factor * (1 - glow) + glow), 0, 255)
    return out


def shadow(
    quads: FloatArray, view: SceneCamera, to_sun: FloatArray, softness: int
) -> tuple[int, int, Float32Array] | None:
    """Where faces [n, 4, 3] keep the sun off the ground: left, top and coverage [h, w] 0..1."""
    normal = normals(quads)
    lit = quads[(normal @ to_sun) > 0]
    if len(lit) == 0:
        return None
    slope = to_sun[:2] / max(float(to_sun[2]), 0.18)
    flat = lit.copy()
    flat[..., :2] -= lit[..., 2:] * slope
    flat[..., 2] = 0
    pixels: FloatArray = view.pixels(flat.reshape(-1, 3)).reshape(-1, 4, 2)
    pixels = pixels[_finite_faces(pixels)]
    if len(pixels) == 0:
        return None
    bounds = _bounds(pixels.min(axis=(0, 1)), pixels.max(axis=(0, 1)), view.size, beyond=0.0)
    if bounds is None:
        return None
    left, top, right, bottom = bounds
    scale = 2 if max(right - left, bottom - top) < 160 else 1
    canvas = _filled(pixels, bounds, scale, np.full((len(pixels), 1), 255.0))[..., 0]
    blur = max(softness, 0) * 2 + 1
    out = cv2.GaussianBlur(canvas, (blur, blur), 0) if blur > 1 else canvas
    return left, top, np.asarray(out, np.float32) / np.float32(255)


def _filled(
    pixels: FloatArray, bounds: tuple[int, int, int, int], scale: int, colour: FloatArray
) -> ImageArray:
    """Faces [n, 4, 2] filled with `colour` [n, c] in their order on a canvas [h, w, c] of these
    bounds; drawn `scale` times as large and averaged."""
    left, top, right, bottom = bounds
    size = right - left, bottom - top
    canvas: ImageArray = np.zeros((size[1] * scale, size[0] * scale, colour.shape[1]), np.uint8)
    fixed = ((pixels - (left, top)) * scale - 0.5).clip(-1e6, 1e6) * (1 << _SHIFT)
    points = np.round(fixed).astype(np.int32)
    for i, value in enumerate(colour.tolist()):
        cv2.fillConvexPoly(canvas, points[i], value, cv2.LINE_8, _SHIFT)
    if scale > 1:
        canvas = np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), np.uint8)
    return canvas.reshape(size[1], size[0], -1)


def sprites_overlap(one: Sprite, other: Sprite) -> bool:
    """Whether two sprites' rectangles overlap."""
    (h, w), (k, v) = one.alpha.shape, other.alpha.shape
    left, top = other.left - one.left, other.top - one.top
    return overlapping_slices((w, h), left, top, v, k) is not None


def overlapping_slices(
    size: tuple[int, int], left: int, top: int, width: int, height: int
) -> tuple[slice, slice, slice, slice] | None:
    """Rows and columns of a picture of `size` and of a patch at this place that overlap."""
    x0, y0 = max(left, 0), max(top, 0)
    x1, y1 = min(left + width, size[0]), min(top + height, size[1])
    if x1 <= x0 or y1 <= y0:
        return None
    return slice(y0, y1), slice(x0, x1), slice(y0 - top, y1 - top), slice(x0 - left, x1 - left)


def _finite_faces(pixels: FloatArray) -> BoolArray:
    """Which faces [n, 4, 2] have all their corners."""
    flat = pixels.reshape(-1, 8)
    return np.isfinite(flat @ np.ones(8))


def _bounds(
    low: FloatArray, high: FloatArray, size: tuple[int, int], beyond: float = _BEYOND
) -> tuple[int, int, int, int] | None:
    """Pixel bounds of what is drawn, limited to the picture and a little more."""
    width, height = size
    if high[0] <= 0 or high[1] <= 0 or low[0] >= width or low[1] >= height:
        return None
    left = max(math.floor(low[0]) - _MARGIN_PX, int(-beyond * width))
    top = max(math.floor(low[1]) - _MARGIN_PX, int(-beyond * height))
    right = min(math.ceil(high[0]) + _MARGIN_PX, int((1 + beyond) * width))
    bottom = min(math.ceil(high[1]) + _MARGIN_PX, int((1 + beyond) * height))
    if right - left < 1 or bottom - top < 1:
        return None
    return left, top, right, bottom


def _supersampling(longest_px: float) -> int:
    if longest_px < 60:
        return 4
    if longest_px < 140:
        return 3
    return 2 if longest_px < 700 else 1
