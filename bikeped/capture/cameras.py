"""Live cameras: at /dev/videoN through OpenCV's V4L2 backend, or on the network.

With CAP_PROP_CONVERT_RGB off OpenCV returns a V4L2 camera's Motion JPEG undecoded, and
CAP_PROP_POS_MSEC is the kernel's time stamp of the buffer. Not run on a real camera yet: written
from OpenCV's documentation and tested against a fake at cv2.VideoCapture. A read that the driver
never answers cannot be ended from here; see `FrameGrabber.hung_s`.

OpenCV gives no capture time for a network stream (RTSP, or Motion JPEG and others over HTTP), so
its `captured_s` is the arrival time, after encoding and network: set the known part of that delay
as `latency.camera_offset_s`.
"""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlsplit, urlunsplit

import cv2
import numpy as np

from bikeped.capture.base import FrameSource
from bikeped.capture.jpeg import EOI, read_size
from bikeped.capture.opencv import (
    Capture,
    FfmpegReader,
    OpenCapture,
    as_rgb,
    fourcc_text,
    frame_size,
    silence_opencv,
    usable_fps,
)
from bikeped.errors import CaptureError
from bikeped.types import Frame, ImageArray

_log = logging.getLogger(__name__)

JPEG_FORMATS = frozenset({"MJPG", "JPEG"})
# A time stamp older than this, or in the future, is not from the monotonic clock.
MAX_STAMP_AGE_S = 2.0
# OpenCV repeats its last buffer, without waiting, after some unplugs.
MAX_REPEATING_S = 1.0
REPEAT_PAUSE_S = 0.005
OPEN_TIMEOUT_MS = 5000
READ_TIMEOUT_MS = 5000


class V4l2Source(FrameSource):
    """A V4L2 camera by device path or number. `captured_s` is on the monotonic clock.

    `fourcc` MJPG gives JPEG frames; any other format is converted to RGB by OpenCV. Raises
    CaptureError when the camera is missing, busy or grants another size or format. `clock`,
    `sleep` and `open_capture` are for tests.
    """

    live = True

    def __init__(
        self,
        device: str,
        *,
        width: int,
        height: int,
        fps: float,
        fourcc: str = "MJPG",
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
        open_capture: OpenCapture = cv2.VideoCapture,
    ) -> None:
        self.name = f"/dev/video{int(device)}" if device.isdecimal() else device
        if len(fourcc) != 4:
            raise CaptureError(f"camera.fourcc: {fourcc!r} must have four characters, e.g. MJPG")
        self.width, self.height = width, height
        self._clock, self._sleep = clock, sleep
        self._raw = fourcc in JPEG_FORMATS
        self._number = 0
        self._last: tuple[float, bytes | ImageArray] | None = None
        self._last_s = -math.inf
        self._capture = self._open(open_capture)
        try:
            self.fps = self._set_up(fps, fourcc)
        except BaseException:
            self._capture.release()
            raise

    def read(self) -> Frame:
        repeating_since_s: float | None = None
        while True:
            try:
                ok, data = self._capture.read()
            except cv2.error as error:
                raise CaptureError(f"{self.name}: cannot be read ({error.err})") from error
            if not ok or data is None or data.size == 0:
                raise CaptureError(f"{self.name}: returned no image; is it still plugged in?")
            stamp_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
            image = trim(data.tobytes()) if self._raw else np.asarray(data, np.uint8)
            if not self._repeated(stamp_ms, image):
                return self._frame(stamp_ms, image)
            now_s = self._clock()
            if repeating_since_s is None:
                repeating_since_s = now_s
            elif now_s - repeating_since_s > MAX_REPEATING_S:
                raise CaptureError(f"{self.name}: repeats its last image; is it still plugged in?")
            self._sleep(REPEAT_PAUSE_S)

    def close(self) -> None:
        self._capture.release()

    def _open(self, open_capture: OpenCapture) -> Capture:
        try:
            with silence_opencv():
                capture = open_capture(self.name, cv2.CAP_V4L2)
                opened = capture.isOpened()
        except cv2.error as error:
            raise CaptureError(f"{self.name}: cannot be opened ({error.err})") from error
        if not opened:
            raise CaptureError(f"{self.name}: {_why_not_opened(Path(self.name))}")
        return capture

    def _set_up(self, fps: float, fourcc: str) -> float:
        """Sets format, size and rate, in this order; returns the granted rate."""
        capture = self._capture
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*fourcc))
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, self.width)
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self.height)
        capture.set(cv2.CAP_PROP_FPS, fps)
        width, height = frame_size(capture)
        if (width, height) != (self.width, self.height):
            raise CaptureError(
                f"{self.name}: grants {width}x{height}, not {self.width}x{self.height}; "
                f"set camera.width and camera.height to a size that "
                f"`v4l2-ctl -d {self.name} --list-formats-ext` shows for {fourcc}"
            )
        format_ = fourcc_text(capture.get(cv2.CAP_PROP_FOURCC))
        if format_ != fourcc.rstrip() and not (self._raw and format_ in JPEG_FORMATS):
            raise CaptureError(
                f"{self.name}: grants the format {format_ or 'unknown'}, not {fourcc}; set "
                f"camera.fourcc to one that `v4l2-ctl -d {self.name} --list-formats-ext` shows"
            )
        if self._raw and not capture.set(cv2.CAP_PROP_CONVERT_RGB, 0):
            raise CaptureError(f"{self.name}: OpenCV cannot return its JPEGs; update opencv-python")
        rate = capture.get(cv2.CAP_PROP_FPS)
        if not usable_fps(rate):
            return fps
        if abs(rate - fps) > 0.05 * fps:
            _log.warning("%s: grants %.3g frames per second, not %.3g", self.name, rate, fps)
        return rate

    def _repeated(self, stamp_ms: float, image: bytes | ImageArray) -> bool:
        """Whether this is the last buffer again: same time stamp and same bytes."""
        last, self._last = self._last, (stamp_ms, image)
        if last is None or last[0] != stamp_ms:
            return False
        return image == last[1] if isinstance(image, bytes) else np.array_equal(image, last[1])

    def _frame(self, stamp_ms: float, image: bytes | ImageArray) -> Frame:
        if self._number == 0:
            self._check_size(image)
        now_s = self._clock()
        captured_s = stamp_ms / 1000.0
        # Not from the monotonic clock, or not increasing: use the arrival time.
        if not (0.0 <= now_s - captured_s <= MAX_STAMP_AGE_S and captured_s > self._last_s):
            captured_s = now_s
        self._last_s = captured_s
        jpeg, rgb = (image, None) if isinstance(image, bytes) else (None, as_rgb(image))
        frame = Frame(self._number, captured_s, self.width, self.height, jpeg, rgb)
        self._number += 1
        return frame

    def _check_size(self, image: bytes | ImageArray) -> None:
        """Checks that the images have the granted size."""
        if isinstance(image, bytes):
            try:
                size = read_size(image)
            except CaptureError:
                return  # the decoder refuses a damaged image
        else:
            size = image.shape[1], image.shape[0]
        if size != (self.width, self.height):
            raise CaptureError(
                f"{self.name}: grants {self.width}x{self.height} but sends {size[0]}x{size[1]}; "
                "set camera.width and camera.height to that"
            )


def trim(data: bytes) -> bytes:
    """The JPEG without the driver's padding behind it.

    Without an end marker the bytes stay as they are, and the decoder refuses them.
    """
    end = data.rfind(EOI)
    return data if end < 0 else data[: end + len(EOI)]


def _why_not_opened(path: Path) -> str:
    if not path.exists():
        return "no such camera; plug it in, or set camera.source (`v4l2-ctl --list-devices`)"
    if not os.access(path, os.R_OK | os.W_OK):
        return "no permission; add this user to group video"
    return "cannot be opened; is it a camera, and is another program using it (`fuser -v`)?"


class NetworkSource(FrameSource):
    """A live stream by its address. `fps` is assumed where the stream has no frame rate.

    A stream that ends, fails or sends nothing for 5 s raises CaptureError.
    """

    live = True

    def __init__(
        self,
        address: str,
        *,
        fps: float,
        clock: Callable[[], float] = time.monotonic,
        open_capture: OpenCapture = cv2.VideoCapture,
    ) -> None:
        self.name = without_password(address)
        self._clock = clock
        self._reader = FfmpegReader(
            address,
            self.name,
            remedy="is the camera on, and are address, user and password right?",
            params={
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: OPEN_TIMEOUT_MS,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC: READ_TIMEOUT_MS,
            },
            open_capture=open_capture,
        )
        self._opened_s: float | None = clock()  # when the first frame, read by now, arrived
        self.width, self.height = self._reader.width, self._reader.height
        self.fps = self._reader.fps if usable_fps(self._reader.fps) else fps
        self._number = 0

    def read(self) -> Frame:
        image = self._reader.read()
        if image is None:
            raise CaptureError(f"{self.name}: the stream ended; is the camera still on?")
        arrived_s = self._clock() if self._opened_s is None else self._opened_s
        self._opened_s = None
        frame = Frame(self._number, arrived_s, self.width, self.height, image.jpeg, image.rgb)
        self._number += 1
        return frame

    def close(self) -> None:
        self._reader.close()


def without_password(address: str) -> str:
    """The address without user, password and query, for logs."""
    try:
        parts = urlsplit(address)
    except ValueError:
        return address.split("://", 1)[0] + "://..."
    return urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))
