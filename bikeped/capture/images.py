"""A folder of images, or one image, as a recording."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np

from bikeped.capture.base import FrameSource
from bikeped.capture.jpeg import read_size
from bikeped.capture.opencv import as_rgb, silence_opencv, usable_fps
from bikeped.errors import CaptureError
from bikeped.types import Frame, ImageArray

JPEG_SUFFIXES = frozenset({".jpg", ".jpeg"})
IMAGE_SUFFIXES = JPEG_SUFFIXES | {".png", ".bmp", ".tif", ".tiff", ".webp"}


class ImageSource(FrameSource):
    """The images of `path` in natural order (2.jpg before 10.jpg), one every 1/`fps` seconds.

    JPEG files are passed on undecoded; EXIF orientation is ignored. All images must have the size
    of the first. `captured_s` is media time. Raises CaptureError, naming the file.
    """

    live = False

    def __init__(self, path: Path | str, *, fps: float) -> None:
        folder = Path(path)
        self.name = str(path)
        if not usable_fps(fps):
            raise CaptureError(f"camera.fps: {fps} frames per second is not possible; try 30")
        self.fps = fps
        try:
            self._paths = image_paths(folder)
        except OSError as error:
            raise CaptureError(f"{self.name}: cannot be read: {error.strerror}") from error
        if not self._paths:
            raise CaptureError(
                f"{self.name}: holds no images ({', '.join(sorted(IMAGE_SUFFIXES))})"
            )
        self._number = 0
        self.width, self.height = _size(*_load(self._paths[0]), self._paths[0])

    def read(self) -> Frame | None:
        if self._number >= len(self._paths):
            return None
        path = self._paths[self._number]
        jpeg, rgb = _load(path)
        try:
            width, height = _size(jpeg, rgb, path)
        except CaptureError:  # the decoder refuses a damaged JPEG, as from a camera
            width, height = self.width, self.height
        if (width, height) != (self.width, self.height):
            raise CaptureError(
                f"{path}: is {width}x{height} pixels, but the first image is "
                f"{self.width}x{self.height}; use one size per folder"
            )
        frame = Frame(self._number, self._number / self.fps, width, height, jpeg, rgb)
        self._number += 1
        return frame

    def close(self) -> None:
        self._number = len(self._paths)


def image_paths(path: Path) -> list[Path]:
    """The images of a folder in natural order; for a file, the file."""
    if not path.is_dir():
        return [path]
    found = [
        entry
        for entry in path.iterdir()
        if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file()
    ]
    return sorted(found, key=lambda entry: natural_key(entry.name))


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sort key: numbers in names by value; then the name itself (`1.jpg` and `01.jpg`)."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(p), "") if p[:1].isdigit() and p.isascii() else (1, 0, p) for p in parts], name


def _load(path: Path) -> tuple[bytes | None, ImageArray | None]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror}") from error
    if path.suffix.lower() in JPEG_SUFFIXES:
        return data, None
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        with silence_opencv():
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    except cv2.error as error:
        raise CaptureError(f"{path}: is not an image ({error.err}); remove it") from error
    if image is None:
        raise CaptureError(f"{path}: is not an image that can be decoded; remove it")
    return None, as_rgb(np.asarray(image, np.uint8))


def _size(jpeg: bytes | None, rgb: ImageArray | None, path: Path) -> tuple[int, int]:
    if rgb is not None:
        return rgb.shape[1], rgb.shape[0]
    try:
        return read_size(jpeg or b"")
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}; remove it") from error
