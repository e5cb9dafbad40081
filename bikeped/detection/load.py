"""From the configuration to a detector: which runtime runs the model file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bikeped.detection.base import Detector
from bikeped.detection.model_hash import verify_sha256
from bikeped.errors import DetectorError
from bikeped.models import model_file
from bikeped.types import Region

if TYPE_CHECKING:
    from bikeped.config.schema.inputs import DetectionConfig


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
        return OnnxDetector(path, config, verify_sha256(path, config.sha256), road)
    if path.suffix.lower() == ".engine":
        from bikeped.detection.trt_engine import EngineDetector

        return EngineDetector(path, config, verify_sha256(path, config.sha256), road=road)
    raise DetectorError(
        f"detection.model: {path} is neither .onnx nor .engine; export the model to one of them"
    )
