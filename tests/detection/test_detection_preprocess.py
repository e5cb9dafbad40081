"""Letterbox and scaling: every family against a plain formula, and boxes there and back."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bikeped.detection.preprocess import Family, Letterbox, Preprocessor
from bikeped.types import Region

FAMILIES = get_args(Family)

MEAN, DEVIATION = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def picture(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def formula(rgb, family):
    """What the input holds for a picture, by the definition: [3, h, w] float64."""
    if family == "ultralytics":
        value = rgb / 255
    elif family == "yolox":
        value = rgb[:, :, ::-1].astype(np.float64)
    else:
        value = (rgb / 255 - MEAN) / DEVIATION
    return value.transpose(2, 0, 1)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_values_are_the_formulas_where_nothing_is_resized(family, dtype):
    rgb = picture(64, 96)
    run = Preprocessor(family, np.zeros((1, 3, 96, 96), dtype))
    box = run(rgb, 96, 64)
    top = 16 if family == "ultralytics" else 0
    assert (box.left, box.top, box.width, box.height) == (0, top, 96, 64)
    canvas = np.full((96, 96, 3), 114, np.uint8)
    canvas[top : top + 64] = rgb
    expected = formula(canvas, family).astype(dtype)
    np.testing.assert_array_equal(run.buffer[0], expected)


@pytest.mark.parametrize(("family", "order"), [("ultralytics", 1), ("yolox", -1)])
def test_a_byte_input_gets_the_bytes(family, order):
    rgb = picture(32, 64)
    run = Preprocessor(family, np.zeros((1, 3, 32, 64), np.uint8))
    run(rgb, 64, 32)
    np.testing.assert_array_equal(run.buffer[0], rgb[:, :, ::order].transpose(2, 0, 1))


@pytest.mark.parametrize("family", FAMILIES)
def test_a_new_frame_size_leaves_nothing_of_the_old_one(family):
    reused = Preprocessor(family, np.zeros((1, 3, 64, 64), np.float32))
    reused(picture(64, 40, seed=1), 40, 64)
    reused(picture(32, 64, seed=2), 64, 32)
    fresh = Preprocessor(family, np.zeros((1, 3, 64, 64), np.float32))
    fresh(picture(32, 64, seed=2), 64, 32)
    np.testing.assert_array_equal(reused.buffer, fresh.buffer)


def test_a_picture_that_is_a_view_of_another_serves_too():
    whole = picture(40, 80)
    cut = whole[4:36, 8:72]
    a, b = (Preprocessor("yolox", np.zeros((1, 3, 64, 64), np.float32)) for _ in range(2))
    a(cut, 64, 32)
    b(np.ascontiguousarray(cut), 64, 32)
    np.testing.assert_array_equal(a.buffer, b.buffer)


def test_the_same_picture_at_half_scale_lies_in_the_same_place():
    # A smooth picture: bright right half. The scale it was decoded at must not move the edge.
    full = np.zeros((400, 800, 3), np.uint8)
    full[:, 400:] = 200
    run = Preprocessor("ultralytics", np.zeros((1, 3, 128, 128), np.float32))
    where = run(full, 800, 400)
    first = run.buffer.copy()
    assert run(np.ascontiguousarray(full[::2, ::2]), 800, 400) == where
    assert np.abs(run.buffer - first).mean() < 0.01


@pytest.mark.parametrize(
    ("family", "frame", "size", "place"),
    [
        ("ultralytics", (1920, 1080), (640, 640), (0, 140, 640, 360)),
        ("ultralytics", (1080, 1920), (640, 640), (140, 0, 360, 640)),
        ("ultralytics", (1920, 1080), (640, 384), (0, 12, 640, 360)),
        ("ultralytics", (320, 320), (640, 640), (0, 0, 640, 640)),  # grown
        ("yolox", (768, 432), (416, 416), (0, 0, 416, 234)),
        ("yolox-legacy", (1000, 333), (416, 416), (0, 0, 416, 138)),  # 138.5 is cut
        ("yolox", (1, 4000), (64, 64), (0, 0, 1, 64)),  # never less than a pixel
    ],
)
def test_where_the_picture_lies(family, frame, size, place):
    box = Letterbox.fit(*frame, size, family)
    assert (box.left, box.top, box.width, box.height) == place


@given(
    st.sampled_from(FAMILIES),
    st.tuples(st.integers(16, 8000), st.integers(16, 8000)),
    st.tuples(st.integers(32, 1280), st.integers(32, 1280)),
    st.lists(st.floats(0, 1), min_size=4, max_size=4),
)
def test_boxes_come_back(family, frame, size, share):
    where = Letterbox.fit(*frame, size, family)
    box = np.array([share], np.float64) * np.array([frame * 2])
    inside = where.forward(box)
    assert (inside >= -1e-3).all()
    assert (inside <= np.array(size * 2) + 1e-3).all()
    np.testing.assert_allclose(where.inverse(inside), box, atol=max(frame) * 2e-4)


def test_the_corners_of_the_frame_are_the_corners_of_the_picture():
    where = Letterbox.fit(3840, 2160, (640, 640), "ultralytics")
    assert where.forward(np.array([[0, 0, 3840, 2160]])).tolist() == [[0, 140, 640, 500]]


@pytest.mark.parametrize(
    ("rgb", "frame"),
    [
        (np.zeros((32, 64), np.uint8), (64, 32)),
        (np.zeros((32, 64, 4), np.uint8), (64, 32)),
        (np.zeros((32, 64, 3), np.float32), (64, 32)),
        (np.zeros((0, 64, 3), np.uint8), (64, 32)),
        (np.zeros((64, 32, 3), np.uint8), (64, 32)),  # turned
    ],
)
def test_what_is_not_the_frame_is_refused(rgb, frame):
    run = Preprocessor("yolox", np.zeros((1, 3, 64, 64), np.float32))
    with pytest.raises(ValueError, match="image"):
        run(rgb, *frame)


def test_bad_buffers_and_sizes_are_refused():
    with pytest.raises(ValueError, match="contiguous"):
        Preprocessor("yolox", np.zeros((1, 64, 64, 3), np.float32))
    with pytest.raises(ValueError, match="cannot letterbox"):
        Letterbox.fit(0, 10, (64, 64), "yolox")


@pytest.mark.parametrize("family", FAMILIES)
def test_of_a_region_the_network_sees_just_that(family):
    rgb = picture(96, 64)
    half = Region(0.25, 0.5, 0.75, 1.0, 64 / 96)
    shown = Preprocessor(family, np.zeros((1, 3, 64, 64), np.float32), half)
    where = shown(rgb, 64, 96)
    cut = Preprocessor(family, np.zeros((1, 3, 64, 64), np.float32))
    cut(np.ascontiguousarray(rgb[48:, 16:48]), 32, 48)
    np.testing.assert_array_equal(shown.buffer, cut.buffer)
    assert where.shown_px == (16, 48, 48, 96)
    box = np.array([[20.0, 60.0, 30.0, 90.0]])
    np.testing.assert_allclose(where.inverse(where.forward(box)), box, atol=1e-5)


def test_the_region_of_a_smaller_copy_lies_in_the_same_place():
    full = np.zeros((400, 800, 3), np.uint8)
    full[200:, 400:] = 200
    part = Region(0.25, 0.4, 1.0, 1.0, 2.0)
    run = Preprocessor("ultralytics", np.zeros((1, 3, 64, 128), np.float32), part)
    where = run(full, 800, 400)
    first = run.buffer.copy()
    assert run(np.ascontiguousarray(full[::2, ::2]), 800, 400) == where
    assert np.abs(run.buffer - first).mean() < 0.01
    # Thirds of 800 x 400: whole pixels of the copy are cut, and boxes land by them.
    third = run(picture(133, 267), 800, 400)
    assert third.shown_px == pytest.approx((67 * 800 / 267, 53 * 400 / 133, 800, 400))
    box = np.array([[300, 200, 800, 400]])
    np.testing.assert_allclose(third.inverse(third.forward(box)), box, atol=1e-3)


@given(
    st.sampled_from(FAMILIES),
    st.tuples(st.integers(64, 4000), st.integers(64, 4000)),
    st.tuples(st.integers(32, 1280), st.integers(32, 1280)),
    st.tuples(st.floats(0, 0.45), st.floats(0, 0.8), st.floats(0.55, 1)),
    st.lists(st.floats(0, 1), min_size=4, max_size=4),
)
def test_boxes_of_a_region_come_back(family, frame, size, part, share):
    left, top, right = part
    shown = left * frame[0], top * frame[1], right * frame[0], float(frame[1])
    where = Letterbox.fit(*frame, size, family, shown)
    low, high = np.array(shown[:2] * 2), np.array(shown[2:] * 2)
    box = low + np.array([share]) * (high - low)
    inside = where.forward(box)
    assert (inside >= -1e-2).all()
    assert (inside <= np.array(size * 2) + 1e-2).all()
    np.testing.assert_allclose(where.inverse(inside), box, atol=max(frame) * 2e-4)
