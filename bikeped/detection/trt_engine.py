"""The detector on a native TensorRT 10 engine, through JetPack's `tensorrt` package.

An engine fits the GPU and the TensorRT version that built it. The package is imported only when an
`.engine` is loaded; it comes with JetPack, not from PyPI. A file written by Ultralytics starts with
a 4-byte little-endian length and that many bytes of JSON; a bare engine (trtexec) works, too.

Not run on hardware here: written against the documented API (docs.nvidia.com/deeplearning/tensorrt,
Python API: ICudaEngine, IExecutionContext) and tested with a stand-in for the package.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.config.schema import DetectionConfig
from bikeped.detection.cuda import Cuda
from bikeped.detection.detector import NetworkDetector
from bikeped.detection.model_metadata import (
    ModelMetadata,
    choose_region,
    parse_metadata,
    resolve_input,
)
from bikeped.errors import DetectorError
from bikeped.types import Region

_LARGEST_HEADER = 1 << 20
#: TensorRT's DataType by name. Its own `nptype` is avoided: it touches np.bool in some releases.
_TYPES: dict[str, np.dtype[Any]] = {
    "FLOAT": np.dtype(np.float32),
    "HALF": np.dtype(np.float16),
    "UINT8": np.dtype(np.uint8),
    "INT8": np.dtype(np.int8),
    "INT32": np.dtype(np.int32),
    "INT64": np.dtype(np.int64),
}


class EngineDetector(NetworkDetector):
    """A `Detector` for an `.engine` file."""

    def __init__(
        self,
        path: Path,
        config: DetectionConfig,
        model_hash: str,
        cuda: Cuda | None = None,
        road: Region | None = None,
    ) -> None:
        """Loads and warms up the engine; `road` as `load_detector` has it.

        Raises `DetectorError` where that fails.
        """
        region = choose_region(config, road, False)  # an engine's input is of one size
        super().__init__(path, config, model_hash, EngineBackend(path, cuda), region)


def split_header(data: bytes) -> tuple[Mapping[str, object], memoryview]:
    """Ultralytics' metadata (empty where there is none) and the engine itself.

    A bare engine starts with a magic number, which read as a length points beyond any header.
    """
    whole = memoryview(data)
    length = int.from_bytes(whole[:4], "little")
    if 2 <= length <= min(_LARGEST_HEADER, len(data) - 4) and data[4:5] == b"{":
        try:
            header = json.loads(data[4 : 4 + length].decode("utf-8"))
        except (ValueError, RecursionError):
            header = None
        if isinstance(header, dict):
            return header, whole[4 + length :]
    return {}, whole


class EngineBackend:
    """An engine, its execution context, and one buffer a tensor on either side."""

    def __init__(self, path: Path, cuda: Cuda | None = None) -> None:
        self._source = str(path)
        trt = _import(path)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DetectorError(f"{path}: cannot read the engine: {error.strerror}") from error
        header, plan = split_header(data)
        self.metadata: ModelMetadata = parse_metadata(header, self._source)
        self._version = str(trt.__version__)
        self._cuda = cuda if cuda is not None else Cuda()
        # Logger and runtime must outlive the engine.
        self._logger = trt.Logger(trt.Logger.WARNING)
        self._runtime = trt.Runtime(self._logger)
        self._engine = self._runtime.deserialize_cuda_engine(bytes(plan))
        if self._engine is None:
            raise DetectorError(
                f"{path}: TensorRT {self._version} cannot load this engine; engines fit one GPU "
                "and one TensorRT version: build it again on this machine"
            )
        self._context = self._engine.create_execution_context()
        if self._context is None:
            raise DetectorError(f"{path}: not enough GPU memory for the engine; use a smaller one")
        names = [self._engine.get_tensor_name(i) for i in range(self._engine.num_io_tensors)]
        taken = [n for n in names if self._engine.get_tensor_mode(n) == trt.TensorIOMode.INPUT]
        if len(taken) != 1:
            raise DetectorError(f"{path}: the engine has {len(taken)} inputs; bikeped needs one")
        self.buffer: npt.NDArray[Any] = self._bind_input(taken[0])
        self._outputs = [self._bind_output(name) for name in names if name != taken[0]]

    @property
    def description(self) -> str:
        """The runtime and its version."""
        return f"TensorRT {self._version}"

    def run(self) -> list[tuple[str, npt.NDArray[Any]]]:
        """See `Backend.run`."""
        self._cuda.upload(self._input_address, self.buffer)
        if not self._context.execute_async_v3(stream_handle=self._cuda.stream):
            raise DetectorError(f"{self._source}: TensorRT failed to run the engine; see its log")
        for _, array, address in self._outputs:
            self._cuda.download(array, address)
        self._cuda.synchronize()
        return [(name, array) for name, array, _ in self._outputs]

    def _bind_input(self, name: str) -> npt.NDArray[Any]:
        shape = [int(d) for d in self._engine.get_tensor_shape(name)]
        if min(shape, default=0) < 0 and self.metadata.image_size is None:
            # Dynamic and unnamed: what the engine was tuned for (of minimum, optimum, maximum).
            shape = [int(d) for d in self._engine.get_tensor_profile_shape(name, 0)[1]]
        spec = resolve_input(name, shape, self._dtype(name), self.metadata, self._source)
        if not self._context.set_input_shape(name, spec.shape):
            raise DetectorError(
                f"{self._source}: the engine refuses input {list(spec.shape)}; build it for this "
                "shape"
            )
        array = self._cuda.host(spec.shape, spec.dtype)
        self._input_address = self._cuda.device(array.nbytes)
        self._address(name, self._input_address)
        return array

    def _bind_output(self, name: str) -> tuple[str, npt.NDArray[Any], int]:
        shape = tuple(int(d) for d in self._context.get_tensor_shape(name))
        if min(shape, default=0) < 0:
            raise DetectorError(
                f"{self._source}: output {name} has no fixed shape {list(shape)}; export without "
                "data-dependent outputs"
            )
        array = self._cuda.host(shape, self._dtype(name))
        address = self._cuda.device(array.nbytes)
        self._address(name, address)
        return name, array, address

    def _address(self, name: str, address: int) -> None:
        if not self._context.set_tensor_address(name, address):
            raise DetectorError(f"{self._source}: TensorRT refuses the buffer of {name}")

    def _dtype(self, name: str) -> np.dtype[Any]:
        kind = self._engine.get_tensor_dtype(name)
        # An enumeration of pybind11: `name` where it has one, else the end of its text.
        word = str(getattr(kind, "name", kind)).rsplit(".", 1)[-1]
        if word not in _TYPES:
            raise DetectorError(f"{self._source}: tensor {name} is {word}; build with float32 I/O")
        return _TYPES[word]


def _import(path: Path) -> Any:
    try:
        trt = importlib.import_module("tensorrt")
    except ImportError as error:
        raise DetectorError(
            f"{path}: an .engine needs the system's `tensorrt` package ({error}); on a Jetson make "
            "the virtual environment with --system-site-packages, elsewhere use an .onnx model"
        ) from error
    major = str(trt.__version__).split(".", 1)[0]
    if not major.isdigit() or int(major) < 10:
        raise DetectorError(
            f"{path}: TensorRT {trt.__version__} is too old; 10 or later is needed (JetPack 6)"
        )
    return trt
