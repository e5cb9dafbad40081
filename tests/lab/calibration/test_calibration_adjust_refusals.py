"""Sets of boards that cannot give a lens: each gets a clear word."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from calibration_scenes import PATTERN, boards, camera, found
from synthetic_boards import BoardPose, DrawnCamera, draw_views, spread_poses, turn

from bikeped.errors import CalibrationError
from bikeped.geometry.framing import Framing
from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardRefusedError, BoardView, RefusedImage
from bikeped.lab.calibration.image_pipeline import crop_view
from bikeped.lab.calibration.solver.lens_model import LensModel
from bikeped.lab.calibration.solver.model_comparison import fit_models
from bikeped.lab.calibration.solver.observations import prepare_observations


def refusal(views: list[BoardView], refused: tuple[RefusedImage, ...] = ()) -> str:
    with pytest.raises(CalibrationError) as caught:
        prepare_observations(found(views, refused))
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_no_board() -> None:
    text = refusal([], (RefusedImage("a.jpg", "no board"), RefusedImage("b.jpg", "no board")))
    assert "no board of 8x6" in text
    assert "in 2 pictures" in text
    assert "--pattern" in text


@pytest.mark.parametrize(("count", "what"), [(1, "one board"), (2, "2 boards")])
def test_too_few_boards(count: int, what: str) -> None:
    assert what in refusal(boards(camera(size=1000), count))


def test_boards_that_all_stand_alike() -> None:
    drawn = camera(size=1000)
    pose = spread_poses(drawn, PATTERN, 3, seed=1)[1]
    views = draw_views(drawn, PATTERN, [pose] * 6, noise_px=0.3, seed=3)
    assert "stand alike" in refusal(views)


def test_boards_that_face_the_lens_leave_its_focal_length_open() -> None:
    drawn = camera(size=1000)
    poses = [
        BoardPose(turn([0, 0, 0.5 * n]), np.array([0.02 * n, -0.03 * n, 3.0 + 0.3 * n]))
        for n in range(6)
    ]
    views = draw_views(drawn, PATTERN, poses, noise_px=0.3, seed=3)
    prepared = prepare_observations(found(views))
    with pytest.raises(CalibrationError, match="focal length open"):
        fit_models(prepared, [LensModel("equidistant", 2)], 3)


@pytest.mark.parametrize("half_deg", [25.0, 40.0])
def test_an_ordinary_lens(half_deg: float) -> None:
    lens = Lens("perspective", 500 / math.tan(math.radians(half_deg)), math.radians(half_deg))
    drawn = DrawnCamera(lens, 499.5, 499.5, 1000, 1000)
    poses = spread_poses(drawn, PATTERN, 12, seed=1, span_deg=(15, 25))
    views = draw_views(drawn, PATTERN, poses, noise_px=0.2, seed=3)
    assert "not a fisheye" in refusal(views)


@pytest.mark.parametrize("projection", ["equidistant", "stereographic"])
def test_a_narrow_fisheye_is_still_one(projection: str) -> None:
    drawn = camera(projection, 70.0, size=1000)  # type: ignore[arg-type]
    views = boards(drawn, 12, span_deg=(20.0, 35.0), noise_px=0.2)
    assert len(prepare_observations(found(views)).observations) == 12


def test_a_board_that_contradicts_the_others_is_named() -> None:
    views = boards(camera(size=1000), 12)
    rng = np.random.default_rng(4)
    views[5] = replace(views[5], uv_px=rng.permutation(views[5].uv_px))
    prepared = prepare_observations(found(views))
    assert [r.file for r in prepared.refused] == [views[5].name]
    assert "do not fit the other boards" in prepared.refused[0].reason
    assert len(prepared.observations) == 11


def test_corners_that_are_nothing_but_noise() -> None:
    rng = np.random.default_rng(4)
    views = [
        BoardView(f"{n}", np.arange(48), rng.uniform(0, 1000, (48, 2)), 1000, 1000)
        for n in range(6)
    ]
    refusal(views)


def test_sensor_frames_are_calibrated_in_the_crop() -> None:
    framing = Framing(3840, 2160, 3840, 3500)
    uv = np.array([[170.0 + n, 500.0] for n in range(12)] + [[100.0, 9.0]] * 3)
    view = BoardView("a", np.arange(15), uv, 3840, 2160)
    lost = BoardView("b", np.arange(15), uv * 0 + 20, 3840, 2160)
    out = crop_view(view, framing)
    assert out.name == "a"
    assert (out.width, out.height) == (3500, 3500)
    np.testing.assert_allclose(out.uv_px[0], [0.0, 500 + 670])
    assert len(out) == 12  # what lies outside the crop is not used
    with pytest.raises(BoardRefusedError, match="lies outside the square crop"):
        crop_view(lost, framing)


def test_pictures_of_another_size_are_taken_as_they_are() -> None:
    for view in boards(camera(size=1000), 3):
        assert crop_view(view, Framing(3840, 2160, 3840, 3500)) is view
