"""The native engine, against a stand-in for `tensorrt` and for libcudart.

The stand-ins keep "device" memory in a dictionary of host buffers, refuse addresses that were never
allocated, and run the network as a Python function when the stream is given work.
"""

from __future__ import annotations

import ctypes
import enum
import hashlib
import json
import sys
import types

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bikeped.config.schema import DetectionConfig
from bikeped.detection import trt_engine as engine_module
from bikeped.detection.detector import load_detector
from bikeped.detection.trt_engine import Cuda, split_header
from bikeped.errors import DetectorError
from bikeped.types import Kind

CELLS = 12 * 8 + 6 * 4 + 3 * 2
HEADER = {"task": "detect", "imgsz": [64, 96], "names": {"0": "person", "1": "bicycle"}}
PLAN = b"ftrt\x00\x00\x00\x00 a serialised engine"


class DataType(enum.Enum):
    FLOAT = 0
    HALF = 1
    UINT8 = 2
    BF16 = 3


class TensorIOMode(enum.Enum):
    INPUT = 0
    OUTPUT = 1


DTYPES = {DataType.FLOAT: np.float32, DataType.HALF: np.float16, DataType.UINT8: np.uint8}


class Library:
    """libcudart over host memory."""

    def __init__(self):
        self.memory = {}
        self.fail = {}

    def _allocate(self, out, size):
        block = (ctypes.c_ubyte * size.value)()
        address = ctypes.addressof(block)
        self.memory[address] = block
        out._obj.value = address
        return 0

    def cudaStreamCreate(self, out):  # noqa: N802 - CUDA's names
        out._obj.value = 77
        return self.fail.get("cudaStreamCreate", 0)

    def cudaMalloc(self, out, size):  # noqa: N802
        return self.fail.get("cudaMalloc") or self._allocate(out, size)

    def cudaHostAlloc(self, out, size, flags):  # noqa: N802
        return self._allocate(out, size)

    def cudaMemcpyAsync(self, to, origin, size, kind, stream):  # noqa: N802
        device = to.value if kind.value == 1 else origin.value
        assert device in self.memory
        assert size.value <= len(self.memory[device])
        assert stream.value == 77
        ctypes.memmove(to.value, origin.value, size.value)
        return 0

    def cudaStreamSynchronize(self, stream):  # noqa: N802
        return self.fail.get("cudaStreamSynchronize", 0)

    def cudaGetErrorString(self, status):  # noqa: N802
        return b"out of memory"


class Engine:
    def __init__(self, library, network, shape, out_shape, kind):
        self.library, self.network, self.kind = library, network, kind
        self.shapes = {"images": shape, "output0": out_shape}
        self.num_io_tensors = 2

    def get_tensor_name(self, i):
        return ("images", "output0")[i]

    def get_tensor_mode(self, name):
        return TensorIOMode.INPUT if name == "images" else TensorIOMode.OUTPUT

    def get_tensor_shape(self, name):
        return self.shapes[name]

    def get_tensor_dtype(self, name):
        return self.kind if name == "images" else DataType.FLOAT

    def get_tensor_profile_shape(self, name, profile):
        assert (name, profile) == ("images", 0)
        return [(1, 3, 32, 32), (1, 3, 64, 96), (1, 3, 640, 640)]

    def create_execution_context(self):
        return Context(self)


class Context:
    def __init__(self, engine):
        self.engine, self.addresses, self.input_shape = engine, {}, None

    def set_input_shape(self, name, shape):
        self.input_shape = shape
        return len(shape) == 4 and shape[2] <= 640

    def get_tensor_shape(self, name):
        return self.engine.shapes[name] if self.input_shape else (-1,)

    def set_tensor_address(self, name, address):
        self.addresses[name] = address
        return address in self.engine.library.memory

    def execute_async_v3(self, stream_handle):
        memory = self.engine.library.memory
        seen = np.frombuffer(memory[self.addresses["images"]], DTYPES[self.engine.kind])
        answer = self.engine.network(seen.reshape(self.input_shape))
        if answer is None or stream_handle != 77:
            return False
        target = np.frombuffer(memory[self.addresses["output0"]], np.float32)
        target[:] = answer.ravel()
        return True


def person_by_brightness(images):
    """A person whose confidence is the brightness of one pixel."""
    out = np.zeros((1, 6, CELLS), np.float32)
    out[0, :5, 3] = 40, 30, 20, 10, images[0, 0, 30, 50]
    return out


@pytest.fixture
def world(monkeypatch):
    """A stand-in `tensorrt` whose engine can be changed by the test."""
    library = Library()
    state = types.SimpleNamespace(
        library=library,
        network=person_by_brightness,
        shape=(1, 3, 64, 96),
        out_shape=(1, 6, CELLS),
        kind=DataType.FLOAT,
        version="10.3.0",
        plans=[],
        loads=True,
    )

    class Runtime:
        def __init__(self, logger):
            assert logger == "logger"

        def deserialize_cuda_engine(self, plan):
            state.plans.append(plan)
            if not state.loads:
                return None
            return Engine(library, state.network, state.shape, state.out_shape, state.kind)

    def logger(level):
        return "logger"

    logger.WARNING = 1
    module = types.ModuleType("tensorrt")
    module.Logger, module.Runtime = logger, Runtime
    module.TensorIOMode, module.DataType = TensorIOMode, DataType
    monkeypatch.setitem(sys.modules, "tensorrt", module)
    monkeypatch.setattr(engine_module, "Cuda", lambda: Cuda(library))
    state.module = module
    module.__version__ = state.version
    return state


def save(path, header=HEADER):
    text = b"" if header is None else json.dumps(header).encode()
    start = b"" if header is None else len(text).to_bytes(4, "little") + text
    path.write_bytes(start + PLAN)
    return path


def load(path, **settings):
    return load_detector(DetectionConfig(model=path.name, **settings), path.parent)


def bright(value):
    return np.full((64, 96, 3), value, np.uint8)


@pytest.mark.parametrize("kind", [DataType.FLOAT, DataType.HALF])
def test_an_ultralytics_engine_from_file_to_frame_pixels(world, tmp_path, kind):
    world.kind = kind
    detector = load(save(tmp_path / "m.engine"))
    assert world.plans == [PLAN]  # the header is not TensorRT's
    assert (detector.input_size, detector.layout) == ((96, 64), "yolov8")
    assert detector.name == "m.engine (TensorRT 10.3.0)"
    found = detector.infer(bright(204), 960, 640).detections
    assert found.kind.tolist() == [Kind.PEDESTRIAN]
    assert found.confidence == pytest.approx([0.8], abs=1e-3)
    assert found.box_px.tolist() == [[300, 250, 500, 350]]
    # The next frame is a new answer, not the one before.
    assert len(detector.infer(bright(0), 960, 640).detections) == 0


def test_an_engine_is_known_by_the_sha256_of_its_whole_file(world, tmp_path):
    path = save(tmp_path / "m.engine")
    expected = hashlib.sha256(path.read_bytes()).hexdigest()
    assert load(path).model_hash == expected
    assert load(path, sha256=expected.upper()).model_hash == expected
    world.plans.clear()
    path.write_bytes(path.read_bytes() + b"!")
    with pytest.raises(DetectorError, match=rf"SHA-256 is (?!{expected}).* expects {expected}"):
        load(path, sha256=expected)
    assert world.plans == []  # refused before TensorRT reads it


def test_a_bare_engine_with_a_dynamic_shape_is_tuned_for_its_optimum(world, tmp_path):
    world.shape = (-1, 3, -1, -1)
    world.out_shape = (1, 84, CELLS)
    world.network = lambda images: np.zeros((1, 84, CELLS), np.float32)
    detector = load(save(tmp_path / "m.engine", header=None))
    assert world.plans == [PLAN]
    assert detector.input_size == (96, 64)


def test_what_goes_wrong_is_said(world, tmp_path):
    path = save(tmp_path / "m.engine")

    def fails(text, **changes):
        kept = {key: getattr(world, key) for key in changes}
        for key, value in changes.items():
            setattr(world, key, value)
        with pytest.raises(DetectorError) as caught:
            load(path)
        assert text in str(caught.value)
        assert "\n" not in str(caught.value)
        for key, value in kept.items():
            setattr(world, key, value)

    fails("build it again on this machine", loads=False)
    fails("failed to run the engine", network=lambda images: None)
    fails("refuses input", shape=(1, 3, 1280, 1280))
    fails("no fixed shape", out_shape=(1, -1, 6))
    fails("build with float32", kind=DataType.BF16)
    world.library.fail["cudaMalloc"] = 2
    fails("cudaMalloc failed with 2 (out of memory)")
    world.library.fail.clear()
    world.module.__version__ = "8.6.1"
    fails("too old")


def test_a_gpu_that_fails_later_is_a_detector_error(world, tmp_path):
    detector = load(save(tmp_path / "m.engine"))
    world.library.fail["cudaStreamSynchronize"] = 700
    with pytest.raises(DetectorError, match="cudaStreamSynchronize failed with 700"):
        detector.infer(bright(0), 96, 64)


def test_without_the_package_the_mend_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorrt", None)
    with pytest.raises(DetectorError, match="--system-site-packages"):
        load(save(tmp_path / "m.engine"))


def test_an_engine_of_yolox_asks_for_its_preprocessing(world, tmp_path):
    world.out_shape = (1, CELLS, 85)
    world.network = lambda images: np.zeros((1, CELLS, 85), np.float32)
    path = save(tmp_path / "m.engine", header=None)
    with pytest.raises(DetectorError, match=r"set detection\.preprocess"):
        load(path)
    assert load(path, preprocess="yolox").layout == "yolox"


@given(st.binary(max_size=64))
def test_any_bytes_have_a_header_or_none(data):
    header, plan = split_header(data)
    assert bytes(plan) == data[len(data) - len(plan) :]
    assert header == {} or len(plan) < len(data)


def test_a_header_is_split_from_the_engine():
    text = json.dumps(HEADER).encode()
    data = len(text).to_bytes(4, "little") + text + PLAN
    header, plan = split_header(data)
    assert header == HEADER
    assert bytes(plan) == PLAN
    # A length that points beyond the file, or at something else than JSON, is no header.
    assert split_header(data[:20])[0] == {}
    assert split_header(b"\x04\x00\x00\x00{no}rest")[0] == {}
