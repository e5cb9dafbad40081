"""The report's pictures: each board with the residual of every corner drawn on it."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from bikeped.lab.calibration.solver.lens_fit import Fit, rms_by_picture
from bikeped.types import FloatArray

_WIDTH_PX, _MARGIN_SHARE, _LEAST_SPAN_PX = 420, 0.22, 60
_QUALITY = 72


@dataclass(frozen=True)
class Thumbnail:
    """One picture, and where its pixel (0, 0) lies in the crop that the fit speaks of."""

    name: str
    gray: npt.NDArray[np.uint8]
    offset_px: tuple[int, int] = (0, 0)


def picture_cards(fit: Fit, thumbnails: Sequence[Thumbnail], arrow_scale: float) -> str:
    """HTML: one card a picture, the worst first."""
    errors = rms_by_picture(fit.residuals_px, fit.sightings)
    held = None if fit.held_out_px is None else rms_by_picture(fit.held_out_px, fit.sightings)
    by_name = {thumbnail.name: thumbnail for thumbnail in thumbnails}
    cards = []
    for row in np.argsort(errors)[::-1]:
        thumbnail = by_name.get(fit.sightings.names[row])
        cards.append(
            _card(
                fit,
                int(row),
                thumbnail,
                arrow_scale,
                float(errors[row]),
                None if held is None else float(held[row]),
            )
        )
    return f'<div class="cards">{"".join(cards)}</div>'


def _card(
    fit: Fit,
    row: int,
    thumbnail: Thumbnail | None,
    arrow_scale: float,
    rms: float,
    held: float | None,
) -> str:
    seen = fit.sightings.seen[row]
    uv = fit.sightings.uv_px[row][seen]
    error = -fit.residuals_px[row][seen]
    low, high = _frame(uv, error * arrow_scale, fit)
    width, height = high - low
    zoom = _WIDTH_PX / width
    image = "" if thumbnail is None else _image(thumbnail, low, high, zoom)
    start = uv - error
    dot = 2.2 / zoom
    lines = "".join(
        f'<line x1="{a:.2f}" y1="{b:.2f}" x2="{c:.2f}" y2="{d:.2f}"/>'
        for (a, b), (c, d) in zip(start, start + error * arrow_scale, strict=True)
    )
    dots = "".join(f'<circle cx="{a:.2f}" cy="{b:.2f}" r="{dot:.2f}"/>' for a, b in start)
    worst = float(np.hypot(*error.T).max())
    theta = np.degrees(fit.angles_rad[row][seen])
    name = html.escape(Path(fit.sightings.names[row]).name)
    held_text = "" if held is None else f", held out {held:.2f}"
    return (
        f'<figure class="card"><svg viewBox="{low[0]:.1f} {low[1]:.1f} {width:.1f} {height:.1f}" '
        f'role="img" aria-label="residuals of {name}">{image}'
        f'<g stroke="#ff5a36" stroke-width="{1.8 / zoom:.2f}">{lines}</g>'
        f'<g fill="#ffe14a">{dots}</g></svg>'
        f"<figcaption><b>{name}</b><br>RMS {rms:.2f} px{held_text}, worst corner {worst:.2f} px; "
        f"{theta.min():.0f} to {theta.max():.0f}° from the axis, "
        f"{len(uv)} of {fit.sightings.pattern.count} corners"
        "</figcaption></figure>"
    )


def _frame(uv: FloatArray, arrows: FloatArray, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """The part of the picture to show: the board with a margin, three by two."""
    points = np.concatenate([uv, uv + arrows])
    low, high = points.min(0), points.max(0)
    middle = (low + high) / 2
    picture = np.array([fit.sightings.width, fit.sightings.height], dtype=np.float64)
    span = np.maximum((high - low) * (1 + 2 * _MARGIN_SHARE), _LEAST_SPAN_PX)
    width = float(min(max(span[0], span[1] * 1.5), max(picture[0], picture[1] * 1.5)))
    size = np.array([width, width / 1.5])
    # Inside the picture where it is large enough, else in its middle.
    room = np.maximum(picture - size, 0)
    first = np.clip(middle - size / 2, 0, room)
    first = np.where(room > 0, first, (picture - size) / 2)
    return first, first + size


def _image(thumbnail: Thumbnail, low: FloatArray, high: FloatArray, zoom: float) -> str:
    """The picture's part between two crop positions, as an SVG image in crop pixels."""
    offset = np.asarray(thumbnail.offset_px, dtype=np.float64)
    height, width = thumbnail.gray.shape[:2]
    first = np.clip(np.floor(low - offset), 0, [width, height]).astype(np.int64)
    last = np.clip(np.ceil(high - offset), 0, [width, height]).astype(np.int64)
    if (last - first < 1).any():
        return ""
    part = thumbnail.gray[first[1] : last[1], first[0] : last[0]]
    shrink = min(1.0, zoom * 1.5)
    shown = cv2.resize(part, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    ok, jpeg = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not ok:
        return ""
    size, at = last - first, first + offset - 0.5  # a pixel's middle is its position
    source = base64.b64encode(jpeg.tobytes()).decode("ascii")
    return (
        f'<image x="{at[0]:.1f}" y="{at[1]:.1f}" width="{size[0]}" height="{size[1]}" '
        f'preserveAspectRatio="none" href="data:image/jpeg;base64,{source}"/>'
    )
