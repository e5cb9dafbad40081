"""Real ONNX models, small ones built here, run through ONNX Runtime: every layout end to end."""

from __future__ import annotations

import logging

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import load_detector
from bikeped.detection.onnx_runtime import _options, choose_providers, runs_on_cpu
from bikeped.errors import DetectorError
from bikeped.types import Kind, Region

SIZE = (96, 64)
CELLS = 12 * 8 + 6 * 4 + 3 * 2
PERSON = (40.0, 30.0, 20.0, 10.0)  # centre and size in input pixels
FRAME = (960, 640)  # ten times the input: no padding
PERSON_ON_FRAME = [300, 250, 500, 350]
NAMES = "{0: 'person', 1: 'bicycle', 2: 'tree'}"
ULTRALYTICS = {"names": NAMES, "task": "detect", "imgsz": "[64, 96]"}
TYPES = {
    np.float32: TensorProto.FLOAT,
    np.float16: TensorProto.FLOAT16,
    np.uint8: TensorProto.UINT8,
}


def save(path, output, metadata=None, shape=(1, 3, 64, 96), dtype=np.float32, extra=()):
    """A model that answers `output` whatever it sees."""
    constant = numpy_helper.from_array(output, "answer")
    graph = helper.make_graph(
        [helper.make_node("Identity", ["answer"], ["output0"]), *extra],
        "test",
        [helper.make_tensor_value_info("images", TYPES[dtype], shape)],
        [
            helper.make_tensor_value_info(
                "output0", helper.np_dtype_to_tensor_dtype(output.dtype), output.shape
            )
        ],
        [constant],
    )
    return write(path, graph, metadata)


def write(path, graph, metadata=None):
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    for key, value in (metadata or {}).items():
        model.metadata_props.add(key=key, value=value)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def load(path, road=None, **settings):
    defaults = {"model": path.name, "providers": ("cpu",), "threads": 1}
    return load_detector(DetectionConfig(**{**defaults, **settings}), path.parent, road)


def grey(frame=FRAME, scale=1):
    return np.full((frame[1] // scale, frame[0] // scale, 3), 114, np.uint8)


def answer_of(layout, classes=3, score=0.9):
    """An output of `layout` with one person."""
    cx, cy, w, h = PERSON
    if layout == "yolov8":
        out = np.zeros((1, 4 + classes, CELLS), np.float32)
        out[0, :5, 17] = cx, cy, w, h, score
    elif layout == "yolov5":
        out = np.zeros((1, 3 * CELLS, 5 + classes), np.float32)
        out[0, 17, :6] = cx, cy, w, h, 1, score
    elif layout == "end2end":
        out = np.zeros((1, 300, 6), np.float32)
        out[0, 0] = cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2, score, 0
    else:
        out = np.zeros((1, CELLS, 5 + classes), np.float32)
        i = 3 * 12 + 5  # cell (5, 3) of stride 8
        if layout == "yolox":
            out[0, i, :6] = cx / 8 - 5, cy / 8 - 3, np.log(w / 8), np.log(h / 8), 1, score
        else:
            for k in range(CELLS):
                across, s, first = (
                    (12, 8, 0) if k < 96 else (6, 16, 96) if k < 120 else (3, 32, 120)
                )
                out[0, k, :4] = (k - first) % across * s, (k - first) // across * s, s, s
            out[0, i, :6] = cx, cy, w, h, 1, score
    return out


@pytest.mark.parametrize("layout", ["yolov5", "yolov8", "end2end", "yolox", "yolox-decoded"])
@pytest.mark.parametrize("scale", [1, 2])
def test_every_layout_from_file_to_frame_pixels(tmp_path, layout, scale):
    metadata = {"names": NAMES} if layout.startswith("yolox") else ULTRALYTICS
    path = save(tmp_path / "m.onnx", answer_of(layout), metadata)
    preprocess = "yolox" if layout.startswith("yolox") else "auto"
    detector = load(path, preprocess=preprocess)
    assert detector.layout == layout
    assert detector.input_size == SIZE
    answer = detector.infer(grey(scale=scale), *FRAME)
    assert answer.detections.kind.tolist() == [Kind.PEDESTRIAN]
    assert answer.detections.confidence == pytest.approx([0.9])
    np.testing.assert_allclose(answer.detections.box_px, [PERSON_ON_FRAME], atol=0.01)
    assert min(answer.pre_ms, answer.inference_ms, answer.post_ms) >= 0


@pytest.mark.parametrize("layout", ["yolov5", "yolov8", "end2end"])
def test_without_metadata_the_shape_tells_and_coco_names_serve(tmp_path, layout):
    detector = load(save(tmp_path / "m.onnx", answer_of(layout, classes=80)))
    assert (detector.layout, detector.family) == (layout, "ultralytics")
    assert len(detector.infer(grey(), *FRAME).detections) == 1


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint8])
def test_input_types_and_dynamic_shapes(tmp_path, dtype):
    dynamic = ("batch", 3, "height", "width")
    path = save(tmp_path / "m.onnx", answer_of("yolov8"), ULTRALYTICS, dynamic, dtype)
    detector = load(path)
    assert detector.input_size == SIZE
    assert len(detector.infer(grey(), *FRAME).detections) == 1


#: The lower half of FRAME, 320 of 640 rows, is 32 rows of an input 96 wide; grey beside it.
ROAD = Region(0.0, 0.5, 1.0, 1.0, 960 / 640)


def test_of_an_input_of_any_height_only_the_road_is_asked_for(tmp_path):
    free = (1, 3, "height", "width")
    full = save(tmp_path / "full.onnx", answer_of("yolov8"), ULTRALYTICS, free)
    # 32 rows of road and 12 of grey, rounded up to 64: as high as the whole frame.
    found = load(full, ROAD).infer(grey(), *FRAME).detections
    # The person's middle, row 30 of the input: 14 rows below the road's first, ten times that.
    np.testing.assert_allclose(found.box_px, [[300, 410, 500, 510]], atol=0.01)
    short = np.zeros((1, 7, 96), np.float32)
    narrow = Region(0.0, 0.75, 1.0, 1.0, 960 / 640)
    short[0, :5, 17] = 40.0, 16.0, 20.0, 10.0, 0.9
    answer = np.ascontiguousarray(short[:, :, : 12 * 4 + 6 * 2 + 3])
    path = save(tmp_path / "short.onnx", answer, ULTRALYTICS, free)
    detector = load(path, narrow)
    assert detector.input_size == (96, 32)
    assert detector.decode_size(*FRAME) == (96, 64)
    # 16 of the 32 rows show the road's 160, centred: row 16 is its middle.
    for scale in (1, 2, 10):
        found = detector.infer(grey(scale=scale), *FRAME).detections
        np.testing.assert_allclose(found.box_px, [[300, 510, 500, 610]], atol=0.01)


def test_what_lies_beside_the_strip_is_nothing(tmp_path):
    answer = answer_of("yolov8")
    answer[0, 1, 17] = 5.0  # in the grey above the region
    path = save(tmp_path / "m.onnx", answer, ULTRALYTICS, (1, 3, "height", "width"))
    assert len(load(path, ROAD).infer(grey(), *FRAME).detections) == 0
    assert len(load(path, ROAD, region="frame").infer(grey(), *FRAME).detections) == 1


@pytest.mark.parametrize(("region", "rows"), [("auto", 0), ("frame", 0), ("road", 320)])
def test_a_model_of_one_size_is_shown_the_road_only_where_asked(tmp_path, region, rows, caplog):
    path = save(tmp_path / "m.onnx", answer_of("yolov8"), ULTRALYTICS)
    with caplog.at_level(logging.INFO):
        detector = load(path, ROAD, region=region)
    assert detector.input_size == SIZE
    assert ("from 50.0% to 100.0% down" in caplog.text) == (rows > 0)
    y = detector.infer(grey(), *FRAME).detections.box_px[0, 1]
    assert y == pytest.approx(410 if rows else 250, abs=0.01)


def test_a_height_that_must_be_the_width_is_not_chosen(tmp_path):
    answer = np.zeros((1, 7, 12 * 12 + 6 * 6 + 3 * 3), np.float32)
    facts = {**ULTRALYTICS, "imgsz": "[96, 96]"}
    square = save(tmp_path / "m.onnx", answer, facts, (1, 3, "side", "side"))
    assert load(square, ROAD).input_size == (96, 96)
    free = save(tmp_path / "free.onnx", answer[:, :, :126], facts, (1, 3, "height", "width"))
    assert load(free, ROAD).input_size == (96, 64)


def test_half_precision_answers(tmp_path):
    path = save(tmp_path / "m.onnx", answer_of("yolov8").astype(np.float16), ULTRALYTICS)
    found = load(path).infer(grey(), *FRAME).detections
    np.testing.assert_allclose(found.box_px, [PERSON_ON_FRAME], atol=0.01)


def test_what_the_network_sees_is_the_picture(tmp_path):
    # A network that answers with one pixel of its input: its red, green and blue become scores.
    picks = [
        helper.make_node("Slice", ["images", "from", "to", "axes"], ["pixel"]),
        helper.make_node("Reshape", ["pixel", "three"], ["scores"]),
        helper.make_node("Concat", ["boxes", "scores"], ["short"], axis=1),
        helper.make_node("Concat", ["short", "rest"], ["output0"], axis=2),
    ]
    arrays = {
        "from": np.array([30, 50]),
        "to": np.array([31, 51]),
        "axes": np.array([2, 3]),
        "three": np.array([1, 3, 1]),
        "boxes": np.array(PERSON, np.float32).reshape(1, 4, 1),
        "rest": np.zeros((1, 7, CELLS - 1), np.float32),
    }
    graph = helper.make_graph(
        picks,
        "pixel",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 96))],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, (1, 7, CELLS))],
        [numpy_helper.from_array(a, n) for n, a in arrays.items()],
    )
    detector = load(write(tmp_path / "m.onnx", graph, ULTRALYTICS))
    rgb = np.zeros((64, 96, 3), np.uint8)
    for pixel, kind, score in (((204, 51, 0), 0, 0.8), ((0, 153, 51), 1, 0.6)):
        rgb[30, 50] = pixel
        found = detector.infer(rgb, 96, 64).detections
        assert found.kind.tolist() == [kind]
        assert found.confidence == pytest.approx([score])
    rgb[30, 50] = (0, 0, 255)  # a tree
    assert len(detector.infer(rgb, 96, 64).detections) == 0


def test_order_ties_limits_and_kinds(tmp_path):
    out = np.zeros((1, 300, 6), np.float32)
    for i, score in enumerate([0.5, 0.9, 0.5, 0.3]):
        out[0, i] = 20 * i, 10, 20 * i + 8, 30, score, 0
    path = save(tmp_path / "m.onnx", out, ULTRALYTICS)
    found = load(path).infer(grey(), *FRAME).detections
    assert found.box_px[:, 0].tolist() == [200, 0, 400, 600]
    again = load(path).infer(grey(), *FRAME).detections
    np.testing.assert_array_equal(found.box_px, again.box_px)
    assert len(load(path, max_detections=2).infer(grey(), *FRAME).detections) == 2
    assert len(load(path, confidence=0.4).infer(grey(), *FRAME).detections) == 3
    renamed = load(path, pedestrian=(), vehicle=("person",))
    assert renamed.infer(grey(), *FRAME).detections.kind.tolist() == [Kind.VEHICLE] * 4


def test_boxes_are_clipped_to_the_frame_and_padding_holds_nobody(tmp_path):
    out = np.zeros((1, 300, 6), np.float32)
    out[0, 0] = -10, 20, 30, 90, 0.9, 0  # over two edges
    out[0, 1] = 40, 2, 60, 14, 0.8, 0  # on the grey above the picture
    detector = load(save(tmp_path / "m.onnx", out, ULTRALYTICS))
    found = detector.infer(np.zeros((32, 96, 3), np.uint8), 960, 320).detections
    assert found.box_px.tolist() == [[0, 40, 300, 320]]


def test_a_car_that_is_also_a_truck_is_one_vehicle(tmp_path):
    out = np.zeros((1, 300, 6), np.float32)
    out[0, 0] = 10, 10, 50, 40, 0.6, 0
    out[0, 1] = 11, 10, 50, 41, 0.7, 1
    path = save(tmp_path / "m.onnx", out, {**ULTRALYTICS, "names": "['car', 'truck']"})
    found = load(path).infer(grey(), *FRAME).detections
    assert found.kind.tolist() == [Kind.VEHICLE]
    assert found.confidence == pytest.approx([0.7])


@pytest.mark.parametrize(
    ("names", "kind", "confidence"),
    [  # joined: a rider, as sure as the bicycle; one person, the likelier
        ("{0: 'person', 1: 'bicycle', 2: 'tree'}", Kind.CYCLIST, 0.5),
        ("{0: 'person', 1: 'cyclist', 2: 'tree'}", Kind.PEDESTRIAN, 0.9),
    ],
)
def test_a_person_boxed_as_walker_and_as_rider_is_one_of_them(tmp_path, names, kind, confidence):
    out = answer_of("yolov8")
    out[0, :4, 18] = PERSON
    out[0, 5, 18] = 0.5
    model = save(tmp_path / "model.onnx", out, {"names": names})
    found = load(model).infer(grey(), *FRAME).detections
    assert found.kind.tolist() == [kind]
    assert found.confidence.tolist() == [pytest.approx(confidence)]


def test_a_walker_in_front_of_a_boxed_rider_stays_a_walker(tmp_path):
    out = answer_of("yolov8")
    cx, cy, w, h = PERSON
    out[0, :4, 18] = cx, cy - h / 4, 2.4 * w, h  # would be a cycle under the person
    out[0, 5, 18] = 0.5
    meta = {"names": "{0: 'pedestrian', 1: 'cyclist', 2: 'tree'}"}
    found = load(save(tmp_path / "model.onnx", out, meta)).infer(grey(), *FRAME).detections
    assert found.kind.tolist() == [Kind.PEDESTRIAN, Kind.CYCLIST]
    meta = {"names": "{0: 'pedestrian', 1: 'bicycle', 2: 'tree'}"}
    found = load(save(tmp_path / "other.onnx", out, meta)).infer(grey(), *FRAME).detections
    assert found.kind.tolist() == [Kind.CYCLIST]


def test_a_flood_of_boxes_is_bounded_and_answers_the_strongest(tmp_path):
    rng = np.random.default_rng(0)
    out = np.zeros((1, 7, CELLS), np.float32)
    out[0, :4] = rng.uniform(5, 60, (4, CELLS))
    out[0, 4] = rng.uniform(0.2, 0.9, CELLS)
    detector = load(save(tmp_path / "m.onnx", out, ULTRALYTICS), max_detections=10, iou=1.0)
    found = detector.infer(grey(), *FRAME).detections
    expected = np.sort(out[0, 4])[::-1][:10]
    np.testing.assert_allclose(found.confidence, expected)


def test_decode_size_is_the_picture_on_the_input_and_never_more_than_the_frame(tmp_path):
    detector = load(save(tmp_path / "m.onnx", answer_of("yolov8"), ULTRALYTICS))
    assert detector.decode_size(3840, 2160) == (96, 54)
    assert detector.decode_size(1000, 2000) == (32, 64)
    assert detector.decode_size(48, 32) == (48, 32)


def test_name_and_hash(tmp_path):
    path = save(tmp_path / "m.onnx", answer_of("yolov8"), ULTRALYTICS)
    detector = load(path)
    assert detector.name.startswith("m.onnx (ONNX Runtime")
    assert load(path, sha256=detector.model_hash).model_hash == detector.model_hash
    with pytest.raises(DetectorError, match="SHA-256"):
        load(path, sha256="0" * 64)


def test_what_was_chosen_and_why_is_logged(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        load(save(tmp_path / "m.onnx", answer_of("yolov8"), ULTRALYTICS))
    for part in ("layout yolov8", "preprocessing ultralytics", "3 classes", "CPU"):
        assert part in caplog.text


def test_models_that_cannot_serve_are_refused_in_one_line(tmp_path):
    cases = {
        "no model is configured": lambda: load_detector(DetectionConfig(), tmp_path),
        "no such model file": lambda: load(tmp_path / "none.onnx"),
        "neither .onnx nor .engine": lambda: load(tmp_path / "m.pt"),
        "no layout that bikeped can tell": lambda: load(
            save(tmp_path / "a.onnx", np.zeros((1, 84, 77), np.float32))
        ),
        "only COCO's 80 are known": lambda: load(
            save(tmp_path / "b.onnx", answer_of("yolov8", classes=5))
        ),
        "batch": lambda: load(
            save(tmp_path / "c.onnx", answer_of("yolov8"), ULTRALYTICS, (4, 3, 64, 96))
        ),
        "task is 'segment'": lambda: load(
            save(tmp_path / "d.onnx", answer_of("yolov8"), {**ULTRALYTICS, "task": "segment"})
        ),
        "preprocessing stays unknown": lambda: load(
            save(tmp_path / "e.onnx", answer_of("yolox"), {"names": NAMES})
        ),
        "not probabilities": lambda: load(
            save(tmp_path / "f.onnx", np.full((1, 7, CELLS), np.nan, np.float32), ULTRALYTICS)
        ),
    }
    for text, action in cases.items():
        with pytest.raises(DetectorError) as caught:
            action()
        assert text in str(caught.value)
        assert "\n" not in str(caught.value)


@settings(
    deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_a_damaged_file_is_a_clear_error(tmp_path, data):
    whole = save(tmp_path / "m.onnx", answer_of("yolov8"), ULTRALYTICS).read_bytes()
    cut = data.draw(st.integers(0, min(len(whole) - 1, 400)))
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(whole[:cut] + data.draw(st.binary(max_size=20)))
    with pytest.raises(DetectorError) as caught:
        load(broken)
    assert "broken.onnx" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_network_that_fails_while_running_is_a_detector_error(tmp_path):
    # The answer is looked up by what is seen: grey is entry 0, 3.5 is none.
    nodes = [
        helper.make_node("ReduceMax", ["images"], ["brightest"], keepdims=1),
        helper.make_node("Reshape", ["brightest", "one"], ["value"]),
        helper.make_node("Floor", ["value"], ["whole"]),
        helper.make_node("Cast", ["whole"], ["index"], to=TensorProto.INT64),
        helper.make_node("Gather", ["answer", "index"], ["output0"], axis=0),
    ]
    arrays = {"answer": answer_of("yolov8"), "one": np.array([1])}
    graph = helper.make_graph(
        nodes,
        "fails",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 96))],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, (None, 7, CELLS))],
        [numpy_helper.from_array(a, n) for n, a in arrays.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 14)], ir_version=8)
    for key, value in ULTRALYTICS.items():
        model.metadata_props.add(key=key, value=value)
    path = tmp_path / "m.onnx"
    onnx.save(model, path)
    detector = load(path)
    detector._backend.buffer[...] = 3.5
    with pytest.raises(DetectorError, match="inference failed"):
        detector._backend.run()


def test_providers_keep_the_configured_order_and_skip_the_absent():
    here = ["TensorrtExecutionProvider", "CUDAExecutionProvider", "CPUExecutionProvider"]
    assert choose_providers(("cpu", "cuda"), here) == [
        "CPUExecutionProvider",
        "CUDAExecutionProvider",
    ]
    assert choose_providers(("tensorrt", "cuda", "cpu"), here[2:]) == ["CPUExecutionProvider"]
    with pytest.raises(DetectorError, match=r"detection\.providers"):
        choose_providers(("cuda",), here[2:])


def test_whether_it_runs_on_the_processor(monkeypatch):
    gpu, cpu = "CUDAExecutionProvider", "CPUExecutionProvider"
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: [gpu, cpu])
    assert not runs_on_cpu(("tensorrt", "cuda", "cpu"))
    assert runs_on_cpu(("cpu", "cuda"))
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: [cpu])
    assert runs_on_cpu(("tensorrt", "cuda", "cpu"))


def test_tensorrt_keeps_its_engines_in_a_folder_of_the_model(tmp_path):
    options = _options("TensorrtExecutionProvider", tmp_path / "cache" / "ab", "m.onnx")
    assert options["trt_engine_cache_path"] == str(tmp_path / "cache" / "ab")
    assert (tmp_path / "cache" / "ab").is_dir()
    assert options["trt_fp16_enable"] == options["trt_engine_cache_enable"] == "1"
    assert _options("CPUExecutionProvider", tmp_path / "other", "m.onnx") == {}
    assert not (tmp_path / "other").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(DetectorError, match=r"detection\.engine_cache"):
        _options("TensorrtExecutionProvider", tmp_path / "file" / "ab", "m.onnx")
