"""Maps of the ground from above: roads, markings, kerbs and paving."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from bikeped.lab.rendering.mesh import Rgb
from bikeped.lab.rendering.street_layout import StreetLayout
from bikeped.types import Float32Array, FloatArray, ImageArray

_WHITE: Rgb = (228, 229, 224)
_YELLOW: Rgb = (222, 176, 60)
_SHIFT = 4


@dataclass(frozen=True)
class GroundMap:
    """`image` [h, w, 3]: what reflects at x0 + column * res, y0 + row * res (metres)."""

    image: ImageArray
    x0: float
    y0: float
    res: float


@lru_cache(maxsize=4)
def noise_tile(seed: int, size: int = 512) -> Float32Array:
    """Smooth noise [size, size] of about unit deviation that repeats without a seam."""
    rng = np.random.default_rng((seed, 77))
    total = np.zeros((size, size), np.float32)
    for cells, weight in ((8, 1.0), (16, 0.7), (32, 0.5), (64, 0.4), (128, 0.35), (256, 0.3)):
        grid = rng.standard_normal((cells, cells)).astype(np.float32)
        ring = np.pad(grid, 2, mode="wrap")
        k = size // cells
        big = np.asarray(cv2.resize(ring, None, fx=k, fy=k, interpolation=cv2.INTER_CUBIC))
        total += weight * big[2 * k : 2 * k + size, 2 * k : 2 * k + size]
    return np.asarray(total / total.std(), np.float32)


class MapCanvas:
    """Draws in metres on a map."""

    def __init__(self, image: ImageArray, x0: float, y0: float, res: float) -> None:
        self.image, self.x0, self.y0, self.res = image, x0, y0, res

    def _pixels(self, points: list[tuple[float, float]]) -> FloatArray:
        return np.asarray((np.array(points) - (self.x0, self.y0)) / self.res - 0.5)

    def rect(
        self, x0: float, y0: float, x1: float, y1: float, colour: Rgb, share: float = 1.0
    ) -> None:
        self.poly([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], colour, share)

    def poly(self, points: list[tuple[float, float]], colour: Rgb, share: float = 1.0) -> None:
        at = self._pixels(points)
        low = np.maximum(np.floor(at.min(axis=0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(at.max(axis=0)).astype(int) + 2, self.image.shape[1::-1])
        if (high <= low).any():
            return
        part = self.image[low[1] : high[1], low[0] : high[0]]
        fixed = np.round((at - low).clip(-1e5, 1e5) * (1 << _SHIFT)).astype(np.int32)
        flat = part.copy()
        cv2.fillPoly(flat, [fixed], colour, cv2.LINE_AA, _SHIFT)
        part[:] = flat if share >= 1 else cv2.addWeighted(flat, share, part, 1 - share, 0)

    def line(self, points: list[tuple[float, float]], wide_m: float, colour: Rgb) -> None:
        at = self._pixels(points)
        fixed = np.round(at.clip(-1e5, 1e5) * (1 << _SHIFT)).astype(np.int32)
        thick = max(round(wide_m / self.res), 1)
        cv2.polylines(self.image, [fixed], False, colour, thick, cv2.LINE_AA, _SHIFT)


def ground_map(
    layout: StreetLayout, x0: float, y0: float, x1: float, y1: float, res: float
) -> GroundMap:
    """The map of a rectangle of the world at `res` metres a pixel."""
    width, height = int((x1 - x0) / res), int((y1 - y0) / res)
    image: ImageArray = np.empty((height, width, 3), np.uint8)
    image[:] = layout.verge
    canvas = MapCanvas(image, x0, y0, res)
    _surfaces(canvas, layout, x0, x1, y0, y1)
    _markings(canvas, layout, x0, x1)
    _wear(canvas, layout)
    return GroundMap(_textured(image, layout, res), x0, y0, res)


def _surfaces(
    canvas: MapCanvas, layout: StreetLayout, x0: float, x1: float, y0: float, y1: float
) -> None:
    k, edge = layout.kerb, layout.kerb + layout.walk
    fine = canvas.res < 0.05
    # South of the road the paving reaches to the camera's pole and beyond.
    south = -edge - (5.5 if layout.number % 3 == 0 else 2.0)
    for low, high in ((south, -k), (k, edge)):
        canvas.rect(x0, low, x1, high, layout.paving)
        if fine:
            joint: Rgb = tuple(c * 0.8 for c in layout.paving)  # type: ignore[assignment]
            for x in np.arange(x0 - x0 % layout.slab_m, x1, layout.slab_m).tolist():
                canvas.line([(x, low), (x, high)], 0.02, joint)
            for y in np.arange(low, high, layout.slab_m).tolist():
                canvas.line([(x0, y), (x1, y)], 0.02, joint)
    dark: Rgb = tuple(c * 0.92 for c in layout.asphalt)  # type: ignore[assignment]
    canvas.rect(x0, -k, x1, k, layout.asphalt)
    if layout.side_street is not None:
        a, c = layout.side_street
        # South of the road it is a narrow lane, or the street goes on.
        canvas.rect(a, k - 0.1, c, y1, layout.asphalt)
        canvas.rect(a, y0, c, -k + 0.1, layout.asphalt)
        for x in (a, c):
            for low, high in ((y0, -k), (k, y1)):
                canvas.rect(x - 0.1, low, x + 0.1, high, (190, 188, 182))
    for x_a, x_b in _off_side(layout, x0, x1):
        for y, way in ((k, 1), (-k, -1)):
            canvas.rect(x_a, y - 0.02, x_b, y + 0.16 * way, (192, 190, 184))
            canvas.rect(x_a, y - 0.28 * way, x_b, y - 0.02, dark)
    for y in (-0.62 * k, -0.28 * k, 0.28 * k, 0.62 * k):  # wheel tracks
        for d in (-0.75, 0.75):
            canvas.rect(x0, y + d - 0.25, x1, y + d + 0.25, dark, 0.5)


def _off_side(layout: StreetLayout, x0: float, x1: float) -> list[tuple[float, float]]:
    if layout.side_street is None:
        return [(x0, x1)]
    return [(x0, layout.side_street[0]), (layout.side_street[1], x1)]


def _markings(canvas: MapCanvas, layout: StreetLayout, x0: float, x1: float) -> None:
    k, lane = layout.kerb, layout.lane_m
    c0, c1 = layout.crosswalk
    spans = [
        span
        for a, b in _off_side(layout, x0, x1)
        for span in ((a, min(b, c0 - 1.9)), (max(a, c1 + 1.9), b))
        if span[1] > span[0]
    ]
    for a, b in spans:
        if layout.bike_lanes:
            for way in (1, -1):
                inner, outer = way * lane, way * (lane + 1.9)
                if layout.green_lanes:
                    low, high = sorted((inner, outer))
                    canvas.rect(a, low, b, high, (84, 132, 104), 0.75)
                for y in (inner, outer) if lane + 1.9 < k - 0.5 else (inner,):
                    canvas.rect(a, y - 0.06, b, y + 0.06, _WHITE)
        centre = _YELLOW if layout.yellow_centre else _WHITE
        if layout.yellow_centre:
            for y in (-0.14, 0.14):
                canvas.rect(a, y - 0.05, b, y + 0.05, centre)
        else:
            for x in np.arange(np.ceil(a / 4) * 4, b - 2, 4.0).tolist():
                canvas.rect(x, -0.06, x + 2, 0.06, centre)
    share = 0.55 if layout.crosswalk_style == "worn" else 0.95
    if layout.crosswalk_style in {"bars", "ladder", "worn"}:
        for y in np.arange(-k + 0.45, k - 0.6, 1.0).tolist():
            canvas.rect(c0, y, c1, y + 0.5, _WHITE, share)
    if layout.crosswalk_style in {"ladder", "lines"}:
        for x in (c0 - 0.3, c1):
            canvas.rect(x, -k + 0.1, x + 0.3, k - 0.1, _WHITE, share)
    canvas.rect(c0 - 1.6, -k + 0.1, c0 - 1.2, -0.25, _WHITE, 0.9)
    canvas.rect(c1 + 1.2, 0.25, c1 + 1.6, k - 0.1, _WHITE, 0.9)
    for y0, y1 in ((-k - 0.85, -k - 0.2), (k + 0.2, k + 0.85)):
        canvas.rect(c0, y0, c1, y1, (206, 168, 80))
        if canvas.res < 0.03:
            for x in np.arange(c0 + 0.08, c1, 0.16).tolist():
                canvas.line([(x, y0), (x, y1)], 0.04, (176, 140, 62))
    if layout.bike_lanes:
        for x in (-12.0, 12.5, 26.0):
            for way in (1, -1):
                _bicycle_sign(canvas, x, way * (lane + 0.95), -way)


def _bicycle_sign(canvas: MapCanvas, x: float, y: float, way: int) -> None:
    """The painted bicycle, 1.8 m long."""
    turn = np.linspace(0, 2 * np.pi, 20)
    for hub in (-0.5, 0.5):
        ring = [(x + way * (hub + 0.32 * np.cos(a)), y + 0.32 * np.sin(a)) for a in turn]
        canvas.line(ring, 0.07, _WHITE)
    low, crank, bar, seat = (-0.5, 0), (-0.1, 0.05), (0.35, 0.5), (-0.2, 0.5)
    frame = (low, crank, bar, seat, low, seat, crank)
    canvas.line([(x + way * a, y + way * b) for a, b in frame], 0.07, _WHITE)
    canvas.line([(x + way * 0.5, y), (x + way * 0.32, y + way * 0.68)], 0.07, _WHITE)


def _wear(canvas: MapCanvas, layout: StreetLayout) -> None:
    """Manholes, patches, cracks and stains."""
    rng = np.random.default_rng((layout.number, 31))
    k = layout.kerb
    for _ in range(7):
        x, y = float(rng.uniform(-22, 32)), float(rng.uniform(-k + 0.6, k - 0.6))
        w, h = float(rng.uniform(0.8, 4.5)), float(rng.uniform(0.6, 1.6))
        tone = float(rng.uniform(0.8, 1.12))
        canvas.rect(x, y, x + w, y + h, tuple(c * tone for c in layout.asphalt), 0.5)  # type: ignore[arg-type]
    turn = np.linspace(0, 2 * np.pi, 24)
    for _ in range(5):
        x, y = float(rng.uniform(-16, 26)), float(rng.uniform(-k - 2, k))
        disc = [(x + 0.34 * np.cos(a), y + 0.34 * np.sin(a)) for a in turn]
        canvas.poly(disc, (64, 64, 66), 0.85)
    for _ in range(14):
        x, y = float(rng.uniform(-20, 30)), float(rng.uniform(-k, k))
        way = float(rng.uniform(0, 2 * np.pi))
        path = [(x, y)]
        for _ in range(9):
            way += float(rng.normal(0, 0.5))
            x, y = x + 0.35 * float(np.cos(way)), y + 0.35 * float(np.sin(way))
            if abs(y) > k:
                break
            path.append((x, y))
        if len(path) > 1:
            canvas.line(path, 0.02, (66, 67, 70))
    for _ in range(60):
        x, y = float(rng.uniform(-20, 30)), float(rng.uniform(-12, 12))
        r = float(rng.uniform(0.04, 0.35))
        blob = [(x + r * np.cos(a) * rng.uniform(0.6, 1), y + r * np.sin(a)) for a in turn[::2]]
        canvas.poly(blob, (70, 68, 64), float(rng.uniform(0.08, 0.3)))


def _textured(image: ImageArray, layout: StreetLayout, res: float) -> ImageArray:
    """Grain and large stains, by multiplication."""
    height, width = image.shape[:2]
    tile = noise_tile(layout.number % 3)
    repeat = (-(-height // 512), -(-width // 512))
    grain = np.clip(1.0 + 0.05 * tile, 0.7, 1.3)
    rows = np.random.default_rng(layout.number).integers(0, 512, 2)
    grain = np.tile(np.roll(grain, tuple(rows.tolist()), (0, 1)), repeat)[:height, :width]
    # Stains of some metres: the same noise, drawn large.
    part_y, part_x = (min(max(int(n * res * 2), 8), 512) for n in (height, width))
    part = np.ascontiguousarray(tile[:part_y, :part_x])
    big = np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_LINEAR))
    grain = grain + 0.035 * np.clip(big, -2.5, 2.5)
    return np.asarray(cv2.multiply(image, cv2.merge([grain] * 3), dtype=cv2.CV_8U), np.uint8)
