"""Live cameras: at /dev/videoN through OpenCV's V4L2 backend, or on the network.

With CAP_PROP_CONVERT_RGB off OpenCV returns a V4L2 camera's Motion JPEG undecoded, and
CAP_PROP_POS_MSEC is the kernel's time stamp of the buffer. Not run on a real camera yet: written
from OpenCV's documentation and tested against a fake at cv2.VideoCapture. OpenCV waits a second for
a buffer of a V4L2 camera. A read that the driver itself does not end cannot be ended from here: see
`FrameGrabber.replace_hung`.

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

import cv2

from bikeped.capture.base import Image
from bikeped.capture.jpeg import EOI
from bikeped.capture.opencv import (
    FfmpegSource,
    OpenCapture,
    OpenCvSource,
    fourcc_text,
    frame_size,
    image_size,
    usable_fps,
)
from bikeped.capture.source_names import DeviceNames, shown_source
from bikeped.errors import CaptureError
from bikeped.types import Frame

_log = logging.getLogger(__name__)

JPEG_FORMATS = frozenset({"MJPG", "JPEG"})
# A time stamp older than this, or in the future, is not from the monotonic clock.
MAX_STAMP_AGE_S = 2.0
# OpenCV repeats its last buffer, without waiting, after some unplugs.
MAX_REPEATING_S = 1.0
REPEAT_PAUSE_S = 0.005
# A camera that returns is ready 5 s later at most: an attempt that began before must end soon.
OPEN_TIMEOUT_MS = 3500
READ_TIMEOUT_MS = 1500
DEVICE_NAMES = DeviceNames()


class V4l2Source(OpenCvSource):
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
        names: DeviceNames = DEVICE_NAMES,
    ) -> None:
        device = f"/dev/video{int(device)}" if device.isdecimal() else device
        path = names.find(device)
        super().__init__(path, device, "is it still plugged in?", open_capture)
        if len(fourcc) != 4:
            raise CaptureError(f"camera.fourcc: {fourcc!r} must have four characters, e.g. MJPG")
        self.width, self.height = width, height
        self._clock, self._sleep = clock, sleep
        self._raw = fourcc in JPEG_FORMATS
        self._last: tuple[Image, float] | None = None
        self._last_s = -math.inf
        # In seconds; OpenCV's own 10 s would delay a new capture. It is read with the first camera.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")
        self._open(cv2.CAP_V4L2)
        try:
            self.fps = self._set_up(fps, fourcc)
        except BaseException:
            self.close()
            raise
        names.remember(device, path)

    def read(self) -> Frame:
        repeating_since_s: float | None = None
        while True:
            found = self._read()
            if found is None:
                raise CaptureError(f"{self.name}: returned no image; {self._remedy}")
            image, stamp_s = found
            if isinstance(image, bytes):
                image = trim(image)
            last, self._last = self._last, (image, stamp_s)
            if last is None or last[1] != stamp_s or bytes(image) != bytes(last[0]):
                break
            now_s = self._clock()
            if repeating_since_s is None:
                repeating_since_s = now_s
            elif now_s - repeating_since_s > MAX_REPEATING_S:
                raise CaptureError(f"{self.name}: repeats its last image; {self._remedy}")
            self._sleep(REPEAT_PAUSE_S)
        size = image_size(image)
        if size is not None and size != (self.width, self.height):
            raise CaptureError(
                f"{self.name}: grants {self.width}x{self.height} but sends {size[0]}x{size[1]}; "
                "set camera.width and camera.height to that"
            )
        now_s = self._clock()
        # Not from the monotonic clock, or not increasing: use the arrival time.
        if not (0.0 <= now_s - stamp_s <= MAX_STAMP_AGE_S and stamp_s > self._last_s):
            stamp_s = now_s
        self._last_s = stamp_s
        return self._frame(stamp_s, image)

    def _why_not_opened(self) -> str:
        if not Path(self._address).exists():
            return "no such camera; plug it in, or set camera.source (`v4l2-ctl --list-devices`)"
        if not os.access(self._address, os.R_OK | os.W_OK):
            return "no permission; add this user to group video"
        return "cannot be opened; is it a camera, and is another program using it (`fuser -v`)?"

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


def trim(data: bytes) -> bytes:
    """The JPEG without the driver's padding behind it.

    Without an end marker the bytes stay as they are, and the decoder refuses them.
    """
    end = data.rfind(EOI)
    return data if end < 0 else data[: end + len(EOI)]


class NetworkSource(FfmpegSource):
    """A live stream by its address. `fps` is assumed where the stream has no frame rate.

    A stream that ends, fails or sends nothing for 1.5 s raises CaptureError. A frame has the size
    of its own picture, which a stream may change.
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
        remedy = "is the camera on, and are address, user and password right?"
        params = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: OPEN_TIMEOUT_MS,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: READ_TIMEOUT_MS,
        }
        super().__init__(address, shown_source(address), remedy, open_capture, params)
        self._clock = clock
        self._opened_s = clock()  # when the first frame, read by now, arrived
        self.fps = self.fps if usable_fps(self.fps) else fps

    def read(self) -> Frame:
        found = self._next()
        if found is None:
            raise CaptureError(f"{self.name}: the stream ended; is the camera still on?")
        self.width, self.height = image_size(found[0]) or (self.width, self.height)
        return self._frame(self._clock() if self._number else self._opened_s, found[0])
