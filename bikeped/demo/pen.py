"""Draws solids given in the world through the fisheye model: hulls of projected outlines.

Solids are small sets of balls, tapering limbs, wires and flat faces. Outlines are projected point
by point through the same GroundCamera that later puts boxes back on the ground, so what is drawn
is bent exactly as the lens bends it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bikeped.geometry import CameraPose, Framing, GroundCamera
from bikeped.types import FloatArray, ImageArray

Rgb = tuple[int, int, int]
_SHIFT = 4
_TURN = np.linspace(0, 2 * np.pi, 12, endpoint=False)
_UNIT_RING = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)


@dataclass(frozen=True)
class Limb:
    """A solid between two balls: `a`, `b` [3] world metres, radii in metres. a == b is a ball."""

    a: FloatArray
    b: FloatArray
    radius_a: float
    radius_b: float
    colour: Rgb


@dataclass(frozen=True)
class Wire:
    """A tube of `width_m` through `points` [n, 3]."""

    points: FloatArray
    width_m: float
    colour: Rgb
    closed: bool = False


@dataclass(frozen=True)
class Face:
    """A flat polygon `points` [n, 3], counter-clockwise from outside.

    `layer` draws it after its neighbours (a window after the wall that it is in).
    """

    points: FloatArray
    colour: Rgb
    layer: int = 0


Part = Limb | Wire | Face


@dataclass(frozen=True)
class Eye:
    """World to frame: camera, its place, and how the frame lies in the crop."""

    camera: GroundCamera
    pose: CameraPose
    framing: Framing

    @property
    def position(self) -> FloatArray:
        """The lens in the world [3]."""
        return np.array([self.pose.x_m, self.pose.y_m, self.camera.height_m])

    def pixels(self, xyz_m: FloatArray) -> FloatArray:
        """Frame pixels [n, 2] of world points [n, 3]; NaN where the lens does not see them.

        Points beside the sensor keep their pixel: things are drawn across the frame's edge.
        """
        ground = np.concatenate([self.pose.world_to_ground(xyz_m[:, :2]), xyz_m[:, 2:]], axis=1)
        unbounded = replace(self.camera, window_px=None)
        uv, seen = unbounded.project(ground)
        return np.where(seen[:, None], self.framing.crop_to_frame(uv), np.nan)


def paint(image: ImageArray, eye: Eye, parts: Sequence[Part]) -> None:
    """Draws `parts` of one solid into `image`, far ones first."""
    outlines = [_outline(part, eye) for part in parts]
    if not outlines:
        return
    counts = np.cumsum([len(o) for o in outlines])
    pixels = np.split(eye.pixels(np.concatenate(outlines)), counts[:-1])
    away = [float(np.linalg.norm(o.mean(axis=0) - eye.position)) for o in outlines]
    layer = [part.layer if isinstance(part, Face) else 0 for part in parts]
    for i in sorted(range(len(parts)), key=lambda i: (layer[i], -away[i])):
        seen = np.isfinite(pixels[i]).all(axis=1)
        # A face that reaches behind the lens is cut off there; smaller parts are left out.
        if seen.all() or (isinstance(parts[i], Face) and seen.sum() > 2):
            _draw(image, parts[i], pixels[i][seen], eye, away[i])


def facing(points: FloatArray, eye: FloatArray) -> bool:
    """Whether a face [n, 3], counter-clockwise from outside, shows its outside to `eye` [3]."""
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    return bool(normal @ (eye - points[0]) > 0)


def shadow(image: ImageArray, pixels: FloatArray, darkness: float) -> None:
    """Darkens the polygon `pixels` [n, 2]."""
    if not np.isfinite(pixels).all():
        return
    h, w = image.shape[:2]
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 2, (w, h))
    if (high <= low).any():
        return
    part = image[low[1] : high[1], low[0] : high[0]]
    flat = part.copy()
    cv2.fillPoly(flat, [_fixed(pixels - low)], (12, 14, 18), cv2.LINE_AA, _SHIFT)
    cv2.addWeighted(flat, darkness, part, 1 - darkness, 0, dst=part)


def tinted(colour: Rgb, factor: float) -> Rgb:
    """The colour lighter (factor above 1) or darker."""
    r, g, b = (int(min(max(c * factor, 0), 255)) for c in colour)
    return r, g, b


def subdivided(points: FloatArray, pieces: int) -> FloatArray:
    """A closed outline [n, 3] with every edge cut up: straight edges bend in the lens."""
    along = np.arange(pieces)[None, :, None] / pieces
    following = np.roll(points, -1, axis=0)
    return (points[:, None] * (1 - along) + following[:, None] * along).reshape(-1, 3)


def _outline(part: Part, eye: Eye) -> FloatArray:
    """World points [n, 3] whose projection bounds the part."""
    if isinstance(part, Limb):
        rings = [_ring(part.a, part.radius_a, eye.position)]
        if part.a is not part.b:
            rings.append(_ring(part.b, part.radius_b, eye.position))
        return np.concatenate(rings)
    return part.points


def _ring(centre: FloatArray, radius: float, eye: FloatArray) -> FloatArray:
    """The circle in which a ball shows to `eye`: across the line of sight."""
    sight = centre - eye
    sight = sight / np.linalg.norm(sight)
    side = np.cross(sight, (0.0, 0.0, 1.0))
    norm = float(np.linalg.norm(side))
    side = side / norm if norm > 1e-9 else np.array([1.0, 0.0, 0.0])
    up = np.cross(side, sight)
    ring: FloatArray = centre + radius * (_UNIT_RING @ np.stack([side, up]))
    return ring


def _draw(image: ImageArray, part: Part, pixels: FloatArray, eye: Eye, away: float) -> None:
    if isinstance(part, Wire):
        per_metre = eye.camera.lens.focal_px / eye.framing.scale / max(away, 0.1)
        thick = max(round(part.width_m * per_metre), 1)
        cv2.polylines(image, [_fixed(pixels)], part.closed, part.colour, thick, cv2.LINE_AA, _SHIFT)
        return
    if isinstance(part, Face):
        cv2.fillPoly(image, [_fixed(pixels)], part.colour, cv2.LINE_AA, _SHIFT)
        return
    hull = np.asarray(cv2.convexHull(pixels.astype(np.float32)), np.float64).reshape(-1, 2)
    cv2.fillPoly(image, [_fixed(hull)], tinted(part.colour, 0.78), cv2.LINE_AA, _SHIFT)
    size = float(np.ptp(hull, axis=0).min())
    if size > 3:
        # A lighter core, shifted toward the light: enough to read as round.
        core = hull.mean(axis=0) + (hull - hull.mean(axis=0)) * (0.62, 0.86)
        core = core + np.array([-0.10, -0.03]) * size
        cv2.fillPoly(image, [_fixed(core)], tinted(part.colour, 1.08), cv2.LINE_AA, _SHIFT)


def _fixed(points: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    return np.round(np.clip(points, -1e5, 1e5) * (1 << _SHIFT)).astype(np.int32)


Placer = Callable[[float, float, float], FloatArray]
"""Body coordinates (forward, left, up) in metres to the world [3]."""
