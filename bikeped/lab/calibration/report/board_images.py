"""The report's cards: each image's board with the residual of every corner drawn on it."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bikeped.lab.calibration.solver.lens_fit import LensFit, rms_by_image
from bikeped.types import FloatArray, ImageArray

_WIDTH_PX, _MARGIN_SHARE, _LEAST_SPAN_PX = 420, 0.22, 60
_QUALITY = 72


@dataclass(frozen=True)
class Thumbnail:
    """One image, and where its pixel (0, 0) lies in the crop in which the fit's pixels count."""

    name: str
    grey: ImageArray
    offset_px: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Card:
    """One image's figure: SVG attributes in pixels of the crop, and the caption."""

    name: str
    caption: str
    view_box: str
    zoom: float  #: screen pixels per pixel
    jpeg: str  #: the part of the image, base64; empty without an overlap
    image_xywh: tuple[float, float, int, int]
    arrows: str  #: path from the projected to the observed corners
    dots: str  #: path of the projected corners


def image_cards(
    fit: LensFit, thumbnails: Sequence[Thumbnail], arrow_scale: float
) -> Iterator[Card]:
    """One card an image, the worst first; residuals are drawn `arrow_scale` times as long."""
    observations = fit.observations
    errors = rms_by_image(fit.residuals_px, observations)
    held = None if fit.held_out_px is None else rms_by_image(fit.held_out_px, observations)
    by_name = {thumbnail.name: thumbnail for thumbnail in thumbnails}
    for row in np.argsort(errors)[::-1]:
        visible = observations.visible[row]
        uv = observations.uv_px[row][visible]
        error = -fit.residuals_px[row][visible]
        low, high = _frame(uv, error * arrow_scale, fit)
        zoom = _WIDTH_PX / (high - low)[0]
        start = uv - error
        ends = zip(start, start + error * arrow_scale, strict=True)
        theta = np.degrees(fit.angles_rad[row][visible])
        held_out = "" if held is None else f", held out {held[row]:.2f}"
        yield Card(
            Path(observations.names[row]).name,
            f"RMS {errors[row]:.2f} px{held_out}, worst corner {np.hypot(*error.T).max():.2f} px; "
            f"{theta.min():.0f} to {theta.max():.0f}° from the axis, {len(uv)} of "
            f"{observations.pattern.count} corners",
            " ".join(f"{value:.1f}" for value in (*low, *(high - low))),
            zoom,
            *_image(by_name.get(observations.names[row]), low, high, zoom),
            "".join(f"M{a:.2f} {b:.2f}L{c:.2f} {d:.2f}" for (a, b), (c, d) in ends),
            "".join(f"M{u:.2f} {v:.2f}h0" for u, v in start),
        )


def _frame(uv: FloatArray, arrows: FloatArray, fit: LensFit) -> tuple[FloatArray, FloatArray]:
    """First and last position [2] of the part to show: the board with a margin, three by two."""
    points = np.concatenate([uv, uv + arrows])
    low, high = points.min(0), points.max(0)
    middle = (low + high) / 2
    image = np.array([fit.observations.width, fit.observations.height], dtype=np.float64)
    span = np.maximum((high - low) * (1 + 2 * _MARGIN_SHARE), _LEAST_SPAN_PX)
    width = float(min(max(span[0], span[1] * 1.5), max(image[0], image[1] * 1.5)))
    size = np.array([width, width / 1.5])
    # Inside the image where it is large enough, else in its middle.
    room = np.maximum(image - size, 0)
    first = np.clip(middle - size / 2, 0, room)
    first = np.where(room > 0, first, (image - size) / 2)
    return first, first + size


def _image(
    thumbnail: Thumbnail | None, low: FloatArray, high: FloatArray, zoom: float
) -> tuple[str, tuple[float, float, int, int]]:
    """JPEG (base64) and place of the image's part between two positions [2] in the crop."""
    if thumbnail is None:
        return "", (0, 0, 0, 0)
    offset = np.asarray(thumbnail.offset_px, dtype=np.float64)
    height, width = thumbnail.grey.shape[:2]
    u0, v0 = (int(x) for x in np.clip(np.floor(low - offset), 0, [width, height]))
    u1, v1 = (int(x) for x in np.clip(np.ceil(high - offset), 0, [width, height]))
    if u1 <= u0 or v1 <= v0:
        return "", (0, 0, 0, 0)
    shrink = min(1.0, zoom * 1.5)
    part = thumbnail.grey[v0:v1, u0:u1]
    shown = cv2.resize(part, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    first_u, first_v = thumbnail.offset_px
    # A pixel's middle is its position.
    place = (first_u + u0 - 0.5, first_v + v0 - 0.5, u1 - u0, v1 - v0)
    return base64.b64encode(jpeg.tobytes()).decode("ascii"), place
