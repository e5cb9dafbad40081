"""The street of the drawn scenes: a road along the world's x axis, a zebra crossing at x = 5.

Every pixel is mapped back to the ground once, and its colour computed there with edges as soft as
the pixel is wide, so that markings stay clean from the kerb at the camera's feet to the horizon.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from bikeped.demo.pen import Eye, Face, Limb, Part, Rgb, facing, paint, subdivided, tinted
from bikeped.types import BoolArray, Float32Array, FloatArray, ImageArray

#: Where things lie, in world metres.
CROSSING_X = (3.4, 6.6)
KERBS_Y = (-8.5, 4.5)
BIKE_LANES_Y = ((-8.5, -6.7), (2.7, 4.5))
CENTRE_Y = -2.0
WALKS_Y = ((-17.0, -8.5), (4.5, 8.8))
#: A paved way between the houses, north of the road.
PASSAGE_X = (-3.6, 0.2)

_ASPHALT = (94.0, 97.0, 102.0)
_BIKE_LANE = (82.0, 118.0, 100.0)
_PAVING = (172.0, 168.0, 160.0)
_GRASS = (104.0, 132.0, 74.0)
_WHITE = (232.0, 233.0, 228.0)
_YELLOW = (226.0, 182.0, 64.0)
_HAZE = (206.0, 216.0, 224.0)


def background(eye: Eye, width: int, height: int) -> tuple[ImageArray, BoolArray]:
    """The empty street as the camera sees it [h, w, 3], and where the lens reaches [h, w]."""
    image: ImageArray = np.zeros((height, width, 3), np.uint8)
    lit: BoolArray = np.zeros((height, width), np.bool_)
    noise = _noise()
    rows = 120  # bounds the memory of the temporary arrays
    for top in range(0, height, rows):
        count = min(rows, height - top)
        image[top : top + count], lit[top : top + count] = _strip(eye, width, top, count, noise)
    for solid in _skyline(eye):
        paint(image, eye, solid)
    image[~lit] = 0
    return image, lit


def _strip(
    eye: Eye, width: int, top: int, count: int, noise: Float32Array
) -> tuple[ImageArray, BoolArray]:
    """Ground and sky of `count` rows. One row and column more are computed, for the footprints."""
    v, u = np.mgrid[top : top + count + 1, 0 : width + 1].astype(np.float64)
    crop = eye.framing.frame_to_crop(np.stack([u, v], axis=-1))
    ray = eye.camera.rays(crop)
    lit = np.isfinite(ray[:-1, :-1, 0])
    down = ray[..., 2] < -1e-3
    reach = np.where(down, -eye.camera.height_m / np.where(down, ray[..., 2], 1.0), 1e4)
    world = eye.pose.ground_to_world(ray[..., :2] * reach[..., None])
    world = np.nan_to_num(world, nan=1e4)
    x, y = world[..., 0].astype(np.float32), world[..., 1].astype(np.float32)
    # The pixel's footprint on the ground along each world axis.
    fx = np.abs(np.diff(x, axis=1)[:-1]) + np.abs(np.diff(x, axis=0)[:, :-1]) + 1e-3
    fy = np.abs(np.diff(y, axis=1)[:-1]) + np.abs(np.diff(y, axis=0)[:, :-1]) + 1e-3
    ground = _ground(x[:-1, :-1], y[:-1, :-1], fx, fy, noise)
    away = np.minimum(reach[:-1, :-1], 400.0).astype(np.float32)
    _over(ground, 1 - np.exp(-np.maximum(away - 12, 0) / 110), _HAZE)
    world_ray = np.nan_to_num(eye.pose.ground_to_world(ray[:-1, :-1, :2])) - (
        eye.pose.x_m,
        eye.pose.y_m,
    )
    sky = _sky(world_ray, np.nan_to_num(ray[:-1, :-1, 2]), noise)
    out = np.where(down[:-1, :-1, None], ground, sky)
    out[~lit] = 0
    return np.clip(out, 0, 255).astype(np.uint8), lit


def _ground(
    x: Float32Array, y: Float32Array, fx: Float32Array, fy: Float32Array, noise: Float32Array
) -> Float32Array:
    """Colours [h, w, 3] of ground positions; `fx`, `fy` are the widths of soft edges."""
    out = np.empty((*x.shape, 3), np.float32)
    out[:] = _GRASS
    coarse = _sample(noise, x, y, 9.0)
    fine = _sample(noise, x, y, 2.3) * np.clip(0.25 / (fx + fy), 0, 1)
    for low, high in WALKS_Y:
        walk = _span(y, low, high, fy)
        _over(out, walk, _PAVING)
        for along, foot in ((x, fx), (y, fy)):
            joint = _comb(along, 0.9, 0.03, foot)
            _over(out, 0.3 * walk * joint, (96.0, 92.0, 86.0))
    way = _span(x, *PASSAGE_X, fx) * _span(y, WALKS_Y[1][1], 60.0, fy)
    _over(out, way, tuple(0.93 * c for c in _PAVING))
    road = _span(y, *KERBS_Y, fy)
    _over(out, road, _ASPHALT)
    for low, high in BIKE_LANES_Y:
        _over(out, 0.85 * _span(y, low, high, fy), _BIKE_LANE)
    # Wheel tracks are a little darker, as on any road in use.
    for middle in (-5.6, -3.4, -0.9, 1.4):
        _over(out, 0.16 * np.exp(-(((y - middle) / 0.32) ** 2)), (50.0, 52.0, 56.0))
    off = 1 - _span(x, CROSSING_X[0] - 1.6, CROSSING_X[1] + 1.6, fx)
    for line in (BIKE_LANES_Y[0][1], BIKE_LANES_Y[1][0]):
        _over(out, off * _span(y, line - 0.06, line + 0.06, fy), _WHITE)
    for line in (CENTRE_Y - 0.14, CENTRE_Y + 0.14):
        _over(out, off * _span(y, line - 0.05, line + 0.05, fy), _YELLOW)
    bars = _comb(y - KERBS_Y[0] - 0.35, 1.0, 0.5, fy) * _span(
        y, KERBS_Y[0] + 0.1, KERBS_Y[1] - 0.1, fy
    )
    worn = 0.93 - 0.12 * np.clip(coarse, 0, 1)
    _over(out, worn * bars * _span(x, *CROSSING_X, fx), _WHITE)
    for side, low, high in (
        (CROSSING_X[0] - 1.4, KERBS_Y[0], CENTRE_Y - 0.2),
        (CROSSING_X[1] + 1.0, CENTRE_Y + 0.2, KERBS_Y[1]),
    ):
        _over(out, 0.92 * _span(x, side, side + 0.4, fx) * _span(y, low, high, fy), _WHITE)
    for low, high in (
        (KERBS_Y[0] - 0.75, KERBS_Y[0] - 0.15),
        (KERBS_Y[1] + 0.15, KERBS_Y[1] + 0.75),
    ):
        pad = _span(x, *CROSSING_X, fx) * _span(y, low, high, fy)
        _over(out, 0.85 * pad, (214.0, 176.0, 84.0))
        dots = _comb(x, 0.15, 0.06, fx) * _comb(y, 0.15, 0.06, fy)
        _over(out, 0.35 * pad * dots, (130.0, 104.0, 40.0))
    for edge in KERBS_Y:
        _over(out, _span(y, edge - 0.09, edge + 0.09, fy), (196.0, 194.0, 188.0))
    cover = np.clip(0.5 - (np.hypot(x + 2.0, y + 4.4) - 0.36) / (fx + fy), 0, 1)
    _over(out, 0.7 * cover, (58.0, 60.0, 62.0))
    out *= (1 + 0.06 * coarse + 0.045 * fine)[..., None]
    return out


def _sky(direction: FloatArray, up: FloatArray, noise: Float32Array) -> Float32Array:
    """Sky colours by ray: pale at the horizon, blue above, with thin clouds."""
    rise = np.clip(up, 0, 1).astype(np.float32)[..., None]
    blue = np.array((98.0, 150.0, 206.0), np.float32)
    out = np.array(_HAZE, np.float32) * (1 - rise) ** 2 + blue * (1 - (1 - rise) ** 2)
    # Clouds lie in a flat layer, so that they gather toward the horizon as real ones do.
    spread = 1 / (np.maximum(up, 0) + 0.12)
    cx = (direction[..., 0] * spread).astype(np.float32)
    cy = (direction[..., 1] * spread).astype(np.float32)
    cloud = _sample(noise, cx, cy, 9.0) + 0.5 * _sample(noise, cx, cy, 3.5)
    cover = np.clip(cloud * 0.9 - 0.15, 0, 0.75) * np.clip(up * 5, 0, 1).astype(np.float32)
    _over(out, cover, (246.0, 248.0, 250.0))
    return out


def _noise() -> Float32Array:
    """A tile [256, 256] of smooth noise in about -1..1 that repeats without a seam."""
    rng = np.random.default_rng(20240607)
    total = np.zeros((256, 256), np.float32)
    for cells, weight in ((8, 1.0), (16, 0.6), (32, 0.4), (64, 0.3)):
        grid = rng.standard_normal((cells, cells)).astype(np.float32)
        ring = np.pad(grid, 2, mode="wrap")
        k = 256 // cells
        big = np.asarray(cv2.resize(ring, None, fx=k, fy=k, interpolation=cv2.INTER_CUBIC))
        total += weight * big[2 * k : 2 * k + 256, 2 * k : 2 * k + 256]
    scaled: Float32Array = (total / (2 * total.std())).astype(np.float32)
    return scaled


def _sample(noise: Float32Array, x: Float32Array, y: Float32Array, size_m: float) -> Float32Array:
    """The noise at ground positions, one tile every `size_m` metres."""
    u = np.mod(x / size_m, 1.0).astype(np.float32) * 256
    v = np.mod(y / size_m, 1.0).astype(np.float32) * 256
    return np.asarray(
        cv2.remap(noise, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.float32
    )


def _span(at: Float32Array, low: float, high: float, soft: Float32Array) -> Float32Array:
    """Share of a pixel of width `soft` at `at` that lies within low..high."""
    top = np.minimum(at + soft / 2, high)
    bottom = np.maximum(at - soft / 2, low)
    share: Float32Array = np.clip((top - bottom) / soft, 0, 1)
    return share


def _comb(at: Float32Array, period: float, width: float, soft: Float32Array) -> Float32Array:
    """The same for bars of `width` every `period`; far off it fades to their mean."""
    phase = np.mod(at + period / 2, period) - period / 2
    near = _span(phase, -width / 2, width / 2, soft)
    fade = np.clip(soft / period * 2 - 1, 0, 1)
    share: Float32Array = near * (1 - fade) + width / period * fade
    return share


def _over(image: Float32Array, share: Float32Array | FloatArray, colour: Sequence[float]) -> None:
    """Paints `colour` over `image` in place where `share` [h, w] says so."""
    image += share[..., None].astype(np.float32) * (np.array(colour, np.float32) - image)


def _skyline(eye: Eye) -> list[list[Part]]:
    """Houses, trees and lamps along the street, far ones first."""
    rng = np.random.default_rng(7)
    solids: list[tuple[float, list[Part]]] = []
    walls: tuple[Rgb, ...] = (
        (176, 124, 98),
        (206, 192, 168),
        (150, 158, 166),
        (188, 150, 110),
        (128, 104, 96),
        (214, 206, 196),
    )
    x = -118.0
    number = 0
    while x < 130:
        wide, tall = float(rng.uniform(7, 13)), float(rng.uniform(6.0, 12.5))
        if x < PASSAGE_X[1] and x + wide > PASSAGE_X[0]:
            wide = PASSAGE_X[0] - x
        front = 13.0 + float(rng.uniform(0, 1.5))
        centre = np.array([x + wide / 2, front + 5, 0.0])
        colour = walls[number % len(walls)]
        house = _house(x, x + wide, front, front + 10, tall, colour, eye)
        solids.append((float(np.hypot(*(centre - eye.position)[:2])), house))
        x += wide + (float(rng.uniform(2.5, 5.0)) if number % 3 == 2 else 0.15)
        number += 1
        if PASSAGE_X[0] - 5 < x < PASSAGE_X[1]:
            x = PASSAGE_X[1]
    for tree_x in np.arange(-85.0, 95.0, 9.5).tolist():
        at = np.array([tree_x + float(rng.uniform(-1, 1)), 10.6, 0.0])
        if not PASSAGE_X[0] - 1 < at[0] < PASSAGE_X[1] + 1:
            solids.append((float(np.hypot(*(at - eye.position)[:2])), _tree(at, rng)))
    for lamp_x in (-54.0, -32.0, -10.0, 14.0, 36.0, 58.0):
        at = np.array([lamp_x, 5.3, 0.0])
        solids.append((float(np.hypot(*(at - eye.position)[:2])), _lamp(at)))
    return [parts for _, parts in sorted(solids, key=lambda item: -item[0])]


def _house(
    x0: float, x1: float, y0: float, y1: float, tall: float, colour: Rgb, eye: Eye
) -> list[Part]:
    """A block with rows of windows toward the street and a door."""
    z = -0.05

    def wall(a: tuple[float, float], b: tuple[float, float], shade: float) -> Face:
        corners = [(*a, z), (*b, z), (*b, tall), (*a, tall)]
        return Face(np.array(corners), tinted(colour, shade))

    parts = [
        wall((x0, y0), (x1, y0), 1.0),
        wall((x1, y0), (x1, y1), 0.72),
        wall((x0, y1), (x0, y0), 0.84),
    ]
    band = [
        (x0, y0 - 0.02, tall - 0.5),
        (x1, y0 - 0.02, tall - 0.5),
        (x1, y0 - 0.02, tall),
        (x0, y0 - 0.02, tall),
    ]
    parts.append(Face(np.array(band), tinted(colour, 0.7), layer=1))
    columns = int((x1 - x0) // 2.4)
    pitch = (x1 - x0) / columns
    floors = int((tall - 1.0) // 2.9)
    for floor in range(floors):
        for column in range(columns):
            middle = x0 + (column + 0.5) * pitch
            low = 1.0 + floor * 2.9
            door = floor == 0 and column == columns // 2
            half, bottom, top = (0.55, 0.0, 2.2) if door else (0.6, low, low + 1.5)
            for grow, shade, layer in (
                (0.1, (226, 222, 212), 1),
                (0.0, (74, 52, 44) if door else (70, 90, 108), 2),
            ):
                w = half + grow
                quad = [
                    (middle - w, bottom - grow),
                    (middle + w, bottom - grow),
                    (middle + w, top + grow),
                    (middle - w, top + grow),
                ]
                parts.append(
                    Face(np.array([(a, y0 - 0.01, b) for a, b in quad]), shade, layer=layer)
                )
    return [
        Face(subdivided(part.points, 12 if part.layer < 2 else 2), part.colour, part.layer)
        for part in parts
        if facing(part.points, eye.position)
    ]


def _above(at: FloatArray, up: float) -> FloatArray:
    out: FloatArray = at + np.array([0.0, 0.0, up])
    return out


def _tree(at: FloatArray, rng: np.random.Generator) -> list[Part]:
    tall = float(rng.uniform(4.6, 6.4))
    parts: list[Part] = [Limb(at, _above(at, tall * 0.6), 0.17, 0.1, (92, 72, 56))]
    for _ in range(22):
        offset = rng.normal(0, 1, 3) * (0.75, 0.75, 0.7)
        centre = _above(at, tall * 0.78) + offset
        green = (int(rng.integers(58, 96)), int(rng.integers(104, 138)), int(rng.integers(46, 70)))
        parts.append(Limb(centre, centre, 0.75, 0.75, green))
    return parts


def _lamp(at: FloatArray) -> list[Part]:
    grey: Rgb = (84, 90, 96)
    head = at + np.array([0, -1.1, 6.3])
    return [
        Limb(at, _above(at, 6.2), 0.08, 0.05, grey),
        Limb(_above(at, 6.2), head, 0.045, 0.04, grey),
        Limb(head, head + np.array([0, -0.5, 0]), 0.1, 0.07, (210, 212, 206)),
    ]
