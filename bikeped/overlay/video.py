"""The overlay video: picture and radar side by side in frames of fixed size, written to MP4."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from bikeped.errors import CaptureError
from bikeped.files import WholeFile
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


class VideoWriter:
    """Writes RGB pictures of one size to `path` (.mp4).

    Writes to a temporary file and renames it at `close`: a file of the final name is complete. As a
    context manager an exception discards the file.
    """

    def __init__(self, path: Path, fps: float, size: tuple[int, int]) -> None:
        """Opens the file. `size` is width, height. Raises CaptureError when it cannot."""
        self.path, self.size, self.frames = path, size, 0
        if path.suffix.lower() != ".mp4":
            raise CaptureError(f"{path}: is not an .mp4 name; end the overlay's name with .mp4")
        if not path.parent.is_dir():
            raise CaptureError(f"{path}: its folder does not exist; make {path.parent} first")
        if not os.access(path.parent, os.W_OK):
            raise CaptureError(f"{path}: its folder is not writable; choose another folder")
        self._file = WholeFile(path)
        fourcc = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer: cv2.VideoWriter | None = cv2.VideoWriter(
            str(self._file.partial), fourcc, fps, size
        )
        if not self._writer.isOpened():
            self.discard()
            raise CaptureError(
                f"{path}: OpenCV cannot write MP4 ({size[0]} x {size[1]}, {fps:g} fps); check the "
                "free disk space and that opencv-python-headless is the one from PyPI"
            )

    def write(self, rgb: ImageArray) -> None:
        """Appends one picture [height, width, 3]; ValueError when its size is another."""
        if self._writer is None:
            raise ValueError(f"{self.path}: is closed already")
        if rgb.shape != (self.size[1], self.size[0], 3):
            # OpenCV drops such a frame silently.
            raise ValueError(f"VideoWriter: expected {self.size}, got shape {rgb.shape}")
        self._writer.write(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        self.frames += 1

    def close(self) -> None:
        """Completes and renames the file; again is harmless."""
        if self._writer is None:
            return
        self._writer.release()
        self._writer = None
        if self.frames == 0 or not self._file.partial.exists():
            self._file.discard()
            raise CaptureError(f"{self.path}: no picture was written; check the recording")
        try:
            self._file.commit()
        except OSError as error:
            raise CaptureError(
                f"{self.path}: cannot be written ({error.strerror}); choose another name"
            ) from error

    def discard(self) -> None:
        """Stops and removes the temporary file."""
        if self._writer is not None:
            self._writer.release()
            self._writer = None
        self._file.discard()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()
