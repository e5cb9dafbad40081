"""Sensor noise, rain and glare over the whole picture."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np

from bikeped.lab.rendering.backdrop import Backdrop
from bikeped.types import ImageArray

_TILE = 512


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
            y0, x0 = max(top, 0), max(left, 0)
            y1, x1 = min(top + size_y, height), min(left + size_x, width)
            if y1 <= y0 or x1 <= x0:
                continue
            part = image[y0:y1, x0:x1]
            operation(part, tile[y0 - top : y1 - top, x0 - left : x1 - left], part)


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
