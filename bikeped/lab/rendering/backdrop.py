"""The static part of a scene: sky, ground and houses, drawn once per camera and conditions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from bikeped.lab.rendering.conditions import Conditions, Lighting, lighting
from bikeped.lab.rendering.furniture import LAMP_HEAD_M, fixture, house
from bikeped.lab.rendering.ground_texture import GroundMap, ground_map, noise_tile
from bikeped.lab.rendering.mesh import Mesh, normals
from bikeped.lab.rendering.render_camera import Rays, SceneCamera, rays
from bikeped.lab.rendering.sprite import Sprite, rasterise, shade_faces
from bikeped.lab.rendering.street_layout import Fixture, StreetLayout, street_layout
from bikeped.types import BoolArray, Float32Array, FloatArray, ImageArray

_SHIFT = 4
_NEAR_M = 15.0
_FAR_M = 52.0
_SAMPLES = (-0.375, -0.125, 0.125, 0.375)


@dataclass(frozen=True)
class FixtureSprite:
    """A fixture in the picture."""

    item: Fixture
    mesh: Mesh
    sprite: Sprite


@dataclass(frozen=True)
class Backdrop:
    """`image` [h, w, 3]: sky, ground and houses; the fixtures (`standing`) are sprites, which can
    hide agents. `lit` [h, w]: inside the image circle."""

    view: SceneCamera
    conditions: Conditions
    light: Lighting
    layout: StreetLayout
    image: ImageArray
    lit: BoolArray
    vignette: Float32Array
    standing: tuple[FixtureSprite, ...]

    def lamplight(self, xy_m: FloatArray) -> FloatArray | None:
        """Light of the street lamps at a place on the ground [3]; None by day."""
        return _lamplight(self.layout, self.light, xy_m)


@lru_cache(maxsize=2)
def backdrop(view: SceneCamera, conditions: Conditions) -> Backdrop:
    """The backdrop; the last two are cached, for scenarios that share one."""
    light, ray = lighting(conditions), rays(view)
    layout = street_layout(conditions.place, conditions.clutter)
    canvas = _sky(ray, light, conditions)
    _ground(canvas, ray, view, layout, light)
    image = np.clip(canvas, 0, 255).astype(np.uint8)
    for item in sorted(layout.houses, key=lambda h: -abs(h.front) - abs((h.x0 + h.x1) / 2 - 5)):
        _draw_far(image, house(item, light.lamps), view, light)
    darkened = cv2.multiply(image, cv2.merge([ray.vignette] * 3), dtype=cv2.CV_8U)
    image = np.asarray(darkened, np.uint8)
    image[~ray.lit] = 0
    standing = []
    for thing in layout.fixtures:
        away = float(np.hypot(*(np.array(thing.xy_m) - view.eye_m[:2])))
        mesh = fixture(thing, away)
        local = _lamplight(layout, light, np.array(thing.xy_m))
        sprite = rasterise(mesh, view, light, local=local, distance_m=away)
        if sprite is not None:
            standing.append(FixtureSprite(thing, mesh, sprite))
    return Backdrop(view, conditions, light, layout, image, ray.lit, ray.vignette, tuple(standing))


def _sky(ray: Rays, light: Lighting, conditions: Conditions) -> Float32Array:
    """Sky colours [h, w, 3]: paler and hazier toward the horizon, with a flat layer of clouds."""
    width, height = ray.lit.shape[1], ray.lit.shape[0]
    half = (width // 2, height // 2)  # the sky is smooth
    world = np.asarray(cv2.resize(ray.world, half, interpolation=cv2.INTER_LINEAR), np.float32)
    up = np.clip(world[..., 2], 0, 1)
    part = ((1 - up) ** 3)[..., None]
    out = light.sky_top.astype(np.float32) * (1 - part) + light.sky_low.astype(np.float32) * part
    spread = 1 / (up + 0.12)
    shift = float(conditions.seed % 97)
    across, down = world[..., 0] * spread * 60 + shift, world[..., 1] * spread * 60
    cloud = _noise(conditions.place % 3, across, down)
    cover = np.clip(cloud * 0.35 + light.clouds - 0.45, 0, 0.8) * np.clip(up * 6, 0, 1)
    white = light.sky_low * 0.35 + 165 * light.ground / max(light.ground.max(), 0.9)
    white = np.clip(white, 0, 250)
    out += cover[..., None] * (white.astype(np.float32) - out)
    if light.sun.any():
        toward = np.clip(world @ light.to_sun.astype(np.float32), 0, 1)
        near = toward > 0.9
        glow = toward[near] ** 60 * 0.5 + toward[near] ** 900
        warm = np.array([1.0, 0.95, 0.8], np.float32)
        out[near] += (glow * (140 + 160 * light.glare))[:, None] * warm
    return np.asarray(cv2.resize(out, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _noise(seed: int, x: FloatArray | Float32Array, y: FloatArray | Float32Array) -> Float32Array:
    """The repeating noise tile read at columns `x` and rows `y`, of equal shape."""
    tile, wrap = noise_tile(seed), cv2.BORDER_WRAP
    read = cv2.remap(tile, x % 512, y % 512, cv2.INTER_LINEAR, borderMode=wrap)
    return np.asarray(read, np.float32)


def _ground(
    canvas: Float32Array, ray: Rays, view: SceneCamera, layout: StreetLayout, light: Lighting
) -> None:
    """Paints the ground into `canvas` below the horizon."""
    down = -ray.world[..., 2]
    rows = np.flatnonzero((down > 1e-3).any(axis=1))
    if len(rows) == 0:
        return
    top, bottom = int(rows[0]), int(rows[-1]) + 1
    w = ray.world[top:bottom]
    down = np.maximum(down[top:bottom], 1e-3)
    eye = view.eye_m.astype(np.float32)
    reach = eye[2] / down  # slant distance
    x, y = eye[0] + w[..., 0] * reach, eye[1] + w[..., 1] * reach
    away = np.hypot(x - eye[0], y - eye[1])
    inverse = 1 / np.maximum(away, 1e-3)
    # One pixel's depth on the ground, along the line of sight.
    deep = reach * reach / (eye[2] * view.focal_px)
    along = (x - eye[0]) * inverse * deep, (y - eye[1]) * inverse * deep
    fine = float(np.clip(2.2 / view.focal_px * 4.0, 0.012, 0.05))
    near = ground_map(layout, eye[0] - 16, eye[1] - 3, eye[0] + 16, eye[1] + 17, fine)
    far = ground_map(layout, eye[0] - 56, eye[1] - 28, eye[0] + 56, eye[1] + 50, 0.08)
    blurred = GroundMap(np.asarray(cv2.blur(far.image, (9, 9)), np.uint8), far.x0, far.y0, far.res)
    at_far = _sample_map(far, x, y, along, _SAMPLES)
    at_horizon = _sample_map(blurred, x, y, along, (0.0,))
    t = np.clip((away - 26) / 14, 0, 1)[..., None]
    out = at_far * (1 - t) + at_horizon * t
    at_near = _sample_map(near, x, y, along, (-0.25, 0.25))
    t = np.clip((_NEAR_M - away) / 3, 0, 1)[..., None]
    out += t * (at_near - out)
    lit: FloatArray | Float32Array = light.ground.astype(np.float32)
    if light.lamps:
        lit = lit + _lamp_pools(layout, np.dstack([x, y]))
    if light.wet:
        out *= 0.62
    out *= lit
    if light.wet:  # a wet road mirrors the sky, the flatter the more
        shine = 0.10 + 0.75 * (1 - down) ** 5
        patch = _noise(1, x * 24, y * 24) * np.clip(1.5 / deep, 0, 1)
        shine = np.clip(shine * (0.75 + 0.3 * patch), 0, 0.85)[..., None]
        out += shine * (light.sky_low.astype(np.float32) * 0.9 - out)
    haze = (1 - np.exp(-np.maximum(away - 15, 0) / light.haze_m))[..., None]
    out += haze * (light.sky_low.astype(np.float32) - out)
    below = (-ray.world[top:bottom, :, 2] > 1e-3)[..., None]
    np.copyto(canvas[top:bottom], out, where=below)


def _sample_map(
    source: GroundMap,
    x: Float32Array,
    y: Float32Array,
    along: tuple[Float32Array, Float32Array],
    offsets: tuple[float, ...],
) -> Float32Array:
    """The map's colours at ground positions, averaged over points `offsets` of the pixel's depth;
    beyond its edges the edge goes on."""
    total = np.zeros((*x.shape, 3), np.float32)
    for offset in offsets:
        u = (x + along[0] * offset - source.x0) / source.res - 0.5
        v = (y + along[1] * offset - source.y0) / source.res - 0.5
        part = cv2.remap(source.image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        total += np.asarray(part, np.uint8)
    return total / np.float32(len(offsets))


def _lamplight(layout: StreetLayout, light: Lighting, xy_m: FloatArray) -> FloatArray | None:
    if not light.lamps:
        return None
    return np.asarray(_lamp_pools(layout, xy_m.astype(np.float32)[None])[0], np.float64)


def _lamp_pools(layout: StreetLayout, xy: Float32Array) -> Float32Array:
    """Light of the street lamps at ground positions [..., 2] as factors [..., 3]."""
    out = np.zeros((*xy.shape[:-1], 3), np.float32)
    colour = np.array([0.98, 0.80, 0.54], np.float32)
    reach, high = LAMP_HEAD_M
    for item in layout.fixtures:
        if item.what != "lamp":
            continue
        lx = item.xy_m[0] + reach * np.cos(item.heading_rad)
        ly = item.xy_m[1] + reach * np.sin(item.heading_rad)
        sq = (xy[..., 0] - lx) ** 2 + (xy[..., 1] - ly) ** 2
        out += ((high**2 / (sq + high**2)) ** 1.8)[..., None] * colour
    # The lamp above the camera's own pole.
    sq = (xy[..., 0] - 5) ** 2 + (xy[..., 1] + 9) ** 2
    out += ((30 / (sq + 30)) ** 1.5)[..., None] * colour * 0.8
    return out


def _draw_far(image: ImageArray, mesh: Mesh, view: SceneCamera, light: Lighting) -> None:
    """Draws a solid of the background straight into the picture, its edges smoothed."""
    quads = mesh.quads
    normal = normals(quads)
    middle = quads.mean(axis=1)
    facing = np.flatnonzero(((view.eye_m - middle) * normal).sum(1) > 0)
    if len(facing) == 0:
        return
    pixels = view.pixels(quads[facing].reshape(-1, 3)).reshape(-1, 4, 2)
    width, height = view.size
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(pixels).all(axis=(1, 2)) & (pixels.max(axis=1) > 0).all(axis=1)
        seen &= (pixels.min(axis=1) < (width, height)).all(axis=1)
    kept = facing[seen]
    away = np.linalg.norm(middle[kept] - view.eye_m, axis=1)
    haze = (1 - np.exp(-np.maximum(away - 15, 0) / light.haze_m))[:, None]
    colour = shade_faces(
        mesh, normal, kept, light, np.array([0.2, 0.17, 0.12]) if light.lamps else None
    )
    colour += haze * (light.sky_low - colour)
    fixed = np.round((pixels[seen] - 0.5).clip(-1e6, 1e6) * (1 << _SHIFT)).astype(np.int32)
    for i in np.argsort(mesh.layer[kept], kind="stable"):
        cv2.fillConvexPoly(image, fixed[i], colour[i].tolist(), cv2.LINE_AA, _SHIFT)
