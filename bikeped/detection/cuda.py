"""The CUDA runtime calls that the native TensorRT engine needs, through ctypes.

The library comes with JetPack; no Python package is needed. Names and signatures are those of
docs.nvidia.com/cuda/cuda-runtime-api. Not run on hardware here: tested against a stand-in library.
"""

from __future__ import annotations

import ctypes
import ctypes.util
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.errors import DetectorError

_CANDIDATES = (
    "libcudart.so",
    "libcudart.so.12",
    "libcudart.so.13",
    "libcudart.so.11.0",
    "/usr/local/cuda/lib64/libcudart.so",
)
_HOST_TO_DEVICE, _DEVICE_TO_HOST = 1, 2  #: cudaMemcpyKind


class Cuda:
    """A stream and its buffers."""

    def __init__(self, library: Any = None) -> None:
        """`library` stands in for libcudart in tests. Raises `DetectorError` without CUDA."""
        self._library = library if library is not None else _load()
        self._host: list[ctypes.c_void_p] = []
        self._device: list[ctypes.c_void_p] = []
        stream = ctypes.c_void_p()
        self._call("cudaStreamCreate", ctypes.byref(stream))
        self._stream: ctypes.c_void_p | None = stream

    @property
    def stream(self) -> int:
        """The stream's handle as TensorRT takes it."""
        return (self._stream.value if self._stream else 0) or 0

    def device(self, size: int) -> int:
        """Address of `size` bytes on the GPU."""
        address = ctypes.c_void_p()
        self._call("cudaMalloc", ctypes.byref(address), ctypes.c_size_t(max(size, 1)))
        self._device.append(address)
        return address.value or 0

    def host(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
        """A zeroed array in page-locked memory: copies from it need no staging.

        It must not be used after `close`.
        """
        size = max(int(np.prod(shape)) * dtype.itemsize, 1)
        address = ctypes.c_void_p()
        self._call("cudaHostAlloc", ctypes.byref(address), ctypes.c_size_t(size), ctypes.c_uint(0))
        self._host.append(address)
        memory = (ctypes.c_ubyte * size).from_address(address.value or 0)
        array: npt.NDArray[Any] = np.ndarray(shape, dtype, buffer=memoryview(memory))
        array[...] = 0
        return array

    def upload(self, device: int, array: npt.NDArray[Any]) -> None:
        """Queues a copy of a contiguous `array` to the GPU."""
        self._copy(device, array.ctypes.data, array.nbytes, _HOST_TO_DEVICE)

    def download(self, array: npt.NDArray[Any], device: int) -> None:
        """Queues a copy from the GPU into a contiguous `array`."""
        self._copy(array.ctypes.data, device, array.nbytes, _DEVICE_TO_HOST)

    def synchronize(self) -> None:
        """Waits until all queued work is done."""
        self._call("cudaStreamSynchronize", self._stream)

    def close(self) -> None:
        """Frees stream and buffers; a second call does nothing."""
        for address in self._device:
            self._library.cudaFree(address)
        for address in self._host:
            self._library.cudaFreeHost(address)
        if self._stream is not None:
            self._library.cudaStreamDestroy(self._stream)
        self._device, self._host, self._stream = [], [], None

    def _copy(self, to: int, origin: int, size: int, kind: int) -> None:
        self._call(
            "cudaMemcpyAsync",
            ctypes.c_void_p(to),
            ctypes.c_void_p(origin),
            ctypes.c_size_t(size),
            ctypes.c_int(kind),
            self._stream,
        )

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
