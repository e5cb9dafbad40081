"""What a model says about itself: metadata, input, class names; and the file's hash."""

from __future__ import annotations

import hashlib
import logging

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import sha256_of
from bikeped.detection.model_metadata import (
    COCO_NAMES,
    ModelMetadata,
    class_names,
    kind_table,
    parse_metadata,
    resolve_input,
)
from bikeped.errors import DetectorError
from bikeped.types import Kind

ULTRALYTICS = {
    "description": "Ultralytics YOLO11n model",
    "author": "Ultralytics",
    "task": "detect",
    "imgsz": "[384, 640]",
    "names": "{0: 'person', 1: 'bicycle'}",
    "end2end": "False",
    "args": "{'batch': 1, 'nms': False}",
    "stride": "32",
}


def test_ultralytics_text_and_values_say_the_same():
    expected = ModelMetadata(("person", "bicycle"), (640, 384), "detect", False, True)
    assert parse_metadata(ULTRALYTICS, "m") == expected
    values = {"task": "detect", "imgsz": [384, 640], "names": {"0": "person", "1": "bicycle"}}
    assert parse_metadata(values, "m") == expected


def test_end_to_end_is_said_in_two_ways():
    assert parse_metadata({"end2end": "True"}, "m").end_to_end
    assert parse_metadata({"args": "{'nms': True}"}, "m").end_to_end
    assert not parse_metadata({"args": "{'nms': False}"}, "m").end_to_end


def test_one_side_is_a_square():
    assert parse_metadata({"imgsz": "320"}, "m").image_size == (320, 320)


@pytest.mark.parametrize("names", ["{1: 'a', 2: 'b'}", "[]", "__import__('os')", "{0: 1}", 7, "("])
def test_bad_names_are_refused(names):
    with pytest.raises(DetectorError, match="names"):
        parse_metadata({"names": names}, "m")


texts = st.text("{}[]()'\\:, 01aé", max_size=20)  # the alphabet of literals, good and bad


@given(st.dictionaries(st.sampled_from([*ULTRALYTICS]), texts | st.integers() | st.none()))
def test_any_metadata_is_read_or_refused(entries):
    try:
        text = repr(parse_metadata(entries, "m"))
    except DetectorError as error:
        text = str(error)
    assert "\n" not in text


@pytest.mark.parametrize(
    ("shape", "metadata", "size"),
    [
        ([1, 3, 384, 640], ModelMetadata(), (640, 384)),
        (["batch", 3, "height", "width"], ModelMetadata(image_size=(320, 256)), (320, 256)),
        ([None, 3, -1, -1], ModelMetadata(), (640, 640)),
        ([1, 3, 416, 416], ModelMetadata(image_size=(640, 640)), (416, 416)),
    ],
)
def test_the_input_size(shape, metadata, size):
    resolved = resolve_input("images", shape, np.float16, metadata, "m")
    assert resolved == (1, 3, size[1], size[0])


@pytest.mark.parametrize(
    ("shape", "dtype", "text"),
    [
        ([8, 3, 64, 64], np.float32, "batch"),
        ([1, 64, 64, 3], np.float32, "channels first"),
        ([1, 3, 64], np.float32, "height, width"),
        ([1, 3, 8, 64], np.float32, "sides"),
        ([1, 3, 64, 64], np.int64, "float32, float16 or uint8"),
    ],
)
def test_other_inputs_are_refused(shape, dtype, text):
    with pytest.raises(DetectorError, match=text):
        resolve_input("images", shape, dtype, ModelMetadata(), "m")


def test_coco_has_its_80_classes_in_order():
    assert len(COCO_NAMES) == len(set(COCO_NAMES)) == 80
    chosen = {i: COCO_NAMES[i] for i in (0, 1, 2, 3, 5, 7, 79)}
    assert chosen == {
        0: "person",
        1: "bicycle",
        2: "car",
        3: "motorcycle",
        5: "bus",
        7: "truck",
        79: "toothbrush",
    }


def test_names_come_from_the_model_else_from_coco_else_are_asked_for():
    assert class_names(("a", "b"), 2, "m") == ("a", "b")
    assert class_names(None, 80, "m") == COCO_NAMES
    for names, classes in ((None, 3), (None, None), (("a",), 2)):
        with pytest.raises(DetectorError, match="names"):
            class_names(names, classes, "m")


def test_kinds_of_coco():
    table = kind_table(COCO_NAMES, DetectionConfig(), "m")
    kinds = {COCO_NAMES[i]: Kind(k) for i, k in enumerate(table) if k >= 0}
    assert kinds == {
        "person": Kind.PEDESTRIAN,
        "bicycle": Kind.CYCLIST,
        "motorcycle": Kind.CYCLIST,
        "car": Kind.VEHICLE,
        "bus": Kind.VEHICLE,
        "truck": Kind.VEHICLE,
    }


def test_names_are_compared_without_case_and_a_missing_kind_is_said(caplog):
    with caplog.at_level(logging.WARNING):
        table = kind_table((" Person", "TRUCK", "tree"), DetectionConfig(), "m")
    assert table.tolist() == [Kind.PEDESTRIAN, Kind.VEHICLE, -1]
    assert "is a cyclist" in caplog.text


def test_a_name_of_two_kinds_and_a_model_without_kinds_are_refused():
    both = DetectionConfig(pedestrian=("person",), cyclist=("person",))
    with pytest.raises(DetectorError, match=r"detection\.cyclist and detection\.pedestrian"):
        kind_table(("person",), both, "m")
    with pytest.raises(DetectorError, match="name them there"):
        kind_table(("tree", "house"), DetectionConfig(), "m")


def test_the_hash_is_checked(tmp_path):
    path = tmp_path / "m.onnx"
    path.write_bytes(b"abc")
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"  # FIPS 180-2
    assert sha256_of(path) == known
    assert sha256_of(path, known.upper()) == known
    with pytest.raises(DetectorError) as caught:
        sha256_of(path, "0" * 64)
    for part in (str(path), known, "0" * 64, "detection.sha256"):
        assert part in str(caught.value)
    with pytest.raises(DetectorError, match="no such model file"):
        sha256_of(tmp_path / "none.onnx")
    (tmp_path / "empty.onnx").touch()
    with pytest.raises(DetectorError, match="is empty"):
        sha256_of(tmp_path / "empty.onnx")
    with pytest.raises(DetectorError, match="cannot read"):
        sha256_of(tmp_path)


@pytest.mark.parametrize("name", ["weights.bin", "w" * 200 + ".data"])
def test_the_hash_covers_weights_in_files_of_their_own(tmp_path, name):
    weights = np.arange(64, dtype=np.float32)
    tensor = onnx.numpy_helper.from_array(weights, "w")
    node = onnx.helper.make_node("Add", ["x", "w"], ["y"])
    ports = [
        onnx.helper.make_tensor_value_info(port, onnx.TensorProto.FLOAT, [64]) for port in "xy"
    ]
    graph = onnx.helper.make_graph([node], "g", ports[:1], ports[1:], [tensor])
    path = tmp_path / "m.onnx"
    onnx.save(
        onnx.helper.make_model(graph),
        path,
        save_as_external_data=True,
        location=name,
        size_threshold=0,
    )
    beside = tmp_path / name
    both = hashlib.sha256(path.read_bytes() + beside.read_bytes()).hexdigest()
    assert sha256_of(path) == both
    beside.write_bytes(beside.read_bytes()[:-1] + b"\1")
    assert sha256_of(path) != both
    beside.unlink()
    with pytest.raises(DetectorError, match="no such model file"):
        sha256_of(path)
