"""The demo's eye: the boxes of what was drawn, in place of a model."""

from __future__ import annotations

from bikeped.demo import DrawnBoxDetector
from bikeped.detection.base import DetectorAnswer
from bikeped.service.vision import Picture


class DrawnEye:
    """Answers with the drawn boxes of the picture's frame; says so in its name."""

    model_hash: str | None = None

    def __init__(self, detector: DrawnBoxDetector) -> None:
        self._detector = detector
        self.name = detector.name

    def decode_size(self, width: int, height: int) -> tuple[int, int]:
        return min(width, 640), min(height, 640)

    def see(self, picture: Picture) -> DetectorAnswer:
        return DetectorAnswer(self._detector.answer(picture.frame.number), 0.0, 0.0, 0.0)
