"""Recordings: image folders, videos, and either played in real time.

Motion JPEG (AVI, MKV, MOV, MP4) is passed on packet by packet, so that a frame is decoded once, at
the scale that the detector needs. Other codecs are decoded by FFmpeg, in software. Two runs over
one file give the same bytes and times.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import re
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from bikeped.capture.base import FrameSource, Image
from bikeped.capture.opencv import (
    FfmpegSource,
    OpenCapture,
    as_rgb,
    image_size,
    silence_opencv,
    usable_fps,
)
from bikeped.errors import CaptureError
from bikeped.types import Frame

JPEG_SUFFIXES = frozenset({".jpg", ".jpeg"})
IMAGE_SUFFIXES = JPEG_SUFFIXES | {".png", ".bmp", ".tif", ".tiff", ".webp"}
_log = logging.getLogger(__name__)
# A container's frame count may be an estimate; a file with less than this share is truncated.
COMPLETE_SHARE = 0.95


class ImageSource(FrameSource):
    """The images of `path` in natural order (2.jpg before 10.jpg), one every 1/`fps` seconds.

    JPEG files are passed on undecoded; EXIF orientation is ignored. All images must have the size
    of the first. `captured_s` is media time. Raises CaptureError, naming the file.
    """

    live = False

    def __init__(self, path: Path | str, *, fps: float) -> None:
        self.name = str(path)
        if not usable_fps(fps):
            raise CaptureError(f"camera.fps: {fps} frames per second is not possible; try 30")
        self.fps = fps
        try:
            self._paths = image_paths(Path(path))
        except OSError as error:
            raise CaptureError(f"{self.name}: cannot be read: {error.strerror}") from error
        if not self._paths:
            raise CaptureError(
                f"{self.name}: holds no images ({', '.join(sorted(IMAGE_SUFFIXES))})"
            )
        size = image_size(_load(self._paths[0]))
        if size is None:
            raise CaptureError(f"{self._paths[0]}: has no image header; remove it")
        self.width, self.height = size

    def read(self) -> Frame | None:
        if self._number >= len(self._paths):
            return None
        path = self._paths[self._number]
        image = _load(path)
        width, height = image_size(image) or (self.width, self.height)
        if (width, height) != (self.width, self.height):
            raise CaptureError(
                f"{path}: is {width}x{height} pixels, but the first image is "
                f"{self.width}x{self.height}; use one size per folder"
            )
        return self._frame(self._number / self.fps, image)

    def close(self) -> None:
        self._number = len(self._paths)


def image_paths(path: Path) -> list[Path]:
    """The images of a folder in natural order; for a file, the file."""
    if not path.is_dir():
        return [path]
    found = (file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
    return sorted(filter(Path.is_file, found), key=lambda file: natural_key(file.name))


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key: numbers in names by value; then the name itself (`1.jpg` and `01.jpg`)."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(p), "") if p[:1].isdigit() and p.isascii() else (1, 0, p) for p in parts], name


def _load(path: Path) -> Image:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror}") from error
    if path.suffix.lower() in JPEG_SUFFIXES:
        return data
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        with silence_opencv():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error as error:
        raise CaptureError(f"{path}: is not an image ({error.err}); remove it") from error
    if image is None:
        raise CaptureError(f"{path}: is not an image that can be decoded; remove it")
    return as_rgb(np.asarray(image, np.uint8))


class VideoSource(FfmpegSource):
    """A video file. `captured_s` is media time in seconds, strictly increasing.

    It is the container's time stamp where that increases, else the previous frame's plus one frame
    period. Raises CaptureError for a missing, broken or empty file and for one
    without a frame rate.
    """

    live = False

    def __init__(self, path: Path | str, *, open_capture: OpenCapture = cv2.VideoCapture) -> None:
        if not Path(path).is_file():
            raise CaptureError(f"{path}: no such file; set camera.source to a video")
        remedy = (
            "is it a complete video file? `ffprobe` says what is in it, and "
            "`ffmpeg -i IN -c copy OUT.mkv` repairs some"
        )
        super().__init__(str(path), str(path), remedy, open_capture)
        self._last_s = -math.inf
        if not usable_fps(self.fps):
            self.close()
            raise CaptureError(
                f"{self.name}: has no frame rate (it says {self.fps:g}); "
                "`ffmpeg -r 30 -i IN -c copy OUT.mkv` writes one"
            )

    def read(self) -> Frame | None:
        found = self._next()
        if found is None:
            expected = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
            if self._number < COMPLETE_SHARE * expected:
                text = "%s: ends after %d of %.0f frames; is the file truncated?"
                _log.warning(text, self.name, self._number, expected)
            return None
        image, captured_s = found
        if not (math.isfinite(captured_s) and captured_s > self._last_s):
            captured_s = self._last_s + 1.0 / self.fps if self._number else 0.0
        self._last_s = captured_s
        return self._frame(captured_s, image)


class PacedSource(FrameSource):
    """Returns each frame of `source` at its media time, the first one immediately.

    `captured_s` is rebased on `clock` (monotonic seconds), spaced as in the recording. No frame is
    dropped here: where reading is slower than the recording, frames come late.
    """

    live = True

    def __init__(
        self,
        source: FrameSource,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._source, self._clock, self._sleep = source, clock, sleep
        self._offset_s: float | None = None
        self.name = source.name
        self.width, self.height, self.fps = source.width, source.height, source.fps

    def read(self) -> Frame | None:
        frame = self._source.read()
        if frame is None:
            return None
        now_s = self._clock()
        if self._offset_s is None:
            self._offset_s = now_s - frame.captured_s
        due_s = frame.captured_s + self._offset_s
        if due_s > now_s:
            self._sleep(due_s - now_s)
        return dataclasses.replace(frame, captured_s=due_s)

    def close(self) -> None:
        self._source.close()
