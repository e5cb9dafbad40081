"""Building an engine, against a stand-in for `tensorrt`; the result is what the loader reads."""

from __future__ import annotations

import enum
import sys
import types

import onnx
import pytest
from onnx import TensorProto, helper

from bikeped.detection.trt_engine import split_header
from bikeped.errors import DetectorError
from bikeped.lab.training.engine import build_engine, onnx_facts

PLAN = b"ftrt\x00\x00\x00\x00 a serialised engine"
FACTS = {"names": "{0: 'person'}", "imgsz": "[64, 96]", "task": "detect"}


class BuilderFlag(enum.Enum):
    FP16 = 0


class MemoryPoolType(enum.Enum):
    WORKSPACE = 0


class Profile:
    def set_shape(self, name, least, usual, most):
        self.shape = name, least, usual, most


class Network:
    """What was parsed, with its input's shape as TensorRT tells it: -1 where any will do."""

    content = b""
    num_inputs = 1

    def get_input(self, number):
        taken = onnx.load_model_from_string(self.content).graph.input[number]
        sides = taken.type.tensor_type.shape.dim
        return types.SimpleNamespace(
            name=taken.name, shape=tuple(-1 if d.dim_param else d.dim_value for d in sides)
        )


class Config:
    def __init__(self):
        self.flags, self.limits, self.profiles = set(), {}, []

    def add_optimization_profile(self, profile):
        self.profiles.append(profile.shape)

    def set_flag(self, flag):
        self.flags.add(flag)

    def set_memory_pool_limit(self, pool, size):
        self.limits[pool] = size


class Parser:
    errors: tuple[str, ...] = ()
    num_errors = 0

    def __init__(self, network, logger):
        self.network = network

    def parse(self, content):
        onnx.checker.check_model(onnx.load_model_from_string(content))
        self.network.content = content
        return not self.errors

    def get_error(self, number):
        return self.errors[number]


class Builder:
    plan: bytes | None = PLAN
    platform_has_fast_fp16 = True
    last: Config

    def __init__(self, logger):
        assert logger == "warnings only"

    def create_network(self, flags):
        assert flags == 0
        return Network()

    def create_optimization_profile(self):
        return Profile()

    def create_builder_config(self):
        Builder.last = Config()
        return Builder.last

    def build_serialized_network(self, network, config):
        assert network.content
        return self.plan


class Logger:
    WARNING = "warnings only"

    def __new__(cls, level):
        return level


@pytest.fixture
def trt(monkeypatch):
    module = types.ModuleType("tensorrt")
    module.__version__ = "10.3.0"
    parts = {"Builder": Builder, "OnnxParser": Parser, "Logger": Logger}
    for name, part in parts.items():
        setattr(module, name, type(name, (part,), {}) if name != "Logger" else part)
    module.BuilderFlag, module.MemoryPoolType = BuilderFlag, MemoryPoolType
    monkeypatch.setitem(sys.modules, "tensorrt", module)
    return module


@pytest.fixture
def model(tmp_path):
    """An ONNX file that does nothing, with metadata."""
    return nothing(tmp_path / "model.onnx", [1, 3, 64, 96])


def nothing(path, shape, facts=FACTS):
    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, shape) for n in ("images", "out")]
    graph = helper.make_graph(
        [helper.make_node("Identity", ["images"], ["out"])], "nothing", ends[:1], ends[1:]
    )
    proto = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(proto, facts)
    path.write_bytes(proto.SerializeToString())
    return path


def test_an_engine_carries_the_facts_in_front(trt, model, tmp_path):
    out = tmp_path / "model.engine"
    summary = build_engine(model, out, workspace_mb=64)
    header, plan = split_header(out.read_bytes())
    assert header == FACTS
    assert bytes(plan) == PLAN
    assert summary["engine_bytes"] == out.stat().st_size
    assert summary["half_precision"]
    assert Builder.last.flags == {BuilderFlag.FP16}
    assert Builder.last.limits == {MemoryPoolType.WORKSPACE: 64 << 20}


def test_an_input_of_any_size_gets_the_one_it_will_have(trt, model, tmp_path):
    free = nothing(tmp_path / "free.onnx", [1, 3, "height", "width"])
    build_engine(free, tmp_path / "a.engine")
    assert Builder.last.profiles == [("images", *[(1, 3, 64, 96)] * 3)]  # as its metadata say
    build_engine(free, tmp_path / "b.engine", size=(128, 32))
    assert Builder.last.profiles == [("images", *[(1, 3, 32, 128)] * 3)]
    build_engine(model, tmp_path / "c.engine", size=(96, 64))
    assert Builder.last.profiles == []
    with pytest.raises(DetectorError, match=r"its input is 96 x 64, not 128 x 32; leave out"):
        build_engine(model, tmp_path / "d.engine", size=(128, 32))
    silent = nothing(tmp_path / "silent.onnx", [1, 3, "height", "width"], {})
    with pytest.raises(DetectorError, match="name one with --input"):
        build_engine(silent, tmp_path / "d.engine")
    assert not (tmp_path / "d.engine").exists()


def test_half_precision_only_where_it_is_asked_for_and_there(trt, model, tmp_path):
    assert not build_engine(model, tmp_path / "a.engine", half=False)["half_precision"]
    assert Builder.last.flags == set()
    trt.Builder.platform_has_fast_fp16 = False
    assert not build_engine(model, tmp_path / "b.engine")["half_precision"]
    assert Builder.last.flags == set()


def test_what_tensorrt_does_not_understand_is_said_in_its_words(trt, model, tmp_path):
    trt.OnnxParser.errors, trt.OnnxParser.num_errors = ("node 7:\n no Einsum",), 1
    with pytest.raises(DetectorError, match=r"model\.onnx: TensorRT 10\.3\.0 .*node 7: no Einsum"):
        build_engine(model, tmp_path / "model.engine")
    assert not (tmp_path / "model.engine").exists()


def test_an_engine_that_is_not_built_leaves_nothing(trt, model, tmp_path):
    trt.Builder.plan = None
    with pytest.raises(DetectorError, match="--workspace-mb"):
        build_engine(model, tmp_path / "model.engine")
    assert [p.name for p in tmp_path.iterdir()] == ["model.onnx"]


def test_without_tensorrt_it_says_where_to_build(monkeypatch, model, tmp_path):
    monkeypatch.setitem(sys.modules, "tensorrt", None)
    with pytest.raises(DetectorError, match="on the Jetson"):
        build_engine(model, tmp_path / "model.engine")


def test_an_old_tensorrt_is_refused(trt, model, tmp_path):
    trt.__version__ = "8.6.1"
    with pytest.raises(DetectorError, match=r"8\.6\.1 is too old"):
        build_engine(model, tmp_path / "model.engine")


def test_files_that_are_no_models_are_named(trt, model, tmp_path):
    with pytest.raises(DetectorError, match=r"none\.onnx: cannot be read"):
        build_engine(tmp_path / "none.onnx", tmp_path / "model.engine")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"nothing")
    with pytest.raises(DetectorError, match=r"broken\.onnx: is no ONNX model"):
        build_engine(broken, tmp_path / "model.engine")
    proto = onnx.load(model)
    helper.set_model_props(proto, {"names": "nonsense"})
    onnx.save(proto, broken)
    with pytest.raises(DetectorError, match="names"):
        build_engine(broken, tmp_path / "model.engine")
    assert list(onnx_facts(model).items()) == sorted(FACTS.items())
