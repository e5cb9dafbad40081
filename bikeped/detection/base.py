"""What a detector is to the rest of bikeped, and how one is loaded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from bikeped.detection.hashing import checked_sha256
from bikeped.errors import DetectorError
from bikeped.models import model_file
from bikeped.types import Detections, ImageArray, Region

if TYPE_CHECKING:
    from bikeped.config.sections import DetectionConfig


@dataclass(frozen=True)
class DetectorAnswer:
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
    def riders_whole(self) -> bool:
        """Whether a cyclist's box holds the rider, too, who is then no pedestrian beside it."""
        ...

    def decode_size(self, frame_width: int, frame_height: int) -> tuple[int, int]:
        """Least width and height of picture that loses nothing against the full frame.

        A JPEG decoder may stop at any reduced scale that is not smaller than this.
        """
        ...

    def infer(self, rgb: ImageArray, frame_width: int, frame_height: int) -> DetectorAnswer:
        """Detections in `rgb` [h, w, 3] uint8, a frame decoded at any scale.

        Boxes are in pixels of the full frame of `frame_width` x `frame_height`, clipped to it; most
        confident first, equal confidences in the network's order, so the same picture gives the
        same answer. Raises `DetectorError` where the network fails or answers no numbers, and
        `ValueError` for a picture that is not the frame's.
        """
        ...


def load_detector(config: DetectionConfig, base_dir: Path, road: Region | None = None) -> Detector:
    """The detector that `detection` describes, warmed up: the first frame is no slower than others.

    `base_dir` is the folder that a relative `detection.model` starts from; `bundled` is the model
    that comes with bikeped, on a processor in eight bits. `road`: the part of the camera's frames
    that road users can be in, for `detection.region`; None: unknown, all are shown. Raises
    `DetectorError` where there is no model, its hash differs, or it cannot be run or understood.
    """
    if config.model is None:
        raise DetectorError(
            "detection.model: no model is configured; name an .onnx or .engine file, or bundled"
        )
    path = model_file(config.model, base_dir)
    # Imported where needed: a pole with an engine does without onnxruntime, and the reverse.
    if path.suffix.lower() == ".onnx":
        from bikeped.detection.onnx_runtime import OnnxDetector, runs_on_cpu

        path = model_file(config.model, base_dir, on_cpu=runs_on_cpu(config.providers))
        return OnnxDetector(path, config, checked_sha256(path, config.sha256), road)
    if path.suffix.lower() == ".engine":
        from bikeped.detection.trt_engine import EngineDetector

        return EngineDetector(path, config, checked_sha256(path, config.sha256), road=road)
    raise DetectorError(
        f"detection.model: {path} is neither .onnx nor .engine; export the model to one of them"
    )
