"""The rows that road users can be in: nobody within range stands outside them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.config import load_config, road_strip
from bikeped.geometry import Framing, GroundCamera, Lens
from bikeped.geometry import road_strip as strip_of
from bikeped.geometry.road import TALLEST_M
from bikeped.types import Strip

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
        st.tuples(st.floats(-3.14, 3.14), st.floats(0.3, 25.0), st.floats(0.0, TALLEST_M)),
        min_size=1,
        max_size=20,
    ),
)
def test_everybody_within_range_is_inside(height_m, pitch_deg, fov_deg, people):
    view = camera(height_m, pitch_deg, fov_deg)
    strip = strip_of(view, FRAME, 25.0)
    assert strip.aspect == 960 / 540
    turn, away, up = np.array(people).T
    uv, seen = view.project(np.stack([away * np.cos(turn), away * np.sin(turn), up], axis=1))
    first, end = strip.rows_of(540)
    assert (uv[seen, 1] >= first).all()
    assert (uv[seen, 1] <= end).all()


def test_a_level_camera_needs_no_sky_and_a_tilted_one_all():
    level = strip_of(camera(), FRAME, 25.0)
    assert 0.48 < level.top < 0.54  # the horizon is the middle row; nobody reaches up to it
    assert level.bottom == 1.0
    assert strip_of(camera(pitch_deg=-70.0), FRAME, 25.0).top < 0.05
    # Below the heads of people, their heads are before the sky.
    assert strip_of(camera(height_m=1.0), FRAME, 25.0).top == 0.0
    # Farther away is higher in the picture.
    assert strip_of(camera(), FRAME, 5.0).top > level.top


def test_a_camera_that_sees_no_ground_is_shown_whole():
    up = GroundCamera(Lens.from_circle("equidistant", 480, 60.0), 480.0, 270.0, 3.6, 80.0, 0.0)
    assert strip_of(up, FRAME, 25.0) == Strip(0.0, 1.0, 960 / 540)


def test_the_deployed_cameras_rows():
    strip = road_strip(load_config(None))
    # cy 1804.5 in the crop is row 1134.5 of 2160: the horizon. The tallest at 25 m reach up to
    # 2.7 degrees below it, or 47 rows; two degrees of margin bring back 35.
    assert strip.top * 2160 == pytest.approx(1134.5 + 47 - 35, abs=2.5)
    assert strip.bottom == 1.0


def test_rows_of_copies():
    strip = Strip(0.25, 1.0, 16 / 9)
    assert strip.rows_of(1080) == (270, 1080)
    assert strip.rows_of(540) == (135, 540)
    assert Strip(0.999, 1.0, 1.0).rows_of(2) == (1, 2)
    assert Strip(0.0, 0.001, 1.0).rows_of(2) == (0, 1)
    for top, bottom, aspect in ((0.5, 0.5, 1), (-0.1, 1, 1), (0, 1.1, 1), (0, 1, 0)):
        with pytest.raises(ValueError, match="no rows"):
            Strip(top, bottom, aspect)
