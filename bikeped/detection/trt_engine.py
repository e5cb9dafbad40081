"""The detector on a native TensorRT 10 engine, through JetPack's `tensorrt` package.

An engine fits the GPU and the TensorRT version that built it. The package is imported only when an
`.engine` is loaded; it comes with JetPack, not from PyPI. A file written by Ultralytics starts with
a 4-byte little-endian length and that many bytes of JSON; a bare engine (trtexec) works, too.

The CUDA runtime's library, also JetPack's, is called through ctypes (names and signatures:
docs.nvidia.com/cuda/cuda-runtime-api). Not run on hardware here: written against the documented API
(docs.nvidia.com/deeplearning/tensorrt, Python API: ICudaEngine, IExecutionContext) and tested with
stand-ins for package and library.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.config.schema import DetectionConfig
from bikeped.detection.model_metadata import (
    ModelMetadata,
    choose_region,
    parse_metadata,
    resolve_input,
)
from bikeped.errors import DetectorError
from bikeped.types import Region

_CANDIDATES = (
    "libcudart.so",
    "libcudart.so.12",
    "libcudart.so.13",
    "libcudart.so.11.0",
    "/usr/local/cuda/lib64/libcudart.so",
)
_HOST_TO_DEVICE, _DEVICE_TO_HOST = 1, 2  #: cudaMemcpyKind
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


class Cuda:
    """A stream and its buffers, which live as long as the process."""

    def __init__(self, library: Any = None) -> None:
        """`library` stands in for libcudart in tests. Raises `DetectorError` without CUDA."""
        self._library = library if library is not None else _load()
        self._stream = ctypes.c_void_p()
        self._call("cudaStreamCreate", ctypes.byref(self._stream))

    @property
    def stream(self) -> int:
        """The stream's handle as TensorRT takes it."""
        return self._stream.value or 0

    def tensor(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> tuple[npt.NDArray[Any], int]:
        """A zeroed array in page-locked memory (copies need no staging); its address on the GPU."""
        size = max(int(np.prod(shape)) * dtype.itemsize, 1)
        host, device = ctypes.c_void_p(), ctypes.c_void_p()
        self._call("cudaHostAlloc", ctypes.byref(host), ctypes.c_size_t(size), ctypes.c_uint(0))
        self._call("cudaMalloc", ctypes.byref(device), ctypes.c_size_t(size))
        memory = (ctypes.c_ubyte * size).from_address(host.value or 0)
        array: npt.NDArray[Any] = np.ndarray(shape, dtype, buffer=memoryview(memory))
        array[...] = 0
        return array, device.value or 0

    def upload(self, device: int, array: npt.NDArray[Any]) -> None:
        """Queues a copy of a contiguous `array` to the GPU."""
        self._copy(device, array.ctypes.data, array.nbytes, _HOST_TO_DEVICE)

    def download(self, array: npt.NDArray[Any], device: int) -> None:
        """Queues a copy from the GPU into a contiguous `array`."""
        self._copy(array.ctypes.data, device, array.nbytes, _DEVICE_TO_HOST)

    def synchronize(self) -> None:
        """Waits until all queued work is done."""
        self._call("cudaStreamSynchronize", self._stream)

    def _copy(self, to: int, origin: int, size: int, kind: int) -> None:
        addresses = ctypes.c_void_p(to), ctypes.c_void_p(origin)
        how = ctypes.c_size_t(size), ctypes.c_int(kind), self._stream
        self._call("cudaMemcpyAsync", *addresses, *how)

    def _call(self, function: str, *arguments: Any) -> None:
        status = int(getattr(self._library, function)(*arguments))
        if status:
            text = self._library.cudaGetErrorString(ctypes.c_int(status))
            reason = text.decode(errors="replace") if isinstance(text, bytes) else "unknown"
            raise DetectorError(f"CUDA: {function} failed with {status} ({reason})")


def _load() -> Any:
    found = ctypes.util.find_library("cudart")
    for name in (found, *_CANDIDATES) if found else _CANDIDATES:
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        library.cudaGetErrorString.restype = ctypes.c_char_p
        return library
    raise DetectorError(
        "CUDA's runtime library libcudart is not on this machine; an .engine needs it: use "
        "an .onnx model here, or add CUDA's lib64 to LD_LIBRARY_PATH"
    )


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

    def __init__(self, path: Path, config: DetectionConfig, road: Region | None = None) -> None:
        """Loads the engine; `road` as for `load_detector`. Raises `DetectorError`."""
        self._source = str(path)
        self.region = choose_region(config, road, False)  # an engine's input is of one size
        trt = _import(path)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise DetectorError(f"{path}: cannot read the engine: {error.strerror}") from error
        header, plan = split_header(data)
        self.metadata: ModelMetadata = parse_metadata(header, self._source)
        self._version = str(trt.__version__)
        self._cuda = Cuda()
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
        dtype = self._dtype(name)
        size = resolve_input(name, shape, dtype, self.metadata, self._source)
        if not self._context.set_input_shape(name, size):
            raise DetectorError(
                f"{self._source}: the engine refuses input {list(size)}; build it for this shape"
            )
        array, self._input_address = self._bind(name, size, dtype)
        return array

    def _bind_output(self, name: str) -> tuple[str, npt.NDArray[Any], int]:
        shape = tuple(int(d) for d in self._context.get_tensor_shape(name))
        if min(shape, default=0) < 0:
            raise DetectorError(
                f"{self._source}: output {name} has no fixed shape {list(shape)}; export without "
                "data-dependent outputs"
            )
        return name, *self._bind(name, shape, self._dtype(name))

    def _bind(
        self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]
    ) -> tuple[npt.NDArray[Any], int]:
        array, address = self._cuda.tensor(shape, dtype)
        if not self._context.set_tensor_address(name, address):
            raise DetectorError(f"{self._source}: TensorRT refuses the buffer of {name}")
        return array, address

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
