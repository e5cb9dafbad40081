"""Squares filled with windows: nothing overlaps, boxes stay on what they box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.lab.training.crops import Cropper, CropSettings, Sample
from bikeped.lab.training.packing import BLOCK_PX, Packer, PackSettings, first_fit

CROPS = CropSettings(view=(480, 320), scale=(1.0, 1.0), flip=0.0, cover=0, light=0)
PLAIN = PackSettings(empty=0.0, furniture=0.0, taken=(1.0,))


def street(boxes, kind=0, crowd=0):
    """White boxes on black."""
    rgb = np.zeros((320, 480, 3), np.uint8)
    for u1, v1, u2, v2 in boxes:
        rgb[v1:v2, u1:u2] = 255
    many = np.full(len(boxes), crowd)
    return Sample(rgb, np.array(boxes, float).reshape(-1, 4), np.full(len(boxes), kind), many)


def packer(pack=PLAIN, crops=CROPS):
    return Packer(pack, crops, Cropper(crops, 0, np.array([[200.0, 100.0]])))


SMALL = street([(100, 100, 120, 140)])
LARGE = street([(40, 40, 260, 300)], kind=1)


def test_squares_are_full_and_every_object_is_boxed():
    squares = packer()([SMALL], 3, np.random.default_rng(0))
    assert [s.rgb.shape for s in squares] == [(256, 256, 3)] * 3
    for square in squares:
        assert len(square.box_px) == 16  # a window of one block each
        white = np.zeros((256, 256), bool)
        for u1, v1, u2, v2 in square.box_px.round().astype(int):
            white[v1:v2, u1:u2] = True
        # Edges between pixels may be grey.
        assert np.mean((square.rgb[..., 0] > 127) != white) < 0.01


def test_what_is_larger_than_a_square_fills_one():
    (square,) = packer()([LARGE], 1, np.random.default_rng(0))
    assert square.class_id.tolist() == [1]
    assert (square.rgb[..., 0] > 127).mean() > 0.75


def test_the_rest_of_a_square_is_filled_with_what_fits():
    pool = [SMALL, street([(50, 50, 130, 190)], kind=1)]  # one block, and three
    for seed in range(5):
        squares = packer()(pool, 2, np.random.default_rng(seed))
        assert all(len(s.box_px) >= 8 for s in squares)
        assert sum((s.class_id == 1).sum() for s in squares) >= 1


def test_without_anybody_there_are_empty_windows():
    (square,) = packer()([street([])], 1, np.random.default_rng(0))
    assert square.box_px.shape == (0, 4)
    crowd = street([(100, 100, 120, 140)], crowd=1)
    (square,) = packer()([crowd], 1, np.random.default_rng(0))
    assert len(square.box_px) == 0


def test_classes_come_as_often_as_asked_for():
    pool = [SMALL, SMALL, SMALL, street([(100, 100, 120, 140)], kind=1)]
    pool += [street([(100, 100, 120, 140)], kind=k) for k in (2, 3)]
    settings_ = replace(PLAIN, classes=(0.5, 0.3))
    squares = packer(settings_)(pool, 40, np.random.default_rng(0))
    count = np.bincount(np.concatenate([s.class_id for s in squares]), minlength=4) / 640
    np.testing.assert_allclose(count, [0.5, 0.3, 0.1, 0.1], atol=0.05)


def test_the_same_seed_gives_the_same_squares():
    crops = replace(CROPS, scale=(0.8, 1.2), flip=0.5, cover=0.5, light=1.0)
    first, again = (packer(PackSettings(), crops)([SMALL, LARGE], 2, np.random.default_rng(3))
                    for _ in range(2))  # fmt: skip
    for one, other in zip(first, again, strict=True):
        assert np.array_equal(one.rgb, other.rgb)
        assert np.array_equal(one.box_px, other.box_px)


@given(st.lists(st.integers(1, 4), min_size=1, max_size=30))
@settings(max_examples=60, deadline=None)
def test_places_never_overlap(sizes):
    free = np.ones((2, 4, 4), bool)
    taken = np.zeros((2, 4, 4), int)
    for blocks in sizes:
        spot = first_fit(free, blocks)
        if spot is None:
            assert not any(
                free[n, r : r + blocks, c : c + blocks].all()
                for n in range(2)
                for r in range(5 - blocks)
                for c in range(5 - blocks)
            )
            continue
        n, r, c = spot
        free[n, r : r + blocks, c : c + blocks] = False
        taken[n, r : r + blocks, c : c + blocks] += 1
    assert taken.max() <= 1


def test_a_window_holds_its_object_whole_wherever_it_lies():
    cropper = Cropper(CROPS, 0, np.zeros((0, 2)))
    random = np.random.default_rng(1)
    for _ in range(50):
        crop = cropper(
            SMALL, random, window=(BLOCK_PX, BLOCK_PX), around=SMALL.box_px[0], scale=1.0
        )
        assert crop.box_px[0, 2:] - crop.box_px[0, :2] == pytest.approx([20, 40])


def test_some_windows_hold_a_thing_and_nobody():
    # A white pole far from anybody: a window about any spot of it is partly white.
    view = street([(100, 100, 120, 140)])
    view.rgb[20:220, 400:410] = 255
    things = replace(view, furniture_px={"lamp": np.array([[400.0, 20, 410, 220]])})
    (square,) = packer(replace(PLAIN, furniture=1.0))([things], 1, np.random.default_rng(0))
    assert len(square.box_px) == 0
    blocks = square.rgb[..., 0].reshape(4, BLOCK_PX, 4, BLOCK_PX).max(axis=(1, 3))
    assert (blocks == 255).mean() > 0.7  # where two blocks no longer fit there are empty windows
    # With somebody beside it, he is boxed; without the data's telling, nothing changes.
    near = street([(380, 100, 398, 140)])
    near = replace(near, furniture_px={"sign": np.array([[400.0, 100, 410, 140]])})
    (square,) = packer(replace(PLAIN, furniture=1.0))([near], 1, np.random.default_rng(0))
    assert len(square.box_px) > 2
    (square,) = packer(replace(PLAIN, furniture=1.0))([SMALL], 1, np.random.default_rng(0))
    assert len(square.box_px) == 16


def test_every_kind_of_thing_comes_as_often():
    # Twenty trees and one sign: half of the windows show the sign, which is grey.
    view = street([])
    view.rgb[100:140, 300:320] = 255
    view.rgb[100:140, 100:120] = 100
    trees = np.repeat(np.array([[300.0, 100, 320, 140]]), 20, axis=0)
    view = replace(view, furniture_px={"tree": trees, "sign": np.array([[100.0, 100, 120, 140]])})
    squares = packer(replace(PLAIN, furniture=1.0))([view], 40, np.random.default_rng(0))
    tops = np.stack([s.rgb[..., 0].reshape(4, BLOCK_PX, 4, BLOCK_PX).max((1, 3)) for s in squares])
    grey, white = (tops == 100).sum(), (tops == 255).sum()
    assert 0.35 < grey / (grey + white) < 0.65


def test_who_is_hidden_in_part_is_taken_four_times_as_often():
    pool = [street([(40, 40, 60, 60), (300, 200, 340, 240)])]
    pool = [replace(pool[0], hidden=frozenset({1}))]
    squares = packer()(pool, 40, np.random.default_rng(1))
    sides = np.concatenate([s.box_px[:, 2] - s.box_px[:, 0] for s in squares])
    assert 0.74 < np.mean(sides > 30) < 0.84, "four of five, less what does not fit"
