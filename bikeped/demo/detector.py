"""The demo's stand-in for a detector: it does not look at pixels, it reads the drawn boxes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bikeped.demo.clip import read_sidecar
from bikeped.types import BoolArray, Detections, FloatArray, Kind

#: What the default configuration makes of a detector's classes: a motorcycle counts as a cyclist.
_KIND = {
    "pedestrian": Kind.PEDESTRIAN,
    "cyclist": Kind.CYCLIST,
    "motorcycle": Kind.CYCLIST,
    "car": Kind.VEHICLE,
    "bus": Kind.VEHICLE,
    "truck": Kind.VEHICLE,
}


class DrawnBoxDetector:
    """Answers with the boxes that were drawn into the frame of a given number."""

    name = "simulated detector (reads the drawn boxes)"

    def __init__(
        self,
        sidecar: Path,
        *,
        confidence: float = 0.9,
        recall: float = 1.0,
        noise_px: float = 0.0,
        seed: int = 0,
    ) -> None:
        """`recall`: share of boxes found; `noise_px`: standard deviation of every box edge.

        Both are drawn from `seed` and the frame's number, so an answer does not depend on which
        frames were asked for before.
        """
        if not (0 <= recall <= 1 and 0 <= confidence <= 1 and noise_px >= 0):
            raise ValueError("recall and confidence lie in 0..1, noise_px is not negative")
        self.header, self._frames = read_sidecar(sidecar)
        self.confidence, self.recall = confidence, recall
        self.noise_px, self.seed = noise_px, seed

    @property
    def frame_size(self) -> tuple[int, int]:
        """Width and height of the frames, in whose pixels the boxes are."""
        return int(self.header["width"]), int(self.header["height"])

    def __len__(self) -> int:
        return len(self._frames)

    def answer(self, frame_number: int) -> Detections:
        """The detections of one frame, in the order of drawing; none beyond the last frame."""
        if not 0 <= frame_number < len(self._frames):
            return Detections.empty()
        objects = self._frames[frame_number]
        n = len(objects)
        box: FloatArray = np.array([item.box_px for item in objects], np.float64).reshape(n, 4)
        kind = np.array([_KIND[item.kind] for item in objects], np.int8)
        found: BoolArray = np.ones(n, np.bool_)
        if self.recall < 1 or self.noise_px > 0:
            rng = np.random.default_rng((self.seed, frame_number))
            found = rng.random(n) < self.recall
            box = box + rng.normal(0.0, self.noise_px, box.shape)
            box = np.concatenate(
                [np.minimum(box[:, :2], box[:, 2:]), np.maximum(box[:, :2], box[:, 2:])], axis=1
            )
            limit = np.array([*self.frame_size, *self.frame_size], np.float64)
            box = np.clip(box, 0.0, limit)
        confidence = np.full(n, self.confidence, np.float32)
        return Detections(kind, confidence, box.astype(np.float32)).take(found)
