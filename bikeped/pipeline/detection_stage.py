"""From a frame to detections: decoding, then a detector."""

from __future__ import annotations

import queue
import time
from dataclasses import dataclass
from typing import Protocol

from bikeped.capture.jpeg import JpegDecoder
from bikeped.detection.base import DetectionResult, Detector
from bikeped.types import Frame, ImageArray

#: Inferences at once on a recording, where the processor does them: see `load_detector_pool`.
MAX_INFLIGHT = 2
#: Decoded frames in use at once: being decoded, waiting, processed, drawn, a spare, and detected.
FRAME_BUFFERS = 5 + MAX_INFLIGHT


@dataclass(frozen=True)
class DecodedFrame:
    """A decoded frame; `rgb` may be a scaled copy and is valid for the next `FRAME_BUFFERS` - 1."""

    frame: Frame
    rgb: ImageArray
    received_s: float  #: time.perf_counter() when the frame was taken over
    acquire_ms: float
    decode_ms: float


class FrameDetector(Protocol):
    """What finds road users in a frame: a model, or the demo's reader of drawn boxes."""

    name: str
    model_hash: str | None
    cyclist_box_includes_rider: bool

    def decode_size(self, width: int, height: int) -> tuple[int, int]:
        """Smallest width and height that it needs of a frame of this size, in pixels."""

    def detect(self, decoded: DecodedFrame) -> DetectionResult:
        """What is in the frame; raises DetectorError. Called in up to `max_inflight` threads."""


class DetectorPool:
    """A detector model, in as many copies as frames are detected at once."""

    def __init__(self, *detectors: Detector) -> None:
        first = detectors[0]
        self.name = first.name
        self.model_hash: str | None = first.model_hash
        self.cyclist_box_includes_rider = first.cyclist_box_includes_rider
        self.max_inflight = len(detectors)
        self._decode_size = first.decode_size
        self._free: queue.SimpleQueue[Detector] = queue.SimpleQueue()
        for detector in detectors:
            self._free.put(detector)

    def decode_size(self, width: int, height: int) -> tuple[int, int]:
        return self._decode_size(width, height)

    def detect(self, decoded: DecodedFrame) -> DetectionResult:
        detector = self._free.get()
        try:
            return detector.infer(decoded.rgb, decoded.frame.width, decoded.frame.height)
        finally:
            self._free.put(detector)


class DetectionStage:
    """Decodes at the smallest scale that the detector needs, and detects.

    `view_width`: pixels that a picture for people needs. `decode` belongs to one thread, `detect`
    to one or more others.
    """

    def __init__(self, detector: FrameDetector, view_width: int = 0) -> None:
        self.detect = detector.detect
        self._decode_size = detector.decode_size
        self._view_width = view_width
        self._jpeg = JpegDecoder(buffers=FRAME_BUFFERS)

    def decode(self, frame: Frame, received_s: float, acquire_ms: float) -> DecodedFrame:
        """The decoded frame; raises CaptureError when it does not decode."""
        began = time.perf_counter()
        if frame.rgb is not None:
            rgb = frame.rgb
        else:
            assert frame.jpeg is not None  # noqa: S101  Frame holds one of the two
            width, height = self._decode_size(frame.width, frame.height)
            view = min(self._view_width, frame.width)
            if view > width:
                width, height = view, max(height, round(frame.height * view / frame.width))
            rgb = self._jpeg.decode(frame.jpeg, min_width=width, min_height=height)
        decode_ms = (time.perf_counter() - began) * 1e3
        return DecodedFrame(frame, rgb, received_s, acquire_ms, decode_ms)
