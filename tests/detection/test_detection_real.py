"""A real network on real pixels: YOLOX nano on the clip of a person, a cyclist and a car.

Model and clip lie outside the project, in `../shared`; without them these tests are skipped.
"""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper
from shared_inputs import CLIP, MODEL, missing

from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import load_detector
from bikeped.detection.weights import first_gain, trained_on_bytes
from bikeped.types import Kind

pytestmark = pytest.mark.skipif(bool(missing(MODEL)), reason=missing(MODEL))

# A square cut of the picture, as the camera's framing gives it, so that a small network sees the
# small cyclist nearly at full size.
RIGHT, LEFT = slice(336, 768), slice(0, 432)
#: Frames in which the whole cyclist is in the right half, in both passes.
CYCLIST_FRAMES = (*range(134, 158, 3), *range(378, 400, 3))
#: Frames in which only the person walks in the left half.
WALKER_FRAMES = range(301, 345, 6)


def detector(model=MODEL, **settings):
    defaults = {"providers": ("cpu",), "threads": 1, "confidence": 0.15}
    return load_detector(DetectionConfig(**{"model": str(model), **defaults, **settings}), Path())


@pytest.fixture(scope="module")
def frames():
    """The frames that the tests look at, RGB, by number."""
    if why := missing(CLIP):
        pytest.skip(why)
    wanted = {20, *CYCLIST_FRAMES, *WALKER_FRAMES}
    clip = cv2.VideoCapture(str(CLIP))
    found = {}
    for number in range(max(wanted) + 1):
        assert clip.grab()
        if number in wanted:
            found[number] = cv2.cvtColor(clip.retrieve()[1], cv2.COLOR_BGR2RGB)
    clip.release()
    return found


def kinds(answer):
    return [Kind(k) for k in answer.detections.kind]


def test_layout_and_preprocessing_are_found_and_said(caplog):
    with caplog.at_level(logging.INFO):
        nano = detector()
    assert (nano.layout, nano.family, nano.input_size) == ("yolox", "yolox-legacy", (416, 416))
    assert "layout yolox (" in caplog.text
    assert "preprocessing yolox-legacy (first convolution's gain 7.79" in caplog.text


def test_the_car_is_one_vehicle_where_it_stands(frames):
    answer = detector(confidence=0.3).infer(frames[20], 768, 432)
    assert kinds(answer) == [Kind.VEHICLE]
    left, top, right, bottom = answer.detections.box_px[0]
    assert left < 60 < 200 < right < 240
    assert 90 < top < 130 < 240 < bottom < 280


def test_a_rider_is_one_cyclist_and_no_pedestrian(frames):
    nano = detector()
    seen = {n: kinds(nano.infer(frames[n][:, RIGHT], 432, 432)) for n in CYCLIST_FRAMES}
    good = [n for n, found in seen.items() if found == [Kind.CYCLIST]]
    on_it = [n for n, found in seen.items() if Kind.CYCLIST in found and Kind.PEDESTRIAN in found]
    assert on_it == []
    assert len(good) >= len(CYCLIST_FRAMES) - 1, seen


def test_without_joining_the_same_rider_is_a_pedestrian_too(frames):
    nano = detector(rider_overlap=1.0)
    both = 0
    for number in CYCLIST_FRAMES:
        found = kinds(nano.infer(frames[number][:, RIGHT], 432, 432))
        both += Kind.CYCLIST in found and Kind.PEDESTRIAN in found
    assert both > len(CYCLIST_FRAMES) / 2


def test_the_cyclist_stands_on_its_wheels(frames):
    # Frame 396: the wheels touch the ground at v = 103, between u = 337 and 410 of the cut.
    found = detector().infer(frames[396][:, RIGHT], 432, 432).detections
    u, v = found.bottom_centre_px()[0]
    assert abs(u - 374) < 8
    assert abs(v - 103) < 5


def test_a_walker_stays_a_pedestrian(frames):
    nano = detector()
    for number in WALKER_FRAMES:
        found = kinds(nano.infer(frames[number][:, LEFT], 432, 432))
        assert Kind.PEDESTRIAN in found
        assert Kind.CYCLIST not in found


def test_a_frame_decoded_at_half_scale_gives_full_frame_boxes(frames):
    nano = detector(confidence=0.3)
    assert nano.decode_size(1536, 864) == (416, 234)
    small = nano.infer(frames[20], 1536, 864).detections.box_px
    full = nano.infer(frames[20], 768, 432).detections.box_px
    np.testing.assert_allclose(small, full * 2, atol=0.01)


def for_bytes(path):
    """The same network, written for BGR 0..255: the normalisation moved into its first weights."""
    model = onnx.load(MODEL)
    arrays = {a.name: a for a in model.graph.initializer}
    first = next(n for n in model.graph.node if n.op_type == "Conv")
    weights = numpy_helper.to_array(arrays[first.input[1]]).astype(np.float64)
    bias = numpy_helper.to_array(arrays[first.input[2]]).astype(np.float64)
    mean = np.tile([0.485, 0.456, 0.406], 4)
    deviation = np.tile([0.229, 0.224, 0.225], 4)
    bias -= (weights * (mean / deviation)[None, :, None, None]).sum(axis=(1, 2, 3))
    weights /= (255 * deviation)[None, :, None, None]
    weights = weights.reshape(-1, 4, 3, 3, 3)[:, :, ::-1].reshape(weights.shape)  # RGB to BGR
    for name, value in ((first.input[1], weights), (first.input[2], bias)):
        arrays[name].CopyFrom(numpy_helper.from_array(value.astype(np.float32), name))
    onnx.save(model, path)
    return path


def test_the_same_network_written_for_bytes_is_told_and_answers_the_same(tmp_path, frames):
    path = for_bytes(tmp_path / "bytes.onnx")
    assert trained_on_bytes(first_gain(path)) is True
    assert trained_on_bytes(first_gain(MODEL)) is False
    ours, theirs = detector(path, confidence=0.3), detector(confidence=0.3)
    assert ours.family == "yolox"
    a, b = (d.infer(frames[20], 768, 432).detections for d in (ours, theirs))
    assert a.kind.tolist() == b.kind.tolist()
    # The edge differs: the convolution pads with zeros, which are other greys in the two scales.
    np.testing.assert_allclose(a.box_px, b.box_px, atol=8)
    np.testing.assert_allclose(a.confidence, b.confidence, atol=0.1)


def decoding(path):
    """The same network with YOLOX's decoding appended, as its exporter does on request."""
    model = onnx.load(MODEL)
    cells, strides = [], []
    for stride in (8, 16, 32):
        n = 416 // stride
        y, x = np.mgrid[:n, :n]
        cells.append(np.stack([x.ravel(), y.ravel()], axis=1))
        strides.append(np.full((n * n, 1), stride))
    constants = {
        "grid": np.concatenate(cells)[None].astype(np.float32),
        "step": np.concatenate(strides)[None].astype(np.float32),
    }
    model.graph.initializer.extend(numpy_helper.from_array(a, n) for n, a in constants.items())
    model.graph.node[-1].output[0] = "raw"
    model.graph.node.extend(
        [
            helper.make_node("Split", ["raw"], ["xy", "wh", "rest"], axis=2, split=[2, 2, 81]),
            helper.make_node("Add", ["xy", "grid"], ["moved"]),
            helper.make_node("Mul", ["moved", "step"], ["centre"]),
            helper.make_node("Exp", ["wh"], ["grown"]),
            helper.make_node("Mul", ["grown", "step"], ["size"]),
            helper.make_node("Concat", ["centre", "size", "rest"], ["output"], axis=2),
        ]
    )
    onnx.save(model, path)
    return path


def test_the_same_network_decoding_itself_is_told_and_answers_the_same(tmp_path, frames):
    decoded, raw = detector(decoding(tmp_path / "decoded.onnx")), detector()
    assert decoded.layout == "yolox-decoded"
    a, b = (d.infer(frames[396], 768, 432).detections for d in (decoded, raw))
    assert a.kind.tolist() == b.kind.tolist()
    np.testing.assert_allclose(a.box_px, b.box_px, atol=0.05)
