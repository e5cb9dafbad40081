"""The detector interface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from bikeped.types import Detections, ImageArray


@dataclass(frozen=True)
class DetectionResult:
    """Detections in one frame, and the time that each stage took, in milliseconds."""

    detections: Detections
    pre_ms: float
    inference_ms: float
    post_ms: float


class Detector(Protocol):
    """Detects road users in frames. For one thread at a time: buffers are reused."""

    @property
    def name(self) -> str:
        """The model file and its runtime, for messages."""
        ...

    @property
    def model_hash(self) -> str:
        """SHA-256 of the model file, lower-case hexadecimal."""
        ...

    @property
    def input_size(self) -> tuple[int, int]:
        """Width and height of the network's input, pixels."""
        ...

    @property
    def cyclist_box_includes_rider(self) -> bool:
        """Whether a cyclist's box holds the rider, too, who is then no pedestrian beside it."""
        ...

    def decode_size(self, frame_width: int, frame_height: int) -> tuple[int, int]:
        """Smallest decoded width and height that lose nothing against the full frame.

        A JPEG decoder may use any reduced scale that is not smaller than this.
        """
        ...

    def infer(self, rgb: ImageArray, frame_width: int, frame_height: int) -> DetectionResult:
        """Detections in `rgb` [h, w, 3] uint8, a frame decoded at any scale.

        Boxes are in pixels of the full frame of `frame_width` x `frame_height`, clipped to it; most
        confident first, equal confidences in the network's order (deterministic). Raises
        `DetectorError` where the network fails or returns no numbers, and `ValueError` for an image
        of another aspect ratio than the frame's.
        """
        ...
