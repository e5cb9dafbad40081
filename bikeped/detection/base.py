"""The detector interface, and loading the detector that the configuration describes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from bikeped.config.schema import DetectionConfig
from bikeped.errors import DetectorError
from bikeped.models import model_file
from bikeped.types import Detections, ImageArray, Region

_CHUNK = 1 << 20


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

    @property
    def model_hash(self) -> str:
        """SHA-256 of the model file, lower-case hexadecimal."""

    @property
    def input_size(self) -> tuple[int, int]:
        """Width and height of the network's input, pixels."""

    @property
    def cyclist_box_includes_rider(self) -> bool:
        """Whether a cyclist's box holds the rider, too, who is then no pedestrian beside it."""

    def decode_size(self, frame_width: int, frame_height: int) -> tuple[int, int]:
        """Smallest decoded width and height that lose nothing against the full frame.

        A JPEG decoder may use any reduced scale that is not smaller than this.
        """

    def infer(self, rgb: ImageArray, frame_width: int, frame_height: int) -> DetectionResult:
        """Detections in `rgb` [h, w, 3] uint8, a frame decoded at any scale.

        Boxes are in pixels of the full frame of `frame_width` x `frame_height`, clipped to it; most
        confident first, equal confidences in the network's order (deterministic). Raises
        `DetectorError` where the network fails or returns no numbers, and `ValueError` for an image
        of another aspect ratio than the frame's.
        """


def sha256_of(path: Path, expected: str | None = None) -> str:
    """The file's SHA-256 in lower-case hexadecimal, read in chunks of 1 MiB.

    Raises `DetectorError` where the file cannot be read or is not `expected`, `detection.sha256`.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
    except FileNotFoundError:
        raise DetectorError(
            f"{path}: no such model file; correct detection.model or put the file there"
        ) from None
    except OSError as error:
        raise DetectorError(f"{path}: cannot read the model file: {error.strerror}") from error
    actual = digest.hexdigest()
    if expected is not None and expected.lower() != actual:
        raise DetectorError(
            f"{path}: SHA-256 is {actual} but detection.sha256 expects {expected.lower()}; "
            "put the right model there or correct detection.sha256"
        )
    return actual


def load_detector(config: DetectionConfig, base_dir: Path, road: Region | None = None) -> Detector:
    """The detector of the section `detection`, warmed up.

    A relative `detection.model` starts from `base_dir`; `bundled` is the model that comes with
    bikeped, with 8-bit weights on a CPU. `road` is the part of the frames in which road users can
    appear, for `detection.region`; None: the whole frame. Raises `DetectorError` where there is no
    model, its hash differs, it cannot be run, or its output layout is unknown.
    """
    if config.model is None:
        raise DetectorError(
            "detection.model: no model is configured; name an .onnx or .engine file, or bundled"
        )
    path = model_file(config.model, base_dir)
    from bikeped.detection.detector import Backend, NetworkDetector

    # Imported where needed: an .engine does not need onnxruntime, nor an .onnx file tensorrt.
    if path.suffix.lower() == ".onnx":
        from bikeped.detection.onnx_runtime import OnnxBackend, runs_on_cpu

        path = model_file(config.model, base_dir, on_cpu=runs_on_cpu(config.providers))
        digest = sha256_of(path, config.sha256)
        backend: Backend = OnnxBackend(path, config, digest, road)
    elif path.suffix.lower() == ".engine":
        from bikeped.detection.trt_engine import EngineBackend

        digest = sha256_of(path, config.sha256)
        backend = EngineBackend(path, config, road)
    else:
        raise DetectorError(
            f"detection.model: {path} is neither .onnx nor .engine; export the model to one of them"
        )
    return NetworkDetector(path, config, digest, backend)
