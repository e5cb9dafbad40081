"""A camera on the network: RTSP, or Motion JPEG and other streams over HTTP.

OpenCV gives no capture time for these, so `captured_s` is the arrival time, after encoding and
network: set the known part of that delay as `latency.camera_offset_s`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from urllib.parse import urlsplit, urlunsplit

import cv2

from bikeped.capture.base import FrameSource
from bikeped.capture.opencv import FfmpegReader, OpenCapture, usable_fps
from bikeped.errors import CaptureError
from bikeped.types import Frame

OPEN_TIMEOUT_MS = 5000
READ_TIMEOUT_MS = 5000


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
            params=[
                int(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC),
                OPEN_TIMEOUT_MS,
                int(cv2.CAP_PROP_READ_TIMEOUT_MSEC),
                READ_TIMEOUT_MS,
            ],
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
