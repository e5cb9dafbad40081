"""The detector on ONNX Runtime: TensorRT, CUDA or CPU, the first one present."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnxruntime as ort

from bikeped.config.schema import DetectionConfig
from bikeped.detection.model_metadata import (
    ModelMetadata,
    choose_region,
    is_free,
    parse_metadata,
    resolve_input,
)
from bikeped.errors import DetectorError
from bikeped.types import Region

log = logging.getLogger(__name__)

_PROVIDERS = {
    "tensorrt": "TensorrtExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "cpu": "CPUExecutionProvider",
}
_INPUT_TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
}
_ERRORS_ONLY = 3  #: ONNX Runtime's log severity; its warnings are about optimisation


class OnnxBackend:
    """An ONNX Runtime session with one input array that is reused."""

    def __init__(
        self, path: Path, config: DetectionConfig, model_hash: str, road: Region | None = None
    ) -> None:
        """Opens the model; `road` as for `load_detector`. Raises `DetectorError` where that fails.

        `model_hash` names the cache folder of the engines that TensorRT builds.
        ONNX Runtime names a cached engine after the graph, not the weights: in a common folder, a
        retrained model would run with the old one's engine.
        """
        self._source = str(path)
        wanted = choose_providers(config.providers, ort.get_available_providers())
        cache = Path(config.engine_cache).expanduser() / model_hash[:16]
        providers = [(name, _options(name, cache, self._source)) for name in wanted]
        self._session = self._open(config, providers, {})
        used = self._session.get_providers()
        if used[:1] != wanted[:1]:
            log.warning(
                "%s: %s did not start, running on %s; see the log of ONNX Runtime",
                path,
                wanted[0],
                used[0] if used else "nothing",
            )
        self._runs_on = used[0].removesuffix("ExecutionProvider") if used else "nothing"
        self.metadata: ModelMetadata = parse_metadata(
            self._session.get_modelmeta().custom_metadata_map, self._source
        )
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            raise DetectorError(f"{path}: the model has {len(inputs)} inputs; bikeped needs one")
        kind = _INPUT_TYPES.get(inputs[0].type)
        if kind is None:
            raise DetectorError(
                f"{path}: input {inputs[0].name} is {inputs[0].type}; export with float32, float16 "
                "or uint8 input"
            )
        shape = inputs[0].shape
        self.region = choose_region(config, road, is_free(shape))
        size = resolve_input(inputs[0].name, shape, kind, self.metadata, self._source, self.region)
        sides = zip(shape, size, strict=True)
        names = {name: side for name, side in sides if isinstance(name, str) and name}
        if names:  # a known size is planned better, and TensorRT needs no range of sizes
            self._session = self._open(config, providers, names)
        self.buffer: npt.NDArray[Any] = np.zeros(size, kind)
        self._feed = {inputs[0].name: self.buffer}
        self._names: list[str] = [output.name for output in self._session.get_outputs()]

    def _open(
        self,
        config: DetectionConfig,
        providers: list[tuple[str, dict[str, str]]],
        sizes: dict[str, int],
    ) -> ort.InferenceSession:
        """A session; `sizes` of the dimensions that the model leaves free, by their names."""
        options = ort.SessionOptions()
        options.log_severity_level = _ERRORS_ONLY
        if config.threads:
            options.intra_op_num_threads = config.threads
        # A spinning thread would occupy the core that decodes the next image.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        for name, size in sizes.items():
            options.add_free_dimension_override_by_name(name, size)
        try:
            return ort.InferenceSession(self._source, sess_options=options, providers=providers)
        except Exception as error:  # its errors share no class but this one
            raise DetectorError(
                f"{self._source}: ONNX Runtime cannot load the model ({_line(error)}); export it "
                "again or copy it again"
            ) from error

    @property
    def description(self) -> str:
        """The runtime and the provider that the session started with."""
        return f"ONNX Runtime {ort.__version__}, {self._runs_on}"

    def run(self) -> list[tuple[str, npt.NDArray[Any]]]:
        """See `Backend.run`."""
        try:
            answers = self._session.run(self._names, self._feed)
        except Exception as error:  # its errors share no class but this one
            raise DetectorError(f"{self._source}: inference failed: {_line(error)}") from error
        # An output may also be a list or a map of some operators; those are not detections.
        return [(name, np.asarray(a)) for name, a in zip(self._names, answers, strict=True)]


def choose_providers(wanted: tuple[str, ...], available: list[str]) -> list[str]:
    """ONNX Runtime's names of the wanted providers that are present, in the wanted order.

    Raises `DetectorError` where none is.
    """
    chosen = [_PROVIDERS[name] for name in wanted if _PROVIDERS[name] in available]
    if not chosen:
        raise DetectorError(
            f"detection.providers: none of {', '.join(wanted)} is in this ONNX Runtime, which has "
            f"{', '.join(available)}; add cpu or install the GPU build"
        )
    return chosen


def runs_on_cpu(wanted: tuple[str, ...]) -> bool:
    """Whether the first of the wanted providers that is present is the processor.

    Raises `DetectorError` where none is.
    """
    return choose_providers(wanted, ort.get_available_providers())[0] == _PROVIDERS["cpu"]


def _options(provider: str, cache: Path, source: str) -> dict[str, str]:
    """Options of a provider (onnxruntime.ai, execution providers, TensorRT)."""
    if provider != _PROVIDERS["tensorrt"]:
        return {}
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DetectorError(
            f"detection.engine_cache: cannot make {cache} for {source}: {error.strerror}; name a "
            "folder that can be written"
        ) from error
    return {
        "trt_fp16_enable": "1",
        "trt_engine_cache_enable": "1",
        "trt_engine_cache_path": str(cache),
        "trt_timing_cache_enable": "1",
        "trt_timing_cache_path": str(cache),
    }


def _line(error: BaseException) -> str:
    """The error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
