"""Draws sprites, shadows, glows, rain, glare and sensor noise into a picture, in place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import cv2
import numpy as np

from bikeped.lab.rendering.backdrop import Backdrop
from bikeped.lab.rendering.mesh import Lamp
from bikeped.lab.rendering.render_camera import SceneCamera
from bikeped.lab.rendering.sprite import Sprite, overlapping_slices
from bikeped.types import Float32Array, FloatArray, ImageArray

_EVEN = 0.04  #: vignettes that differ by less within a sprite are taken as one
_RING = np.linspace(0, 2 * np.pi, 17)[:-1]
_TILE = 512


def paste_sprite(image: ImageArray, street: Backdrop, sprite: Sprite) -> None:
    """Draws a sprite over the picture, darkened toward the lens' rim and paler in the distance."""
    height, width = sprite.alpha.shape
    spot = overlapping_slices(street.view.size, sprite.left, sprite.top, width, height)
    if spot is None:
        return
    rows, columns, patch_rows, patch_columns = spot
    part = image[rows, columns]
    alpha = sprite.alpha[patch_rows, patch_columns]
    kept = cv2.multiply(part, cv2.merge([255 - alpha] * 3), scale=1 / 255)
    colour = sprite.colour[patch_rows, patch_columns]
    haze = 1 - float(np.exp(-max(sprite.distance_m - 15, 0) / street.light.haze_m))
    if haze > 0.01:
        low = street.light.sky_low.astype(np.float32)
        pale = alpha[..., None].astype(np.float32) / 255 * low * haze
        colour = np.asarray(colour * (1 - haze) + pale, np.uint8)
    vignette = street.vignette[rows, columns]
    gain = float(vignette[vignette.shape[0] // 2, vignette.shape[1] // 2])
    if float(vignette.max() - vignette.min()) > _EVEN:
        # Near the rim a sprite is darker on the side toward it.
        lit = cv2.multiply(colour, cv2.merge([vignette] * 3), dtype=cv2.CV_8U)
        colour, gain = np.asarray(lit, np.uint8), 1.0
    part[:] = cv2.addWeighted(kept, 1.0, colour, gain, 0)


def darken(image: ImageArray, left: int, top: int, cover: Float32Array, keep: FloatArray) -> None:
    """Multiplies the picture by `keep` [3] where `cover` [h, w] at (`left`, `top`) is 1."""
    size = image.shape[1], image.shape[0]
    spot = overlapping_slices(size, left, top, cover.shape[1], cover.shape[0])
    if spot is None:
        return
    rows, columns, patch_rows, patch_columns = spot
    part = image[rows, columns]
    gain = 1 - cover[patch_rows, patch_columns, None] * (1 - keep.astype(np.float32))
    part[:] = cv2.multiply(part, gain, dtype=cv2.CV_8U)


def contact_shadow(
    view: SceneCamera, xy_m: FloatArray, size_m: tuple[float, float], heading_rad: float
) -> tuple[int, int, Float32Array] | None:
    """The soft patch below something of `size_m` (length, width): left, top, coverage [h, w]."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    ring = np.stack([size_m[0] * 0.55 * np.cos(_RING), size_m[1] * 0.62 * np.sin(_RING)], axis=1)
    flat = np.zeros((len(_RING), 3))
    flat[:, :2] = ring @ np.array([[c, s], [-s, c]]) + xy_m
    pixels = view.pixels(flat)
    if not np.isfinite(pixels).all():
        return None
    low = np.floor(pixels.min(axis=0)).astype(int) - 4
    high = np.ceil(pixels.max(axis=0)).astype(int) + 4
    if (high <= 0).any() or (low >= view.size).any() or (high - low > 3000).any():
        return None
    patch = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
    fixed = np.round((pixels - low - 0.5) * 16).astype(np.int32)
    cv2.fillPoly(patch, [fixed], 255, cv2.LINE_AA, 4)
    blur = max(int(min(patch.shape) * 0.12), 1) * 2 + 1
    soft = np.asarray(cv2.GaussianBlur(patch, (blur, blur), 0), np.float32) / np.float32(255)
    return int(low[0]), int(low[1]), soft


def add_glow(
    image: ImageArray, street: Backdrop, lamps: Sequence[Lamp], xy_m: FloatArray | None
) -> None:
    """Halos about lamps; those of a vehicle at `xy_m` only where they face the camera."""
    eye = street.view.eye_m
    dark = 1.0 if street.conditions.light == "night" else 0.5
    for lamp in lamps:
        if xy_m is not None and float((lamp.at[:2] - xy_m) @ (eye[:2] - lamp.at[:2])) < 0:
            continue
        pixel = street.view.pixels(lamp.at[None])[0]
        if not np.isfinite(pixel).all():
            continue
        away = float(np.linalg.norm(lamp.at - eye))
        radius = 0.75 * lamp.strength**0.5 * street.view.focal_px / max(away, 1.5)
        glow = _halo(min(radius, 220.0))
        r = glow.shape[0] // 2
        spot = overlapping_slices(
            street.view.size, int(pixel[0]) - r, int(pixel[1]) - r, 2 * r + 1, 2 * r + 1
        )
        if spot is None:
            continue
        rows, columns, patch_rows, patch_columns = spot
        light = glow[patch_rows, patch_columns, None] * np.array(lamp.colour, np.float32)
        part = image[rows, columns]
        part[:] = cv2.add(part, (light * dark).astype(np.uint8))


def _halo(radius_px: float) -> Float32Array:
    """A round glow [2r + 1, 2r + 1] falling from 1 to 0."""
    r = max(int(radius_px), 1)
    y, x = np.mgrid[-r : r + 1, -r : r + 1].astype(np.float32)
    return np.asarray(np.clip(1 - np.hypot(x, y) / r, 0, 1) ** 2.5, np.float32)


class Weather:
    """Applied to every picture in place; depends on the conditions and the time only."""

    def __init__(self, backdrop: Backdrop) -> None:
        self._backdrop = backdrop
        light = backdrop.light
        self._noise = _noise_tiles(round(light.noise, 1))
        self._rain = _rain_tiles(backdrop.view.size) if light.wet else None
        self._flare = _flare(backdrop) if light.glare > 0 and light.sun.any() else None

    def apply(self, image: ImageArray, t_s: float) -> None:
        """Adds rain, glare and noise as they are at `t_s`."""
        moment = round(t_s * 1000) & 0xFFFFFFFF
        rng = np.random.default_rng((self._backdrop.conditions.seed, moment))
        first, second, third, fourth = (int(v) for v in rng.integers(0, _TILE, 4))
        if self._rain is not None:
            _tiled(image, self._rain, (first, second), cv2.add)
        if self._flare is not None:
            cv2.add(image, self._flare, dst=image)
        plus, minus = self._noise
        _tiled(image, plus, (third, fourth), cv2.add)
        _tiled(image, minus, (third, fourth), cv2.subtract)


def _tiled(
    image: ImageArray,
    tile: ImageArray,
    offset: tuple[int, int],
    operation: Callable[[ImageArray, ImageArray, ImageArray], object],
) -> None:
    """Lays `tile` over the picture, beginning at its row and column `offset`."""
    height, width = image.shape[:2]
    size_y, size_x = tile.shape[:2]
    for top in range(-offset[0] % size_y - size_y, height, size_y):
        for left in range(-offset[1] % size_x - size_x, width, size_x):
            spot = overlapping_slices((width, height), left, top, size_x, size_y)
            if spot is not None:
                rows, columns, tile_rows, tile_columns = spot
                part = image[rows, columns]
                operation(part, tile[tile_rows, tile_columns], part)


@lru_cache(maxsize=8)
def _noise_tiles(deviation: float) -> tuple[ImageArray, ImageArray]:
    """Positive and negative noise [512, 512, 3], more in brightness than in colour."""
    rng = np.random.default_rng(4711)
    grey = rng.standard_normal((_TILE, _TILE, 1), np.float32)
    colour = rng.standard_normal((_TILE, _TILE, 3), np.float32)
    noise = deviation * (0.8 * grey + 0.6 * colour)
    plus, minus = (np.clip(np.round(part), 0, 255).astype(np.uint8) for part in (noise, -noise))
    return plus, minus


@lru_cache(maxsize=3)
def _rain_tiles(size: tuple[int, int]) -> ImageArray:
    """Streaks of falling drops [512, 512, 3], as long as the picture is large."""
    rng = np.random.default_rng(815)
    tile: ImageArray = np.zeros((_TILE, _TILE), np.uint8)
    unit = size[1] / 1080
    for _ in range(70):
        x, y = rng.uniform(0, _TILE, 2)
        long = float(rng.uniform(14, 46)) * max(unit, 0.4)
        bright = int(rng.uniform(18, 60))
        streak = np.zeros_like(tile)
        a = (int(x * 16), int(y * 16))
        b = (int((x + long * 0.12) * 16), int((y + long) * 16))
        cv2.line(streak, a, b, bright, 1, cv2.LINE_AA, 4)
        tile = np.asarray(cv2.add(tile, streak), np.uint8)
    return np.asarray(cv2.merge([np.asarray(cv2.GaussianBlur(tile, (3, 3), 0))] * 3), np.uint8)


def _flare(backdrop: Backdrop) -> ImageArray | None:
    """Veiling glare and ghosts of a sun in or near the picture."""
    view, light = backdrop.view, backdrop.light
    far = view.eye_m + light.to_sun * 1e4
    pixel = view.pixels(far[None])[0]
    if not np.isfinite(pixel).all():
        return None
    width, height = view.size
    small = (max(width // 4, 8), max(height // 4, 8))
    y, x = np.mgrid[0 : small[1], 0 : small[0]].astype(np.float32)
    x, y = x * (width / small[0]), y * (height / small[1])
    d = np.hypot(x - pixel[0], y - pixel[1]) / height
    veil = 34 + 190 * np.exp(-((d / 0.10) ** 1.0)) + 90 * np.exp(-d / 0.35)
    out = veil[..., None] * np.array([1.0, 0.95, 0.85], np.float32)
    centre = np.array([width / 2, height / 2])
    for part, radius, tone in (
        (-0.45, 0.035, (60, 90, 60)),
        (-0.8, 0.06, (70, 50, 90)),
        (0.4, 0.02, (90, 70, 40)),
    ):
        at = centre + (pixel - centre) * part
        ring = np.clip(1 - np.hypot(x - at[0], y - at[1]) / (radius * height), 0, 1)
        out += np.minimum(ring * 4, 1)[..., None] * np.array(tone, np.float32) * 0.4
    low = np.clip(out * light.glare, 0, 255).astype(np.uint8)
    flare = np.asarray(cv2.resize(low, (width, height)), np.uint8)
    flare[~backdrop.lit] = 0
    return flare
