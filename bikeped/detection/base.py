"""What a detector is to the rest of bikeped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from bikeped.types import Detections, ImageArray


@dataclass(frozen=True)
class DetectionResult:
    """What was found in one frame, and how long each stage took, in milliseconds."""

    detections: Detections
    pre_ms: float
    inference_ms: float
    post_ms: float


class Detector(Protocol):
    """Finds road users in pictures. For one thread at a time: buffers are reused."""

    @property
    def name(self) -> str:
        """For people: the model file and what runs it."""
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
        """Least width and height of picture that loses nothing against the full frame.

        A JPEG decoder may stop at any reduced scale that is not smaller than this.
        """
        ...

    def infer(self, rgb: ImageArray, frame_width: int, frame_height: int) -> DetectionResult:
        """Detections in `rgb` [h, w, 3] uint8, a frame decoded at any scale.

        Boxes are in pixels of the full frame of `frame_width` x `frame_height`, clipped to it; most
        confident first, equal confidences in the network's order, so the same picture gives the
        same answer. Raises `DetectorError` where the network fails or answers no numbers, and
        `ValueError` for a picture that is not the frame's.
        """
        ...
