"""Creates the detector that the configuration describes."""

from __future__ import annotations

from pathlib import Path

from bikeped.config.schema import DetectionConfig
from bikeped.detection.base import Detector
from bikeped.detection.model_hash import verify_sha256
from bikeped.errors import DetectorError
from bikeped.models import model_file
from bikeped.types import Region


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
    # Imported where needed: an .engine does not need onnxruntime, nor an .onnx file tensorrt.
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
