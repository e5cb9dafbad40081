"""A folder of pictures, or one picture, shown as a recording."""

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
    """The pictures of `path` in natural order (2.jpg before 10.jpg), one every 1/`fps` seconds.

    JPEG files are handed on undecoded, and turned by no EXIF tag. All pictures must have the size
    of the first. `captured_s` is media time. Raises CaptureError, naming the file.
    """

    live = False

    def __init__(self, path: Path | str, *, fps: float) -> None:
        folder = Path(path)
        self.name = str(path)
        if not usable_fps(fps):
            raise CaptureError(f"camera.fps: {fps} pictures a second cannot be shown; try 30")
        self.fps = fps
        try:
            self._paths = image_paths(folder)
        except OSError as error:
            raise CaptureError(f"{self.name}: cannot be read: {error.strerror}") from error
        if not self._paths:
            raise CaptureError(
                f"{self.name}: holds no pictures ({', '.join(sorted(IMAGE_SUFFIXES))})"
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
        except CaptureError:  # a damaged JPEG is for the decoder to refuse, as from a camera
            width, height = self.width, self.height
        if (width, height) != (self.width, self.height):
            raise CaptureError(
                f"{path}: is {width}x{height} pixels, but the first picture is "
                f"{self.width}x{self.height}; keep one size a folder"
            )
        frame = Frame(self._number, self._number / self.fps, width, height, jpeg, rgb)
        self._number += 1
        return frame

    def close(self) -> None:
        self._number = len(self._paths)


def image_paths(path: Path) -> list[Path]:
    """The pictures of a folder in natural order; a file is the only one of itself."""
    if not path.is_dir():
        return [path]
    found = [
        entry
        for entry in path.iterdir()
        if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file()
    ]
    return sorted(found, key=lambda entry: natural_key(entry.name))


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sorts numbers in names by value; the name itself decides between `1.jpg` and `01.jpg`."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(0, int(p), "") if p[:1].isdigit() and p.isascii() else (1, 0, p) for p in parts], name


def _load(path: Path) -> tuple[bytes | None, ImageArray | None]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read: {error.strerror}") from error
    if path.suffix.lower() in JPEG_SUFFIXES:
        return data, None
    try:
        with silence_opencv():
            picture = (
                cv2.imdecode(
                    np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
                )
                if data
                else None
            )
    except cv2.error as error:
        raise CaptureError(f"{path}: is no picture ({error.err}); remove it") from error
    if picture is None:
        raise CaptureError(f"{path}: is no picture that can be decoded; remove it")
    return None, as_rgb(np.asarray(picture, np.uint8))


def _size(jpeg: bytes | None, rgb: ImageArray | None, path: Path) -> tuple[int, int]:
    if rgb is not None:
        return rgb.shape[1], rgb.shape[0]
    try:
        return read_size(jpeg or b"")
    except CaptureError as error:
        raise CaptureError(f"{path}: {error}; remove it") from error
