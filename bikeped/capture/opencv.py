"""OpenCV's VideoCapture as used here: opening, undecoded packets, colours.

`FfmpegReader` is common to recordings and network streams: Motion JPEG stays undecoded, everything
else becomes RGB.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

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


@dataclass(frozen=True)
class RawImage:
    """One image as OpenCV returned it: `jpeg` or `rgb` is set, as in Frame."""

    jpeg: bytes | None
    rgb: ImageArray | None
    media_s: float  #: the container's time stamp, seconds; not valid for all containers


def as_rgb(image: ImageArray) -> ImageArray:
    """RGB [height, width, 3] of an OpenCV image (BGR or grey)."""
    grey = image.ndim == 2 or image.shape[2] == 1
    code = cv2.COLOR_GRAY2RGB if grey else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(image, code), np.uint8)


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


class FfmpegReader:
    """The images of one file or address, through OpenCV's FFmpeg backend.

    The first image is read on opening: it shows that the source has images, and whether its packets
    are complete JPEGs of the stated size (interlaced ones hold two, of half the height). If not,
    the source is opened again and decoded by FFmpeg. Packets may lack the Huffman tables, as AVI
    allows: libjpeg-turbo then uses the standard ones.

    `label` names the source in messages and `remedy` ends them. Raises CaptureError.
    """

    def __init__(
        self,
        address: str,
        label: str,
        *,
        remedy: str,
        params: Mapping[int, int] | None = None,
        open_capture: OpenCapture = cv2.VideoCapture,
    ) -> None:
        self._address, self._label, self._remedy = address, label, remedy
        # No hardware decoding: two runs over one recording must give the same bytes.
        options = {cv2.CAP_PROP_HW_ACCELERATION: cv2.VIDEO_ACCELERATION_NONE, **(params or {})}
        self._params = [int(number) for option in options.items() for number in option]
        self._open_capture = open_capture
        self._capture = self._open()
        self.raw = self._request_raw()  #: whether images come as JPEG
        first = self._read()
        if self.raw and not self._whole_jpeg(first):
            self._capture.release()
            self._capture = self._open()
            self.raw = False
            first = self._read()
        if first is None:
            self._capture.release()
            raise CaptureError(f"{label}: has no image that can be read; {remedy}")
        self._first: RawImage | None = first
        self.fps = self._capture.get(cv2.CAP_PROP_FPS)
        self.expected_frames = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        self.width, self.height = (
            frame_size(self._capture) if first.rgb is None else first.rgb.shape[1::-1]
        )

    def read(self) -> RawImage | None:
        """The next image, or None at the end of a file or stream."""
        if self._first is not None:
            first, self._first = self._first, None
            return first
        return self._read()

    def close(self) -> None:
        """Closes the file or connection."""
        self._first = None
        self._capture.release()

    def _open(self) -> Capture:
        try:
            with silence_opencv():
                capture = self._open_capture(self._address, cv2.CAP_FFMPEG, self._params)
                opened = capture.isOpened()
        except cv2.error as error:
            raise self._failure("opened", error) from error
        if not opened:
            raise CaptureError(f"{self._label}: cannot be opened; {self._remedy}")
        return capture

    def _failure(self, what: str, error: cv2.error) -> CaptureError:
        # An address may hold a password, which must not appear in a message.
        why = str(error.err).replace(self._address, self._label)
        return CaptureError(f"{self._label}: cannot be {what} ({why}); {self._remedy}")

    def _request_raw(self) -> bool:
        # Only OpenCV's own decoding applies a rotation tag.
        if self._capture.get(cv2.CAP_PROP_ORIENTATION_META) not in (0.0, -1.0):
            return False
        if fourcc_text(self._capture.get(cv2.CAP_PROP_FOURCC)) not in JPEG_TAGS:
            return False
        return bool(self._capture.set(cv2.CAP_PROP_FORMAT, -1))

    def _whole_jpeg(self, image: RawImage | None) -> bool:
        if image is None or image.jpeg is None or not image.jpeg.startswith(SOI):
            return False
        try:
            return read_size(image.jpeg) == frame_size(self._capture)
        except CaptureError:
            return False

    def _read(self) -> RawImage | None:
        try:
            ok, data = self._capture.read()
        except cv2.error as error:
            raise self._failure("decoded", error) from error
        if not ok or data is None:
            return None
        media_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        if self.raw:
            return RawImage(data.tobytes(), None, media_s)
        return RawImage(None, as_rgb(data), media_s)
