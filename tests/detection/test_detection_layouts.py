"""Output layouts: every family decoded from arrays built by hand, told apart, and never a crash."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bikeped.detection.model_metadata import ModelMetadata
from bikeped.detection.output_layouts import (
    LAYOUTS,
    anchor_count,
    choose_layout,
    decode,
    pick_output,
    strides_of,
    yolox_is_decoded,
)
from bikeped.errors import DetectorError

SIZE = (96, 64)  # width, height: rectangular on purpose
STRIDES = (8, 16, 32)
CELLS = 12 * 8 + 6 * 4 + 3 * 2
PLAIN = ModelMetadata()


def grid(size=SIZE, strides=STRIDES):
    """The anchors one after another, written as a plain loop."""
    return [(x, y, s) for s in strides for y in range(size[1] // s) for x in range(size[0] // s)]


def yolov8(nc, boxes):
    out = np.zeros((1, 4 + nc, CELLS), np.float32)
    for anchor, (cx, cy, w, h), cls, score in boxes:
        out[0, :4, anchor] = cx, cy, w, h
        out[0, 4 + cls, anchor] = score
    return out


def with_objectness(nc, rows, boxes):
    out = np.zeros((1, rows, 5 + nc), np.float32)
    for anchor, box, cls, objectness, probability in boxes:
        out[0, anchor, :4] = box
        out[0, anchor, 4] = objectness
        out[0, anchor, 5 + cls] = probability
    return out


def decoded_grid(nc):
    out = with_objectness(nc, CELLS, [])
    for i, (x, y, s) in enumerate(grid()):
        out[0, i, :4] = (x + 0.5) * s, (y + 0.5) * s, s, s
    return out


def all_wanted(nc):
    return np.ones(nc, bool)


def test_anchor_count_is_the_cells_of_every_stride():
    assert anchor_count(SIZE, STRIDES) == CELLS
    assert anchor_count((640, 640), STRIDES) == 8400
    assert anchor_count((416, 416), STRIDES) == 3549
    assert strides_of(3 * 8400, (640, 640), 3) == STRIDES
    assert strides_of(8500, (640, 640)) == (8, 16, 32, 64)
    assert strides_of(8401, (640, 640)) is None


def test_yolov8_centre_and_size_become_corners():
    out = yolov8(3, [(7, (40, 30, 20, 10), 2, 0.9), (9, (50, 30, 8, 8), 0, 0.05)])
    found = decode(out, "yolov8", SIZE, 0.1, all_wanted(3), "m")
    assert found.box.tolist() == [[30, 25, 50, 35]]
    assert found.class_id.tolist() == [2]
    assert found.score == pytest.approx([0.9])


def test_yolov5_score_is_objectness_times_class():
    out = with_objectness(2, 3 * CELLS, [(5, (40, 30, 20, 10), 1, 0.5, 0.8)])
    found = decode(out, "yolov5", SIZE, 0.1, all_wanted(2), "m")
    assert found.score == pytest.approx([0.4])
    assert found.box.tolist() == [[30, 25, 50, 35]]
    assert len(decode(out, "yolov5", SIZE, 0.41, all_wanted(2), "m")) == 0


def test_yolox_raw_equals_its_formula_at_every_anchor():
    rng = np.random.default_rng(1)
    out = with_objectness(1, CELLS, [])
    out[0, :, :2] = rng.normal(0, 1, (CELLS, 2))
    out[0, :, 2:4] = rng.normal(0, 0.5, (CELLS, 2))
    out[0, :, 4:] = 1
    found = decode(out, "yolox", SIZE, 0.1, all_wanted(1), "m")
    expected = []
    for (x, y, s), (dx, dy, lw, lh, *_) in zip(grid(), out[0].tolist(), strict=True):
        cx, cy, w, h = (x + dx) * s, (y + dy) * s, np.exp(lw) * s, np.exp(lh) * s
        expected.append([cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2])
    np.testing.assert_allclose(found.box, expected, rtol=1e-5, atol=1e-4)


def test_end_to_end_rows_are_corners_already():
    out = np.zeros((1, 300, 6), np.float32)
    out[0, 0] = 10, 20, 30, 40, 0.7, 1
    out[0, 1] = 10, 20, 30, 40, 0.7, 99  # no such class
    found = decode(out, "end2end", SIZE, 0.1, all_wanted(2), "m")
    assert found.box.tolist() == [[10, 20, 30, 40]]
    assert found.class_id.tolist() == [1]


@pytest.mark.parametrize("layout", ["yolov8", "yolov5", "end2end"])
def test_unwanted_classes_and_weak_rows_are_left_out(layout):
    wanted = np.array([True, False, True])
    boxes = [((40, 30, 20, 10), c, s) for c, s in ((0, 0.5), (1, 0.9), (2, 0.2), (2, 0.05))]
    if layout == "yolov8":
        out = yolov8(3, [(i, b, c, s) for i, (b, c, s) in enumerate(boxes)])
    elif layout == "yolov5":
        out = with_objectness(3, 3 * CELLS, [(i, b, c, 1, s) for i, (b, c, s) in enumerate(boxes)])
    else:
        out = np.zeros((1, 300, 6), np.float32)
        for i, (_, c, s) in enumerate(boxes):
            out[0, i] = 30, 25, 50, 35, s, c
    found = decode(out, layout, SIZE, 0.1, wanted, "m")
    assert found.class_id.tolist() == [0, 2]
    # One limit a class: the third class has a lower one.
    found = decode(out, layout, SIZE, [0.6, 0.6, 0.04], wanted, "m")
    assert found.class_id.tolist() == [2, 2]


def test_an_anchor_whose_best_class_is_unwanted_is_dropped_though_another_is_strong():
    out = yolov8(2, [(3, (40, 30, 20, 10), 0, 0.6), (3, (40, 30, 20, 10), 1, 0.7)])
    assert len(decode(out, "yolov8", SIZE, 0.1, np.array([True, False]), "m")) == 0
    assert len(decode(out, "yolov8", SIZE, 0.1, np.array([True, True]), "m")) == 1


def test_rows_that_cannot_be_are_dropped():
    good = (40, 30, 20, 10)
    out = yolov8(1, [(i, good, 0, 0.9) for i in range(6)])
    out[0, 0, 0] = np.nan
    out[0, 1, 1] = np.inf
    out[0, 2, 2] = 0  # no width
    out[0, 3, 3] = -5
    out[0, 4, 4] = np.nan
    found = decode(out, "yolov8", SIZE, 0.1, all_wanted(1), "m")
    assert found.box.tolist() == [[30, 25, 50, 35]]


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("value", [np.nan, np.inf, 40.0, -7.0])
def test_an_answer_of_no_probabilities_is_an_error_not_an_empty_street(layout, value):
    shape = {"yolov8": (1, 6, CELLS), "end2end": (1, 300, 6), "yolov5": (1, 3 * CELLS, 7)}
    out = np.full(shape.get(layout, (1, CELLS, 7)), value, np.float32)
    with pytest.raises(DetectorError, match="not probabilities"):
        decode(out, layout, SIZE, 0.1, all_wanted(2), "m")


def test_half_precision_a_hair_above_one_counts_as_one():
    out = yolov8(1, [(0, (40, 30, 20, 10), 0, 1.0005)]).astype(np.float16)
    assert decode(out, "yolov8", SIZE, 0.1, all_wanted(1), "m").score.tolist() == [1.0]


@pytest.mark.parametrize(
    ("output", "metadata", "layout", "classes"),
    [
        (np.zeros((1, 84, CELLS)), PLAIN, "yolov8", 80),
        (np.zeros((1, 3 * CELLS, 85)), PLAIN, "yolov5", 80),
        (np.zeros((1, 300, 6)), PLAIN, "end2end", None),
        (np.zeros((1, 300, 6)), ModelMetadata(names=("a",) * 80), "end2end", 80),
        (np.zeros((1, CELLS, 85)), PLAIN, "yolox", 80),
        (decoded_grid(80), PLAIN, "yolox-decoded", 80),
        # One class: six columns, and still a grid.
        (np.zeros((1, 3 * CELLS, 6)), PLAIN, "yolov5", 1),
        (np.zeros((1, CELLS, 6)), PLAIN, "yolox", 1),
        # ... unless the metadata says that it is a finished answer.
        (
            np.zeros((1, CELLS, 6)),
            ModelMetadata(end_to_end=True, ultralytics=True),
            "end2end",
            None,
        ),
        (np.zeros((1, 7, CELLS)), ModelMetadata(names=("a", "b", "c")), "yolov8", 3),
    ],
)
def test_layouts_are_told_apart(output, metadata, layout, classes):
    choice = choose_layout(output, SIZE, metadata, "auto", "m.onnx")
    assert (choice.layout, choice.classes) == (layout, classes)
    assert choice.reason


@pytest.mark.parametrize(
    ("shape", "metadata"),
    [
        ((1, 84, CELLS + 1), PLAIN),
        ((1, CELLS, 85), ModelMetadata(names=("a",) * 79)),  # names and columns disagree
        ((1, CELLS, 84), ModelMetadata(names=("a",) * 80)),  # transposed v8
        ((1, 4, CELLS), PLAIN),  # no class
        ((1, CELLS, 85), ModelMetadata(ultralytics=True)),
        ((1, 5000, 6), PLAIN),
    ],
)
def test_what_no_layout_fits_asks_for_the_setting(shape, metadata):
    with pytest.raises(DetectorError, match=r"set detection\.layout"):
        choose_layout(np.zeros(shape), SIZE, metadata, "auto", "m.onnx")


@pytest.mark.parametrize("shape", [(2, 84, CELLS), (84, CELLS), (1, 1, 84, CELLS)])
def test_other_ranks_and_batches_are_refused(shape):
    with pytest.raises(DetectorError, match="output has shape"):
        choose_layout(np.zeros(shape), SIZE, PLAIN, "auto", "m.onnx")


def test_other_tasks_are_refused():
    with pytest.raises(DetectorError, match="pose"):
        choose_layout(np.zeros((1, 56, CELLS)), SIZE, ModelMetadata(task="pose"), "auto", "m.onnx")


def test_the_configured_layout_is_held_against_the_shape():
    out = np.zeros((1, CELLS, 85))
    assert choose_layout(out, SIZE, PLAIN, "yolox-decoded", "m").layout == "yolox-decoded"
    # It overrules metadata that says otherwise ...
    wrong = ModelMetadata(ultralytics=True)
    assert choose_layout(out, SIZE, wrong, "yolox", "m").layout == "yolox"
    # ... but not the shape.
    with pytest.raises(DetectorError, match=r"cannot be detection\.layout yolov8"):
        choose_layout(out, SIZE, PLAIN, "yolov8", "m")


def test_raw_and_decoded_yolox_are_told_apart_by_their_centres():
    rng = np.random.default_rng(2)
    raw = rng.normal(0, 1.5, (1, CELLS, 6)).astype(np.float32)
    decoded = decoded_grid(1)
    decoded[0, :, :2] += rng.normal(0, 4, (CELLS, 2))
    assert yolox_is_decoded(raw, SIZE) is False
    assert yolox_is_decoded(decoded, SIZE) is True
    assert yolox_is_decoded(np.full((1, CELLS, 6), 3000.0), SIZE) is None
    assert yolox_is_decoded(np.full((1, CELLS, 6), np.nan), SIZE) is None
    with pytest.raises(DetectorError, match="neither raw nor decoded"):
        choose_layout(np.full((1, CELLS, 6), 3000.0), SIZE, PLAIN, "auto", "m")


def test_the_detections_among_several_outputs():
    flat, image = np.zeros((1, 84, CELLS)), np.zeros((1, 32, 16, 16))
    assert pick_output([("protos", image), ("boxes", flat)], "m") == 1
    assert pick_output([("a", flat), ("output0", flat)], "m") == 1
    for outputs in ([("a", flat), ("b", flat)], [("protos", image)], []):
        with pytest.raises(DetectorError, match="export a detection model"):
            pick_output(outputs, "m")


@settings(deadline=None, max_examples=200)
@given(data=st.data(), layout=st.sampled_from(LAYOUTS), nc=st.integers(0, 3))
def test_any_array_as_an_output_ends_in_an_answer_or_a_clear_error(data, layout, nc):
    likely = {
        "yolov8": (1, 4 + nc, CELLS),
        "end2end": (1, 7, 6),
        "yolov5": (1, 3 * CELLS, 5 + nc),
    }.get(layout, (1, CELLS, 5 + nc))
    shape = data.draw(st.just(likely) | hnp.array_shapes(min_dims=0, max_dims=4, max_side=8))
    dtype = data.draw(st.sampled_from([np.float32, np.float16, np.float64, np.int32, np.bool_]))
    fill = None if data.draw(st.booleans()) else st.sampled_from([0, 1])
    output = data.draw(hnp.arrays(dtype, shape, fill=fill))
    configured = data.draw(st.sampled_from(["auto", layout]))
    try:
        told = choose_layout(output, SIZE, PLAIN, configured, "m").reason
    except DetectorError as error:
        told = str(error)
    assert told
    assert "\n" not in told
    try:
        found = decode(output, layout, SIZE, 0.1, all_wanted(nc), "m")
    except DetectorError:
        return
    assert found.box.shape == (len(found), 4)
    assert np.isfinite(found.box).all()
    assert (found.box[:, 2:] > found.box[:, :2]).all()
    assert ((found.score >= 0.1) & (found.score <= 1)).all()
    assert ((found.class_id >= 0) & (found.class_id < nc)).all()
