"""What the sources behind OpenCV's VideoCapture have in common: opening, reading, colours.

`FfmpegSource` is common to recordings and network streams: Motion JPEG stays undecoded, everything
else becomes RGB.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol

import cv2
import numpy as np

from bikeped.capture.base import FrameSource, Image
from bikeped.capture.jpeg import SOI, read_size
from bikeped.errors import CaptureError
from bikeped.types import ImageArray

# Codec tags that OpenCV's FFmpeg backend reports for Motion JPEG in AVI, MKV, MOV and MP4.
JPEG_TAGS = frozenset({"MJPG", "mjpg", "jpeg", "JPEG", "AVRn"})
MAX_FPS = 1000.0
LOG_LEVEL_ERROR = 2  # OpenCV's


class Capture(Protocol):
    """The part of cv2.VideoCapture in use; tests put a fake device here."""

    def isOpened(self) -> bool: ...  # noqa: N802  (OpenCV's name)
    def get(self, prop: int, /) -> float: ...
    def set(self, prop: int, value: float, /) -> bool: ...
    def read(self) -> tuple[bool, Any]: ...
    def release(self) -> None: ...


OpenCapture = Callable[..., Capture]


def as_rgb(image: ImageArray) -> ImageArray:
    """RGB [height, width, 3] of an OpenCV image (BGR or grey)."""
    grey = image.ndim == 2 or image.shape[2] == 1
    code = cv2.COLOR_GRAY2RGB if grey else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code), np.uint8)


def image_size(image: Image) -> tuple[int, int] | None:
    """(width, height) in pixels; None for a damaged JPEG, which the decoder refuses."""
    if not isinstance(image, bytes):
        return image.shape[1], image.shape[0]
    try:
        return read_size(image)
    except CaptureError:
        return None


def fourcc_text(code: float) -> str:
    """The four characters (`MJPG`) of OpenCV's codec number; empty where it has none."""
    if not math.isfinite(code) or code <= 0:
        return ""
    return int(code).to_bytes(8, "little")[:4].decode("latin-1").rstrip("\0 ")


def frame_size(capture: Capture) -> tuple[int, int]:
    """Width and height that OpenCV states, pixels."""
    sides = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
    return int(capture.get(sides[0])), int(capture.get(sides[1]))


def usable_fps(fps: float) -> bool:
    """Whether a frame rate is valid; OpenCV gives 0, negative or NaN for none."""
    return math.isfinite(fps) and 0.0 < fps <= MAX_FPS


@contextlib.contextmanager
def silence_opencv() -> Iterator[None]:
    """Keeps OpenCV and FFmpeg from writing to standard error; errors are reported in our own line.

    The variable OPENCV_LOG_LEVEL has priority. FFmpeg reads its level once per process.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # The functions are in cv2 itself up to OpenCV 4, and in cv2.utils.logging from 5 on.
    logging: Any = getattr(cv2.utils, "logging", cv2)
    level = logging.getLogLevel()
    if "OPENCV_LOG_LEVEL" not in os.environ:
        logging.setLogLevel(min(level, LOG_LEVEL_ERROR))
    try:
        yield
    finally:
        logging.setLogLevel(level)


class OpenCvSource(FrameSource):
    """A source behind cv2.VideoCapture.

    `name` stands for the address in messages, which may hold a password, and `remedy` ends them.
    """

    _raw = False  #: whether images come as JPEG

    def __init__(
        self, address: str, name: str, remedy: str, open_capture: OpenCapture = cv2.VideoCapture
    ) -> None:
        self.name = name
        self._address, self._remedy, self._open_capture = address, remedy, open_capture

    def close(self) -> None:
        self._capture.release()

    def _open(self, *options: object) -> None:
        with self._errors("opened"), silence_opencv():
            self._capture = self._open_capture(self._address, *options)
            opened = self._capture.isOpened()
        if not opened:
            raise CaptureError(f"{self.name}: {self._why_not_opened()}")

    def _why_not_opened(self) -> str:
        return f"cannot be opened; {self._remedy}"

    def _read(self) -> tuple[Image, float] | None:
        """The next image and its time stamp in seconds, or None at the end."""
        with self._errors("read"):
            ok, data = self._capture.read()
        if not ok or data is None or data.size == 0:
            return None
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        return data.tobytes() if self._raw else as_rgb(data), stamp_s

    @contextlib.contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        try:
            yield
        except cv2.error as error:
            why = str(error.err).replace(self._address, self.name)
            text = f"{self.name}: cannot be {what} ({why}); {self._remedy}"
            raise CaptureError(text) from error


class FfmpegSource(OpenCvSource):
    """A file or address, through OpenCV's FFmpeg backend.

    The first image is read on opening: it shows that the source has images, and whether its packets
    are complete JPEGs of the stated size (interlaced ones hold two, of half the height). If not,
    the source is opened again and decoded by FFmpeg. Packets may lack the Huffman tables, as AVI
    allows: libjpeg-turbo then uses the standard ones. `fps` is what the source states, valid or
    not. Raises CaptureError.
    """

    def __init__(
        self,
        address: str,
        name: str,
        remedy: str,
        open_capture: OpenCapture,
        params: Mapping[int, int] | None = None,
    ) -> None:
        super().__init__(address, name, remedy, open_capture)
        # No hardware decoding: two runs over one recording must give the same bytes.
        options = {cv2.CAP_PROP_HW_ACCELERATION: cv2.VIDEO_ACCELERATION_NONE, **(params or {})}
        flat = [int(number) for option in options.items() for number in option]
        self._open(cv2.CAP_FFMPEG, flat)
        self._raw = self._request_raw()
        first = self._read()
        if self._raw and not self._is_whole_jpeg(first):
            self.close()
            self._open(cv2.CAP_FFMPEG, flat)
            self._raw = False
            first = self._read()
        if first is None:
            self.close()
            raise CaptureError(f"{name}: has no image that can be read; {remedy}")
        self._first: tuple[Image, float] | None = first
        self.fps = self._capture.get(cv2.CAP_PROP_FPS)
        stated = frame_size(self._capture)
        self.width, self.height = stated if self._raw else image_size(first[0]) or stated

    def _next(self) -> tuple[Image, float] | None:
        """As `_read`, from the first image on."""
        first, self._first = self._first, None
        return first or self._read()

    def _request_raw(self) -> bool:
        # Only OpenCV's own decoding applies a rotation tag.
        if self._capture.get(cv2.CAP_PROP_ORIENTATION_META) not in (0.0, -1.0):
            return False
        if fourcc_text(self._capture.get(cv2.CAP_PROP_FOURCC)) not in JPEG_TAGS:
            return False
        return bool(self._capture.set(cv2.CAP_PROP_FORMAT, -1))

    def _is_whole_jpeg(self, found: tuple[Image, float] | None) -> bool:
        image = found[0] if found else b""
        whole = isinstance(image, bytes) and image.startswith(SOI)
        return whole and image_size(image) == frame_size(self._capture)
