"""Palette and drawing primitives on RGB pictures (uint8 [h, w, 3]), changed in place.

The kind colours are from Okabe and Ito's palette, which people with any colour vision tell apart;
the state colours are the light's own. Neither is ever used without its word.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
import simplejpeg

from bikeped.geometry.boxes import intersection_area
from bikeped.types import FloatArray, ImageArray, Kind

Rgb = tuple[int, int, int]
Rect = tuple[float, float, float, float]  #: x0, y0, x1, y1

KIND_COLOUR: dict[Kind, Rgb] = {
    Kind.PEDESTRIAN: (240, 228, 66),
    Kind.CYCLIST: (86, 200, 245),
    Kind.VEHICLE: (214, 140, 182),
}
SIGNAL_COLOUR: dict[str, Rgb] = {
    "IDLE": (0, 100, 170),
    "SAFE": (0, 128, 92),
    "WARNING": (240, 160, 0),
    "ALERT": (205, 28, 28),
    "FAULT": (240, 140, 0),
    "OFF": (84, 88, 94),
}
INK: Rgb = (16, 20, 26)
PAPER: Rgb = (244, 246, 248)

_SHIFT = 4  # fractional bits of cv2's fixed-point pixels: sixteenths avoid jitter
_FAR = 1e5  # beyond this a coordinate overflows OpenCV's fixed-point arithmetic


def shade(colour: Rgb, factor: float) -> Rgb:
    """The colour darkened by `factor`, 0 to 1."""
    r, g, b = (int(c * factor) for c in colour)
    return r, g, b


def readable_on(colour: Rgb) -> Rgb:
    """INK or PAPER, whichever has the higher contrast on `colour`."""
    luma = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]
    return INK if luma > 125 else PAPER


def _font(bold: bool) -> int:
    return cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX


@functools.lru_cache(maxsize=256)
def _scale(height: int, bold: bool) -> float:
    """Font scale at which capitals are `height` pixels tall."""
    (_, tall), _ = cv2.getTextSize("H", _font(bold), 4.0, 1)
    return 4.0 * height / max(tall, 1)


@functools.lru_cache(maxsize=4096)
def text_size(text: str, height: int, bold: bool = False) -> tuple[int, int]:
    """Width and height in pixels of a line of text with capitals of `height` pixels."""
    (width, _), _ = cv2.getTextSize(text, _font(bold), _scale(height, bold), 1)
    return int(width), height


def draw_text(
    image: ImageArray,
    text: str,
    at: tuple[float, float],
    height: int,
    colour: Rgb,
    *,
    bold: bool = False,
    anchor: Literal["left", "centre", "right"] = "left",
) -> None:
    """One line of text whose capitals reach from `at`'s y down `height` pixels."""
    width = text_size(text, height, bold)[0]
    x = at[0] - {"left": 0.0, "centre": width / 2, "right": float(width)}[anchor]
    where = (round(x), round(at[1] + height))
    cv2.putText(image, text, where, _font(bold), _scale(height, bold), colour, 1, cv2.LINE_AA)


def fit_text(text: str, height: int, width: float, bold: bool = False) -> str:
    """`text`, cut with an ellipsis where it is wider than `width` pixels."""
    if text_size(text, height, bold)[0] <= width:
        return text
    while text and text_size(text + "...", height, bold)[0] > width:
        text = text[:-1]
    return text.rstrip() + "..."


def wrap_text(text: str, height: int, width: float, lines: int) -> list[str]:
    """`text` broken between words into at most `lines` lines; the last is cut where it must be."""
    out: list[str] = []
    words = text.split()
    while words and len(out) < lines - 1:
        n = 1
        while n < len(words) and text_size(" ".join(words[: n + 1]), height)[0] <= width:
            n += 1
        out.append(fit_text(" ".join(words[:n]), height, width))
        words = words[n:]
    if words:
        out.append(fit_text(" ".join(words), height, width))
    return out


def fill_rect(image: ImageArray, rect: Rect, colour: Rgb, opacity: float = 1.0) -> None:
    """A filled rectangle, see-through when `opacity` is below 1, clipped to the picture."""
    part = image[_clipped(image, rect)]
    if part.size == 0:
        return
    cv2.addWeighted(np.full_like(part, colour), opacity, part, 1 - opacity, 0, dst=part)


def outline(image: ImageArray, rect: Rect, colour: Rgb, thickness: int) -> None:
    """A rectangle's outline."""
    a, b = _fixed(np.reshape(rect, (2, 2))).tolist()
    cv2.rectangle(image, a, b, colour, thickness, cv2.LINE_AA, _SHIFT)


def polyline(image: ImageArray, points: FloatArray, colour: Rgb, thickness: int) -> None:
    """An anti-aliased line through `points` [n, 2]; NaN points break it."""
    for part in _unbroken(points):
        cv2.polylines(image, [_fixed(part)], False, colour, thickness, cv2.LINE_AA, _SHIFT)


def dashed(
    image: ImageArray, points: FloatArray, colour: Rgb, thickness: int, dash_px: float
) -> None:
    """A dashed line through `points` [n, 2]; dash and gap are both `dash_px` long."""
    for part in _unbroken(points):
        step = np.hypot(*np.diff(part, axis=0).T)
        along = np.concatenate([[0.0], np.cumsum(step)])
        total = float(along[-1])
        if total <= 0 or total > 100 * _FAR:
            continue
        for start in np.arange(0.0, total, 2 * dash_px):
            s = np.linspace(start, min(start + dash_px, total), 4)
            piece = np.stack([np.interp(s, along, part[:, i]) for i in (0, 1)], axis=1)
            cv2.polylines(image, [_fixed(piece)], False, colour, thickness, cv2.LINE_AA, _SHIFT)


def polygon(image: ImageArray, points: FloatArray, colour: Rgb) -> None:
    """A filled anti-aliased polygon [n, 2]; nothing when a point is NaN."""
    if np.isfinite(points).all() and len(points) > 2:
        cv2.fillPoly(image, [_fixed(points)], colour, cv2.LINE_AA, _SHIFT)


def circle(
    image: ImageArray, centre: FloatArray, radius: float, colour: Rgb, thickness: int = -1
) -> None:
    """A circle, filled when `thickness` is negative; nothing when the centre is NaN."""
    if np.isfinite(centre).all():
        u, v = _fixed(np.asarray(centre, dtype=np.float64).reshape(1, 2))[0].tolist()
        size = round(radius * (1 << _SHIFT))
        cv2.circle(image, (u, v), size, colour, thickness, cv2.LINE_AA, _SHIFT)


def arrow(
    image: ImageArray,
    tail: FloatArray,
    tip: FloatArray,
    colour: Rgb,
    thickness: int,
    head_px: float,
) -> None:
    """A line from `tail` to `tip` with a head."""
    length = float(np.hypot(*(tip - tail)))
    if length > 1e-6:
        a, b = _fixed(np.stack([tail, tip])).tolist()
        head = min(head_px / length, 1.0)
        cv2.arrowedLine(image, a, b, colour, thickness, cv2.LINE_AA, _SHIFT, head)


def hatch(image: ImageArray, rect: Rect, a: Rgb, b: Rgb, width_px: int) -> None:
    """Diagonal stripes of two colours, unlike any state's colour."""
    area = _clipped(image, rect)
    y, x = np.mgrid[area]
    stripe = ((x + y) // max(width_px, 1)) % 2 == 0
    image[area] = np.where(stripe[..., None], np.array(a, np.uint8), np.array(b, np.uint8))


def place_label(
    size: tuple[float, float],
    box: Rect,
    taken: Sequence[Rect],
    bounds: Rect,
    *,
    gap: float = 2.0,
    avoid: Sequence[Rect] = (),
) -> Rect:
    """Where a label of `size` goes beside `box`: inside `bounds`, off the labels in `taken` and,
    where that can be, off the boxes in `avoid`.

    Tries above, below, the sides and then farther above and below; the first free place wins, or
    else the one that hides least.
    """
    w, h = size
    x0, y0, x1, y1 = box
    spots = [(x0, y0 - h - gap), (x1 - w, y0 - h - gap), (x0, y1 + gap), (x1 - w, y1 + gap)]
    spots += [(x1 + gap, y0), (x0 - w - gap, y0), (x1 + gap, y1 - h), (x0 - w - gap, y1 - h)]
    for row in (2, 3, 4):
        spots += [(x0, y0 - row * (h + gap)), (x0, y1 + gap + (row - 1) * (h + gap))]
    lowest, highest = np.array(bounds[:2]), np.array(bounds[2:]) - size
    corner = np.clip(spots, lowest, np.maximum(highest, lowest))
    spot = np.hstack([corner, corner + size])

    def hidden(rects: Sequence[Rect]) -> FloatArray:
        """The area of `rects` that each spot covers."""
        other = np.array(rects, np.float64).reshape(-1, 4)
        return np.asarray(intersection_area(spot[:, None], other[None]).sum(axis=1))

    # A label pushed back inside may then cover its own box: that counts a little too.
    cost = hidden(taken) + 0.3 * hidden([*avoid, box]) + 0.01 * np.arange(len(spot))
    left, top, right, bottom = spot[cost.argmin()].tolist()
    return left, top, right, bottom


def draw_tag(
    image: ImageArray, text: str, centre: tuple[float, float], height: int, colour: Rgb
) -> Rect:
    """Bold text on a filled rectangle around `centre`; returns the rectangle."""
    u, v = centre
    half = (text_size(text, height, True)[0] + height) / 2
    rect: Rect = (u - half, v - height, u + half, v + height)
    fill_rect(image, rect, colour)
    ink = readable_on(colour)
    draw_text(image, text, (u, v - height / 2), height, ink, bold=True, anchor="centre")
    return rect


def encode_jpeg(rgb: ImageArray, quality: int = 85) -> bytes:
    """`rgb` [h, w, 3] as a JPEG file."""
    jpeg: bytes = simplejpeg.encode_jpeg(
        np.ascontiguousarray(rgb), quality=quality, colorspace="RGB", colorsubsampling="420"
    )
    return jpeg


def _clipped(image: ImageArray, rect: Rect) -> tuple[slice, slice]:
    """Rows and columns of `rect` inside the picture."""
    h, w = image.shape[:2]
    x0, y0 = max(round(rect[0]), 0), max(round(rect[1]), 0)
    return slice(y0, max(min(round(rect[3]), h), y0)), slice(x0, max(min(round(rect[2]), w), x0))


def _fixed(points: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    near = np.clip(points, -_FAR, _FAR)
    return np.round(near * (1 << _SHIFT)).astype(np.int32)


def _unbroken(points: FloatArray) -> list[FloatArray]:
    """The runs of at least two finite points."""
    good = np.isfinite(points).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [points[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 1]
