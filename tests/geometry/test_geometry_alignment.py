"""Height, pitch and the rest from marks on the ground."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.errors import GeometryError
from bikeped.geometry.alignment import (
    Alignment,
    Mark,
    Residual,
    Spacing,
    ground_distance_m,
    pixel_at_distance,
    plain_radius_px,
)
from bikeped.geometry.alignment_fit import fit_alignment
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.lens import Lens

CAMERA = GroundCamera(Lens.from_circle("equidistant", 1750, 197.9), 1752.69, 1804.54, 3.6576)
FOUR = ((4.0, -1.5), (6.0, 2.0), (10.0, -3.0), (15.0, 4.0))


def seen(camera: GroundCamera, at, measured=("distance", "right"), noise=None) -> list[Mark]:
    """Marks as `camera` sees them at ground positions, measured without error."""
    uv, visible = camera.project(np.array(at, float))
    assert visible.all()
    if noise is not None:
        uv = uv + noise
    marks = []
    for i, (x, y) in enumerate(at):
        values = {"distance": math.hypot(x, y), "forward": x, "right": y}
        marks.append(
            Mark(str(i + 1), uv[i, 0], uv[i, 1], **{f"{m}_m": values[m] for m in measured})
        )
    return marks


@settings(max_examples=25, deadline=None)
@given(
    height=st.floats(2.0, 9.0),
    pitch=st.floats(-45, 5),
    model=st.sampled_from(["equidistant", "equisolid", "stereographic"]),
)
def test_four_marks_give_height_and_pitch_back_from_any_start(height, pitch, model) -> None:
    start = replace(CAMERA, lens=Lens.from_circle(model, 1750, 197.9))
    truth = replace(start, height_m=height, pitch_deg=pitch)
    found = fit_alignment(start, seen(truth, FOUR)).alignment
    assert found.height_m == pytest.approx(height, abs=1e-5)
    assert found.pitch_deg == pytest.approx(pitch, abs=1e-4)
    assert (found.radius_px, found.cx, found.cy) == (pytest.approx(1750), CAMERA.cx, CAMERA.cy)


def test_forward_and_right_or_distances_and_a_spacing_do_as_well() -> None:
    truth = replace(CAMERA, height_m=4.4, pitch_deg=-11)
    by_axes = fit_alignment(CAMERA, seen(truth, FOUR, ("forward", "right"))).alignment
    marks = seen(truth, FOUR[:3], ("distance",))
    apart = math.dist(FOUR[0], FOUR[2])
    by_tape = fit_alignment(CAMERA, marks, [Spacing(0, 2, apart)]).alignment
    for found in (by_axes, by_tape):
        assert found.height_m == pytest.approx(4.4, abs=1e-5)
        assert found.pitch_deg == pytest.approx(-11, abs=1e-4)


def test_radius_heading_and_radial_terms() -> None:
    lens = Lens.from_circle("equidistant", 1690, 197.9, (-0.02, 0.001, 0, 0))
    truth = GroundCamera(lens, 1752.69, 1804.54, 3.9, -20, heading_deg=8)
    start = replace(CAMERA, lens=Lens.from_circle("equidistant", 1750, 197.9, lens.k))
    around = [(3.0, 0.5), (5.0, -4.0), (7.0, 6.0), (10.0, 0.0), (15.0, -8.0), (14.0, 9.0)]
    answer = fit_alignment(
        start, seen(truth, around), free=("height_m", "pitch_deg", "radius_px", "heading_deg")
    )
    found = answer.alignment
    assert found.radius_px == pytest.approx(1690, abs=1e-3)
    assert plain_radius_px(found.camera(start).lens) == pytest.approx(1690, abs=1e-3)
    assert found.heading_deg == pytest.approx(8, abs=1e-4)
    assert found.camera(start).lens.focal_px == pytest.approx(lens.focal_px)
    assert answer.redundancy == 12 - 4


def test_errors_are_as_large_as_the_answer_says() -> None:
    """Over many noisy settings of the marks the spread is the promised standard error."""
    truth = replace(CAMERA, height_m=4.2, pitch_deg=-7.3)
    rng = np.random.default_rng(5)
    off, said, reading = [], [], []
    for _ in range(40):
        answer = fit_alignment(CAMERA, seen(truth, FOUR, noise=rng.normal(0, 2, (4, 2))))
        off.append((answer.alignment.height_m - 4.2, answer.alignment.pitch_deg + 7.3))
        said.append((answer.standard_errors["height_m"], answer.standard_errors["pitch_deg"]))
        pixel = pixel_at_distance(truth)
        read = ground_distance_m(answer.alignment.camera(CAMERA), pixel)
        reading.append((read - 10) / answer.standard_error_at_10m_m)
    spread = np.sqrt(np.mean(np.square(off), axis=0))
    # The promise also holds the tape's 2 cm, which these measurements do not have.
    assert (spread < np.mean(said, axis=0)).all()
    assert (spread > 0.4 * np.mean(said, axis=0)).all()
    assert 0.4 < float(np.std(reading)) < 1.2


def test_a_wrong_measurement_stands_out_and_widens_the_error() -> None:
    truth = replace(CAMERA, height_m=4.2, pitch_deg=-7.3)
    marks = seen(truth, (*FOUR, (8.0, 4.0), (5.0, -5.0)))
    good = fit_alignment(CAMERA, marks)
    assert not good.outliers
    assert good.suspect_mark is None
    marks[3] = replace(marks[3], distance_m=marks[3].distance_m + 4.0)
    bad = fit_alignment(CAMERA, marks)
    assert bad.outliers
    assert bad.suspect_mark == "4"
    assert bad.standard_errors["height_m"] > 2 * good.standard_errors["height_m"]


def test_of_two_wrong_measurements_none_is_named_as_the_only_one() -> None:
    truth = replace(CAMERA, height_m=4.2, pitch_deg=-7.3)
    marks = seen(truth, (*FOUR, (8.0, 4.0), (5.0, -5.0)))
    marks[3] = replace(marks[3], distance_m=marks[3].distance_m + 4.0)
    marks[4] = replace(marks[4], distance_m=marks[4].distance_m + 2.0)
    bad = fit_alignment(CAMERA, marks)
    assert bad.outliers
    assert bad.suspect_mark is None


@pytest.mark.parametrize(("read_m", "is_outlier"), [(10.39, False), (10.41, True), (9.59, True)])
def test_an_outlier_is_off_by_more_than_four_standard_errors(read_m, is_outlier) -> None:
    assert Residual("1", "distance", 10.0, read_m, 0.1).is_outlier is is_outlier


@pytest.mark.parametrize(
    ("at", "measured", "free", "says"),
    [
        (((10, 0),), ("distance",), ("height_m", "pitch_deg"), "add 1 more"),
        (
            ((10, -0.5), (10, 0), (10, 0.5)),
            ("distance",),
            ("height_m", "pitch_deg"),
            "do not tell height and pitch apart",
        ),
        (((5, 0), (12, 0)), ("distance",), ("height_m", "pitch_deg"), "two solutions fit"),
        (FOUR, ("distance", "right"), ("height_m", "pitch_deg", "radius_px", "cx", "cy"), "apart"),
        (FOUR, ("distance",), ("height_m", "heading_deg"), "determine the heading"),
        (FOUR, ("distance",), ("roll_deg",), "roll_deg"),
        (FOUR, ("distance",), (), "free: nothing"),
    ],
)
def test_what_the_marks_do_not_determine_is_said(at, measured, free, says) -> None:
    with pytest.raises(GeometryError, match=says):
        fit_alignment(CAMERA, seen(CAMERA, at, measured), free=free)


def test_marks_that_cannot_be() -> None:
    with pytest.raises(GeometryError, match=r"mark a: distance_m: missing"):
        Mark("a", 1, 1, right_m=2)
    with pytest.raises(GeometryError, match="more than its distance"):
        Mark("a", 1, 1, distance_m=5, right_m=-6)
    with pytest.raises(GeometryError, match="over-determine it"):
        Mark("a", 1, 1, distance_m=5, right_m=3, forward_m=4)
    with pytest.raises(GeometryError, match="must be above 0"):
        Mark("a", 1, 1, distance_m=0)
    with pytest.raises(GeometryError, match="not finite"):
        Mark("a", 1, math.nan, distance_m=1)
    good = seen(CAMERA, FOUR)
    with pytest.raises(GeometryError, match="same pixel"):
        fit_alignment(CAMERA, [*good, replace(good[0], name="5")])
    with pytest.raises(GeometryError, match="mark 5 lies outside the image circle"):
        fit_alignment(CAMERA, [*good, Mark("5", 3499, 3499, distance_m=3)])
    # A stop sign and a lamp: as high in the picture as only a camera that looks down sees ground.
    level = replace(CAMERA, pitch_deg=0)
    with pytest.raises(GeometryError, match="on the ground"):
        fit_alignment(
            level, [Mark("1", 1700, 300, 5), Mark("2", 1800, 3400, 9)], free=("height_m",)
        )
    with pytest.raises(GeometryError, match="two different marks"):
        fit_alignment(CAMERA, good, [Spacing(0, 0, 1)])
    with pytest.raises(GeometryError, match="spacing 1-2: 0 must be above 0"):
        fit_alignment(CAMERA, good, [Spacing(0, 1, 0)])


@given(
    height=st.floats(0.5, 20),
    pitch=st.floats(-90, 90),
    radius=st.floats(100, 5000),
    cx=st.floats(0, 3500),
)
def test_numbers_of_a_camera_there_and_back(height, pitch, radius, cx) -> None:
    there = Alignment(height, pitch, radius, cx, 1700, 5)
    back = Alignment.of(there.camera(CAMERA))
    assert back.radius_px == pytest.approx(radius)
    assert replace(back, radius_px=radius) == there


def test_the_ten_metre_pixel_reads_ten_metres_where_it_is_seen() -> None:
    for camera in (CAMERA, replace(CAMERA, pitch_deg=-30, heading_deg=40)):
        pixel = pixel_at_distance(camera)
        assert pixel is not None
        assert ground_distance_m(camera, pixel) == pytest.approx(10)
    # 1 % more height is 1 % more distance: what the installer's table says.
    pixel = pixel_at_distance(CAMERA)
    taller = replace(CAMERA, height_m=CAMERA.height_m * 1.01)
    assert ground_distance_m(taller, pixel) == pytest.approx(10.1)
    assert ground_distance_m(CAMERA, (CAMERA.cx, CAMERA.cy - 100)) is None
    up = replace(CAMERA, lens=Lens.from_circle("equidistant", 1750, 20), pitch_deg=60)
    assert pixel_at_distance(up) is None


def test_no_camera_has_these_numbers() -> None:
    good = Alignment.of(CAMERA)
    for bad in (replace(good, radius_px=0), replace(good, height_m=-1)):
        with pytest.raises(GeometryError):
            bad.camera(CAMERA)
