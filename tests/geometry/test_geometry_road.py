"""The part that road users can be in: nobody within range stands outside it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.config.build import road_region
from bikeped.config.load import load_config
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import MAX_HEIGHT_M, Framing
from bikeped.geometry.framing import road_region as region_of
from bikeped.geometry.lens import Lens
from bikeped.types import Region

FRAME = Framing(960, 540)


def camera(height_m=3.6, pitch_deg=0.0, fov_deg=190.0, circle=480.0):
    lens = Lens.from_circle("equidistant", circle, fov_deg)
    return GroundCamera(lens, 480.0, 270.0, height_m, pitch_deg, 0.0, FRAME.window_px)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    st.floats(2.6, 8.0),
    st.floats(-45.0, 10.0),
    st.floats(120.0, 210.0),
    st.lists(
        st.tuples(st.floats(-3.14, 3.14), st.floats(0.3, 25.0), st.floats(0.0, MAX_HEIGHT_M)),
        min_size=1,
        max_size=20,
    ),
)
def test_everybody_within_range_is_inside(height_m, pitch_deg, fov_deg, people):
    view = camera(height_m, pitch_deg, fov_deg)
    region = region_of(view, FRAME, 25.0)
    assert region.aspect == 960 / 540
    turn, away, up = np.array(people).T
    uv, seen = view.project(np.stack([away * np.cos(turn), away * np.sin(turn), up], axis=1))
    u1, v1, u2, v2 = region.pixels(960, 540)
    assert (uv[seen] >= (u1, v1)).all()
    assert (uv[seen] <= (u2, v2)).all()


def test_a_level_camera_needs_no_sky_and_a_tilted_one_all():
    level = region_of(camera(), FRAME, 25.0)
    assert 0.48 < level.top < 0.54  # the horizon is the middle row; nobody reaches up to it
    assert level.bottom == 1.0
    assert (level.left, level.right) == pytest.approx((0, 1))
    small = region_of(camera(circle=400.0), FRAME, 25.0)  # black beside the image circle
    assert (small.left, small.right) == pytest.approx((80 / 960, 880 / 960), abs=0.002)
    assert region_of(camera(pitch_deg=-70.0), FRAME, 25.0).top < 0.05
    # Below the heads of people, their heads are before the sky.
    assert region_of(camera(height_m=1.0), FRAME, 25.0).top == 0.0
    # Farther away is higher in the picture.
    assert region_of(camera(), FRAME, 5.0).top > level.top


def test_a_camera_that_sees_no_ground_is_shown_whole():
    up = GroundCamera(Lens.from_circle("equidistant", 480, 60.0), 480.0, 270.0, 3.6, 80.0, 0.0)
    assert region_of(up, FRAME, 25.0) == Region(0.0, 0.0, 1.0, 1.0, 960 / 540)


def test_the_deployed_cameras_road():
    region = road_region(load_config(None))
    # cy 1804.5 in the crop is row 1134.5 of 2160: the horizon. The tallest at 25 m reach up to
    # 2.7 degrees below it, or 47 rows; two degrees of margin bring back 35.
    assert region.top * 2160 == pytest.approx(1134.5 + 47 - 35, abs=2.5)
    assert region.bottom == 1.0
    # The circle: 1750 pixels about 1752.7 in the crop, which begins at column 170.
    assert region.left * 3840 == pytest.approx(172.7, abs=1)
    assert region.right * 3840 == pytest.approx(3672.7, abs=1)


def test_parts_of_copies():
    region = Region(0.125, 0.25, 1.0, 1.0, 16 / 9)
    assert region.pixels(1920, 1080) == (240, 270, 1920, 1080)
    assert region.pixels(960, 540) == (120, 135, 960, 540)
    assert Region(0.0, 0.999, 1.0, 1.0, 1.0).pixels(2, 2) == (0, 1, 2, 2)
    assert Region(0.0, 0.0, 0.001, 0.001, 1.0).pixels(2, 2) == (0, 0, 1, 1)
    for bad in (
        (0, 0.5, 1, 0.5, 1),
        (0, -0.1, 1, 1, 1),
        (0, 0, 1, 1.1, 1),
        (0.5, 0, 0.4, 1, 1),
        (0, 0, 1, 1, 0),
    ):
        with pytest.raises(ValueError, match="not a part"):
            Region(*bad)
