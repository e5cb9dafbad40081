"""Draws sprites, shadows and glows into a picture, in place."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from bikeped.lab.rendering.backdrop import Backdrop
from bikeped.lab.rendering.mesh import Lamp
from bikeped.lab.rendering.render_camera import SceneCamera
from bikeped.lab.rendering.sprite import Sprite, overlapping_slices
from bikeped.types import Float32Array, FloatArray, ImageArray

_EVEN = 0.04  #: vignettes that differ by less within a sprite are taken as one
_RING = np.linspace(0, 2 * np.pi, 17)[:-1]


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
