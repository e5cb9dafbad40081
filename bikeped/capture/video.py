"""Recorded video.

Motion JPEG (AVI, MKV, MOV, MP4) is passed on packet by packet, so that a frame is decoded once, at
the scale that the detector needs. Other codecs are decoded by FFmpeg, in software. Two runs over
one file give the same bytes and times.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path

import cv2

from bikeped.capture.base import FrameSource
from bikeped.capture.opencv import FfmpegReader, OpenCapture, usable_fps
from bikeped.errors import CaptureError
from bikeped.types import Frame

_log = logging.getLogger(__name__)

# A container's frame count may be an estimate; a file with less than this share is truncated.
COMPLETE_SHARE = 0.95


class VideoSource(FrameSource):
    """A video file. `captured_s` is media time in seconds, strictly increasing.

    It is the container's time stamp where that increases, else the previous frame's plus one frame
    period. Raises CaptureError for a missing, broken or empty file and for one
    without a frame rate.
    """

    live = False

    def __init__(self, path: Path | str, *, open_capture: OpenCapture = cv2.VideoCapture) -> None:
        self.name = str(path)
        remedy = (
            "is it a complete video file? `ffprobe` says what is in it, and "
            "`ffmpeg -i IN -c copy OUT.mkv` repairs some"
        )
        if not Path(path).is_file():
            raise CaptureError(f"{self.name}: no such file; set camera.source to a video")
        self._reader = FfmpegReader(self.name, self.name, remedy=remedy, open_capture=open_capture)
        self.width, self.height = self._reader.width, self._reader.height
        self.fps = self._reader.fps
        self._number = 0
        self._last_s = -math.inf
        if not usable_fps(self.fps):
            self._reader.close()
            raise CaptureError(
                f"{self.name}: has no frame rate (it says {self.fps:g}); "
                "`ffmpeg -r 30 -i IN -c copy OUT.mkv` writes one"
            )

    def read(self) -> Frame | None:
        image = self._reader.read()
        if image is None:
            self._report_end()
            return None
        captured_s = image.media_s
        if not (math.isfinite(captured_s) and captured_s > self._last_s):
            captured_s = self._last_s + 1.0 / self.fps if self._number else 0.0
        frame = Frame(self._number, captured_s, self.width, self.height, image.jpeg, image.rgb)
        self._number += 1
        self._last_s = captured_s
        return frame

    def close(self) -> None:
        self._reader.close()

    def _report_end(self) -> None:
        expected = self._reader.expected_frames
        if self._number < COMPLETE_SHARE * expected:
            text = "%s: ends after %d of %.0f frames; is the file truncated?"
            _log.warning(text, self.name, self._number, expected)
