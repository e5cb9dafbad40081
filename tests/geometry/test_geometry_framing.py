"""Sensor image, padded square, crop, and smaller recordings."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.errors import GeometryError
from bikeped.geometry.framing import Framing

DEPLOYED = Framing(3840, 2160, 3840, 3500)


def test_only_rows_670_to_2829_and_all_columns_exist_on_the_sensor():
    assert DEPLOYED.crop_wh == (3500, 3500)
    assert DEPLOYED.window_px == (0.0, 670.0, 3500.0, 2830.0)
    # As pictures: pad a sensor of ones to the square, cut the middle, see where the ones are.
    padded = np.zeros((3840, 3840), np.uint8)
    padded[(3840 - 2160) // 2 : (3840 + 2160) // 2] = 1
    crop = padded[170 : 170 + 3500, 170 : 170 + 3500]
    rows = np.nonzero(crop.all(axis=1))[0]
    assert (rows[0], rows[-1], len(rows)) == (670, 2829, 2160)
    np.testing.assert_allclose(DEPLOYED.frame_to_crop([0, 0]), (-170, 670))


@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    st.integers(16, 4000), st.integers(16, 4000), st.integers(0, 300), st.integers(16, 4300),
    st.sampled_from([1, 2, 4]),
)  # fmt: skip
def test_offsets_are_where_the_pixels_go_and_scaling_is_undone(w, h, more, crop, shrink):
    pad = max(w, h) + more
    framing = Framing(w, h, pad, min(crop, pad))
    ox, oy = framing.offset_px
    side = framing.crop_wh[0]
    left, top = (pad - side) // 2, (pad - side) // 2
    assert (ox, oy) == ((pad - w) // 2 - left, (pad - h) // 2 - top)
    u0, v0, u1, v1 = framing.window_px
    assert 0 <= u0 <= u1 <= side
    assert 0 <= v0 <= v1 <= side
    if w % shrink == 0 and h % shrink == 0:
        small = framing.for_frame(w // shrink, h // shrink)
        assert small.scale == shrink
        uv = np.array([[0.0, 0.0], [w / shrink, h / shrink], [3.25, 7.5]])
        np.testing.assert_allclose(small.crop_to_frame(small.frame_to_crop(uv)), uv, atol=1e-9)
        np.testing.assert_allclose(
            small.frame_to_crop(uv), framing.frame_to_crop(uv * shrink), atol=1e-9
        )


def test_scaled_recordings():
    small = DEPLOYED.for_frame(1280, 720)
    assert small.scale == 3.0
    np.testing.assert_allclose(small.frame_to_crop([640.0, 360.0]), (1750.0, 1750.0))
    assert small.window_px == DEPLOYED.window_px
    odd = DEPLOYED.for_frame(854, 480)  # 480p is not exactly 16:9; half a pixel off is accepted
    assert odd.scale == pytest.approx(3840 / 854)


@pytest.mark.parametrize("size", [(1280, 960), (720, 1280), (3500, 3500), (1280, 716)])
def test_another_cameras_frames_are_refused(size):
    with pytest.raises(GeometryError, match=f"frames are {size[0]} x {size[1]}.*set them"):
        DEPLOYED.for_frame(*size)


def test_steps_may_be_left_out():
    whole = Framing(1920, 1080)
    assert whole.crop_wh == (1920, 1080)
    assert whole.offset_px == (0, 0)
    assert whole.window_px == (0.0, 0.0, 1920.0, 1080.0)
    middle = Framing(1920, 1080, None, 1080)
    assert middle.offset_px == (-420, 0)
    padded = Framing(1920, 1080, 1920)
    assert padded.offset_px == (0, 420)


def test_impossible_framings_are_refused_with_the_key():
    with pytest.raises(GeometryError, match=r"camera\.pad_size.*at least 3840"):
        Framing(3840, 2160, 3500)
    with pytest.raises(GeometryError, match=r"camera\.crop_size: 3000"):
        Framing(3840, 2160, None, 3000)
