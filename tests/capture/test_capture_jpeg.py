"""JPEG decoding: scales, reused buffers, and bytes that are no JPEG."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.capture.jpeg import JpegDecoder, read_size
from bikeped.errors import CaptureError

WIDTH, HEIGHT = 320, 240


def _picture() -> np.ndarray:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack([u * 255 // WIDTH, v, 255 - v], axis=2).astype(np.uint8)


GOOD = cv2.imencode(".jpg", _picture(), [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


def test_size_is_width_then_height():
    assert read_size(GOOD) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_colours_are_rgb(kind):
    image = JpegDecoder().decode(kind(GOOD))
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(image.astype(int) - _picture()[:, :, ::-1]).mean() < 2.0


@pytest.mark.parametrize(
    ("asked", "eighths"),
    [
        ((0, 0), 8),
        ((WIDTH, HEIGHT), 8),
        ((WIDTH + 1, 1), 8),
        ((161, 120), 8),  # 5/8 would do, but takes longer than the full size
        ((160, 120), 4),
        ((160, 0), 4),
        ((0, 91), 4),
        ((0, 90), 3),
        ((80, 60), 2),
        ((40, 31), 2),
        ((1, 1), 1),
    ],
)
def test_the_smallest_scale_that_is_not_smaller_than_asked(asked, eighths):
    image = JpegDecoder().decode(GOOD, *asked)
    assert image.shape == (HEIGHT * eighths // 8, WIDTH * eighths // 8, 3)
    wanted = cv2.resize(_picture()[:, :, ::-1], image.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(image.astype(int) - wanted).mean() < 3.0


def test_damaged_pictures_in_a_row_leave_those_in_use_alone():
    decoder = JpegDecoder(buffers=3)
    held = [decoder.decode(GOOD) for _ in range(2)]
    before = [image.copy() for image in held]
    for _ in range(7):
        with pytest.raises(CaptureError):
            decoder.decode(GOOD[: len(GOOD) // 2])
    for image, was in zip(held, before, strict=True):
        assert np.array_equal(image, was)
    assert np.array_equal(decoder.decode(GOOD), before[0])
    assert np.array_equal(held[0], before[0])


def test_buffers_take_turns_and_are_reused():
    decoder = JpegDecoder(buffers=3)
    images = [decoder.decode(GOOD) for _ in range(6)]
    for i, image in enumerate(images):
        shared = [np.shares_memory(image, other) for other in images]
        assert shared == [j % 3 == i % 3 for j in range(6)]


def test_a_view_survives_smaller_and_larger_pictures_in_the_other_buffers(make_jpeg):
    decoder = JpegDecoder(buffers=3)
    first = decoder.decode(GOOD)
    before = first.copy()
    decoder.decode(make_jpeg(1, width=640, height=480))
    small = decoder.decode(make_jpeg(2, width=32, height=16))
    assert np.array_equal(first, before)
    assert small.shape == (16, 32, 3)


def test_grey_becomes_rgb():
    data = cv2.imencode(".jpg", _picture()[:, :, 1])[1].tobytes()
    image = JpegDecoder().decode(data)
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert np.array_equal(image[:, :, 0], image[:, :, 2])


def test_missing_huffman_tables_are_the_standard_ones(without_tables):
    bare = without_tables(GOOD)
    assert len(bare) < len(GOOD)
    decoder = JpegDecoder()
    assert np.array_equal(decoder.decode(bare), decoder.decode(GOOD))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.6, 0.9, 0.999])
@pytest.mark.parametrize("tail", [b"", b"\xff\xd9"], ids=["cut", "cut and closed"])
def test_a_cut_picture_is_refused_not_half_grey(share, tail):
    cut = GOOD[: int(len(GOOD) * share)] + tail
    with pytest.raises(CaptureError, match="JPEG"):
        JpegDecoder().decode(cut)


def test_a_failed_decoding_leaves_the_decoder_usable():
    decoder = JpegDecoder(buffers=1)
    with pytest.raises(CaptureError):
        decoder.decode(GOOD[:-200])
    assert np.array_equal(decoder.decode(GOOD), JpegDecoder().decode(GOOD))


def test_a_header_that_promises_too_much_is_refused_before_memory_is_taken():
    start = GOOD.index(b"\xff\xc0") + 5
    huge = GOOD[:start] + b"\xff\xdc\xff\xdc" + GOOD[start + 4 :]
    assert read_size(huge) == (65500, 65500)
    with pytest.raises(CaptureError, match="too many"):
        JpegDecoder().decode(huge)


def test_a_pool_needs_a_buffer():
    with pytest.raises(ValueError, match="buffers"):
        JpegDecoder(buffers=0)


def _picture_or_refusal(data: bytes, size: tuple[int, int]) -> None:
    decoder = JpegDecoder(max_pixels=1 << 20)
    try:
        image = decoder.decode(data, *size)
    except CaptureError:
        return
    assert image.dtype == np.uint8
    assert image.ndim == 3
    assert image.shape[2] == 3


SIZES = st.tuples(st.integers(0, 400), st.integers(0, 400))


@settings(max_examples=150, deadline=None)
@given(
    data=st.binary(max_size=400), head=st.sampled_from([b"", b"\xff\xd8", GOOD[:200]]), size=SIZES
)
def test_any_bytes_end_in_a_picture_or_a_refusal(data, head, size):
    _picture_or_refusal(head + data, size)


@settings(max_examples=150, deadline=None)
@given(
    edits=st.lists(st.tuples(st.integers(0, len(GOOD) - 1), st.integers(0, 255)), max_size=8),
    cut=st.integers(0, len(GOOD)),
    size=SIZES,
)
def test_a_damaged_picture_ends_in_a_picture_or_a_refusal(edits, cut, size):
    data = bytearray(GOOD)
    for at, value in edits:
        data[at] = value
    _picture_or_refusal(bytes(data[:cut]), size)
