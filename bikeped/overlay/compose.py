"""Picture and radar side by side in one frame of fixed size, and JPEG for the live view."""

from __future__ import annotations

import cv2
import numpy as np
import simplejpeg

from bikeped.overlay.camera_view import draw_banner, draw_overlay
from bikeped.overlay.drawing import INK
from bikeped.overlay.overlay_data import GroundToFrame, OverlayData
from bikeped.overlay.radar import draw_radar
from bikeped.types import ImageArray

#: Share of the width that the camera's picture takes.
_PICTURE = 0.705


def compose(
    rgb: ImageArray,
    data: OverlayData,
    size: tuple[int, int] = (1600, 720),
    *,
    frame_width: int | None = None,
    ground_to_frame: GroundToFrame | None = None,
    fov_deg: float = 198.0,
    heading_deg: float = 0.0,
) -> ImageArray:
    """One frame of `size` (width, height): the state above, the picture left, the radar right.

    `rgb` [h, w, 3] may be a scaled copy of the frame; `frame_width` then is the full frame's
    width, in whose pixels the boxes are (None: `rgb` is the full frame).
    """
    width, height = size
    top = int(np.clip(round(height * 0.105), 34, 110))
    left = round(width * _PICTURE)
    h, w = rgb.shape[:2]
    fit = min(left / w, (height - top) / h)
    pw, ph = max(round(w * fit), 2), max(round(h * fit), 2)
    how = cv2.INTER_AREA if fit < 1 else cv2.INTER_LINEAR
    small = np.asarray(cv2.resize(rgb, (pw, ph), interpolation=how), dtype=np.uint8)
    picture = draw_overlay(
        small, data, scale=pw / (frame_width or w), ground_to_frame=ground_to_frame
    )
    out: ImageArray = np.empty((height, width, 3), np.uint8)
    out[:] = INK
    y = top + (height - top - ph) // 2
    out[y : y + ph, (left - pw) // 2 : (left - pw) // 2 + pw] = picture
    out[top:, left:] = draw_radar(
        data, (width - left, height - top), fov_deg=fov_deg, heading_deg=heading_deg
    )
    draw_banner(out, data, (0, 0, width, top))
    return out


def encode_jpeg(rgb: ImageArray, quality: int = 85) -> bytes:
    """`rgb` [h, w, 3] as a JPEG file."""
    jpeg: bytes = simplejpeg.encode_jpeg(
        np.ascontiguousarray(rgb), quality=quality, colorspace="RGB", colorsubsampling="420"
    )
    return jpeg
