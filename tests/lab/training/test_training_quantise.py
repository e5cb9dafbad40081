"""The network in eight bits: its answers stay near, and what is none of ours is refused."""

from __future__ import annotations

import numpy as np
import pytest
from coco_sets import annotation, write_set

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'bikeped[train]'")

from bikeped.config.schema import DetectionConfig  # noqa: E402
from bikeped.detection.detector import load_detector  # noqa: E402
from bikeped.errors import DetectorError  # noqa: E402
from bikeped.lab.training.coco import read_coco  # noqa: E402
from bikeped.lab.training.export import calibration_images, export_network, quantise  # noqa: E402
from bikeped.lab.training.network import SmallDetector, SmallNet  # noqa: E402

ort = pytest.importorskip("onnxruntime")
SIZE = (128, 96)


@pytest.fixture(scope="module")
def pictures():
    random = np.random.default_rng(3)
    return [random.random((1, 3, SIZE[1], SIZE[0]), np.float32) for _ in range(3)]


@pytest.fixture(scope="module")
def both(tmp_path_factory, pictures):
    folder = tmp_path_factory.mktemp("int8")
    torch.manual_seed(4)
    network = SmallNet(3).eval()
    detector = SmallDetector(network, ("pedestrian", "cyclist", "vehicle"), SIZE)
    export_network(detector, folder / "f.onnx")
    written = quantise(folder / "f.onnx", pictures, folder / "q.onnx")
    assert written == (folder / "q.onnx").stat().st_size
    return folder / "f.onnx", folder / "q.onnx"


def answer(model, picture):
    session = ort.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    return session.run(None, {"images": picture})[0]


def test_it_answers_nearly_the_same_in_a_third_of_the_bytes(both, pictures):
    whole, small = both
    assert small.stat().st_size < whole.stat().st_size / 2.5
    expected, found = answer(whole, pictures[0]), answer(small, pictures[0])
    assert not np.array_equal(found, expected)
    # Boxes of a network that has learnt nothing are about its cells' size: 16 to 64 pixels.
    assert np.abs(found[:, :4] - expected[:, :4]).max() < 2
    assert np.abs(found[:, 4:] - expected[:, 4:]).max() < 0.02


def test_it_keeps_its_facts_and_its_free_sides(both):
    detector = load_detector(DetectionConfig(model=str(both[1])), both[1].parent)
    assert detector.class_names == ("pedestrian", "cyclist", "vehicle")
    assert detector.input_size == SIZE
    wide = np.zeros((1, 3, 64, 160), np.float32)
    assert answer(both[1], wide).shape == answer(both[0], wide).shape


def test_the_same_pictures_give_the_same_file(both, pictures, tmp_path):
    quantise(both[0], pictures, tmp_path / "again.onnx")
    assert (tmp_path / "again.onnx").read_bytes() == both[1].read_bytes()


def test_without_pictures_nothing_is_written(both, tmp_path):
    with pytest.raises(DetectorError, match="no picture"):
        quantise(both[0], [], tmp_path / "none.onnx")
    assert list(tmp_path.iterdir()) == []


def test_another_model_is_refused(tmp_path, pictures):
    import onnx
    from onnx import TensorProto, helper

    value = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1]) for n in ("images", "out")]
    graph = helper.make_graph(
        [helper.make_node("Relu", ["images"], ["out"], "r")], "g", *([[v] for v in value])
    )
    onnx.save(helper.make_model(graph), str(tmp_path / "other.onnx"))
    with pytest.raises(DetectorError, match="not the small network"):
        quantise(tmp_path / "other.onnx", pictures, tmp_path / "out.onnx")


def test_pictures_are_shown_as_the_detector_shows_them(tmp_path):
    data = read_coco(write_set(tmp_path / "set", [annotation(1, 1, 1, [20, 30, 40, 50])], images=4))
    shown = list(calibration_images(data, SIZE, 2))
    assert 1 <= len(shown) <= 3
    assert all(p.shape == (1, 3, SIZE[1], SIZE[0]) and 0 <= p.min() <= p.max() <= 1 for p in shown)
