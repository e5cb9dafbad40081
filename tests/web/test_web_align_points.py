"""Marks in a file or a request, and what is refused of them."""

from __future__ import annotations

import math

import pytest

from bikeped.config.build import framing, ground_camera
from bikeped.config.load import default_config_path, load_config
from bikeped.errors import BikepedError, GeometryError
from bikeped.web.align_points import (
    Between,
    FrameSize,
    Point,
    Points,
    _measured,
    fit_points,
    load_points,
)


def test_a_file_that_no_page_exported_is_refused(tmp_path):
    large = tmp_path / "points.json"
    large.write_bytes(b" " * 1_000_001)
    with pytest.raises(BikepedError, match="larger than 1 MB"):
        load_points(large)
    with pytest.raises(BikepedError, match="cannot be read"):
        load_points(tmp_path / "none.json")


def test_a_distance_between_marks_names_marks_that_are_there():
    loaded = load_config(default_config_path())
    camera = loaded.config.camera
    points = Points(
        FrameSize(camera.width, camera.height),
        [Point("a", 1900.0, 1500.0, 8.0), Point("b", 2000.0, 1500.0, 8.0)],
        [Between("a", "c", 3.0)],
    )
    with pytest.raises(GeometryError, match="there is no mark c"):
        fit_points(ground_camera(loaded), framing(loaded), points)


def test_the_measured_place_of_a_mark():
    """Forward, right in metres, from whatever was measured; x, y is what the camera reads."""

    def place(distance_m=None, right_m=None, forward_m=None):
        return _measured(Point("a", 0, 0, distance_m, right_m, forward_m), 3.0, 4.0)

    assert place(forward_m=7.0) == (7.0, 4.0)
    assert place(forward_m=7.0, right_m=2.0) == (7.0, 2.0)
    assert place(distance_m=10.0) == pytest.approx((6.0, 8.0))
    assert place(distance_m=10.0, right_m=6.0) == pytest.approx((8.0, 6.0))
    assert place() is None
    assert place(distance_m=5.0, right_m=6.0) is None
    assert math.isclose(place(distance_m=5.0, right_m=-3.0)[0], 4.0)
