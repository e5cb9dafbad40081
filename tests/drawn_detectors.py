"""Eyes that answer with what was drawn: for tests of what comes after a detector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from bikeped.detection.detector import DetectionResult
from bikeped.lab.rendering import DrawnObject
from bikeped.lab.rendering.clip import read_sidecar
from bikeped.pipeline.detection_scheduler import DecodedFrame
from bikeped.types import Detections


class OracleDetector:
    """Answers with `of(frame number)`."""

    name = "oracle"
    model_hash: str | None = None
    cyclist_box_includes_rider = True

    def __init__(self, of: Callable[[int], Detections]) -> None:
        self._of = of

    def decode_size(self, width: int, height: int) -> tuple[int, int]:
        return min(width, 640), min(height, 640)

    def detect(self, picture: DecodedFrame) -> DetectionResult:
        return DetectionResult(self._of(picture.frame.number), 0.0, 0.0, 0.0)


def clip_detector(sidecar: Path) -> OracleDetector:
    """Finds in every frame of a drawn clip all road users that are visible."""
    frames = read_sidecar(sidecar).frames
    return OracleDetector(lambda number: boxes([o for o in frames[number] if o.visible > 0.1]))


def boxes(objects: Sequence[DrawnObject]) -> Detections:
    """The exact boxes of what shows of `objects`."""
    return Detections(
        np.asarray([int(o.label) for o in objects], np.int8),
        np.full(len(objects), 0.9, np.float32),
        np.asarray([o.box_px for o in objects], np.float32).reshape(-1, 4),
    )
