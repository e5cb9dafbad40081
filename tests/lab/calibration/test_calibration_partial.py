"""Boards of which a part is hidden: found where their ids can be known, else refused in words."""

from __future__ import annotations

import math
import re

import cv2
import numpy as np
import pytest
from board_render import RenderStyle, draw_picture
from calibration_scenes import refusal_of
from synthetic_boards import BoardPose, DrawnCamera, spread_poses, true_corners

from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern, BoardRefusedError
from bikeped.lab.calibration.capture.images import CalibrationImage
from bikeped.lab.calibration.corners.board_check import DetectedBoard
from bikeped.lab.calibration.corners.board_detector import LEAST_SHARE, detect_board, partial_board
from bikeped.lab.calibration.image_pipeline import detect_boards
from bikeped.lab.calibration.solver.bundle_adjustment import adjust
from bikeped.lab.calibration.solver.lens_model import LensModel
from bikeped.lab.calibration.solver.observations import prepare_observations
from bikeped.types import FloatArray, ImageArray

PATTERN = BoardPattern(8, 6, 0.04)
ODD = BoardPattern(7, 6, 0.04)
CAMERA = DrawnCamera(Lens.from_circle("equidistant", 300, 190), 321.0, 238.0, 640, 480)
POSES = spread_poses(CAMERA, PATTERN, 8, seed=3, span_deg=(45, 65), margin_px=20)


def draw(number: int, hidden: float, pattern: BoardPattern = PATTERN) -> ImageArray:
    style = RenderStyle(occluded=hidden, samples=3)
    return draw_picture(CAMERA, pattern, POSES[number], style=style, seed=number)


def truth(number: int, pattern: BoardPattern = PATTERN) -> FloatArray:
    return true_corners(CAMERA, pattern, POSES[number])[0]


def off_px(board: DetectedBoard, uv: FloatArray) -> FloatArray:
    """[n] by its ids; a board that looks the same turned by half may carry them either way."""
    ways = [np.linalg.norm(board.uv_px - way[board.ids], axis=1) for way in (uv, uv[::-1])]
    return min(ways, key=lambda way: float(way.mean()))


@pytest.mark.parametrize("hidden", [0.1, 0.2, 0.35])
def test_every_id_is_right_and_corners_beside_what_hides_them_too(hidden: float) -> None:
    for number in range(5):
        board = partial_board(draw(number, hidden), PATTERN)
        assert LEAST_SHARE * 48 <= len(board.ids) < 48
        assert (np.diff(board.ids) > 0).all()
        off = off_px(board, truth(number))
        assert math.sqrt(float(np.mean(off**2))) < 0.06
        assert off.max() < 0.3


def test_colours_tell_which_way_round_as_for_whole_boards() -> None:
    """7 + 6 is odd: corner 0 is the same one in every picture, however the board is turned."""
    for number in range(4):
        board = partial_board(draw(number, 0.15, ODD), ODD)
        np.testing.assert_allclose(board.uv_px, truth(number, ODD)[board.ids], atol=0.3)


def test_whole_and_partial_boards_are_counted_alike() -> None:
    for number in range(4):
        whole, part = (
            detect_board(draw(number, 0.0), PATTERN),
            partial_board(draw(number, 0.2), PATTERN),
        )
        _, mine, theirs = np.intersect1d(whole.ids, part.ids, return_indices=True)
        np.testing.assert_allclose(whole.uv_px[mine], part.uv_px[theirs], atol=0.3)


def test_a_board_cut_by_the_picture_s_edge() -> None:
    """Through the last column at a slant: pinned. Before it: told by the margin. Two: unknown."""
    pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 0.3]))
    picture = draw_picture(CAMERA, PATTERN, pose, style=RenderStyle(samples=3))
    uv = true_corners(CAMERA, PATTERN, pose)[0].reshape(6, 8, 2)
    slant = picture.copy()
    start, end = uv[1, 7] + [14.0, -30.0], uv[5, 6] + [14.0, 0.0]
    way = (end - start) * 3
    cut = np.array([start - way, end + way, end + way + [400, 0], start - way + [400, 0]])
    cv2.fillPoly(slant, [np.rint(cut).astype(np.int32)], 0)
    seen = partial_board(slant, PATTERN)
    assert 40 <= len(seen.ids) < 48
    assert off_px(seen, uv.reshape(-1, 2)).max() < 0.3
    between = [round(float((uv[2, k, 0] + uv[2, k + 1, 0]) / 2)) for k in (6, 5)]
    one = partial_board(np.ascontiguousarray(picture[:, : between[0]]), PATTERN)
    assert len(one.ids) >= 38
    assert off_px(one, uv.reshape(-1, 2)).max() < 0.3
    two = refusal_of(partial_board, np.ascontiguousarray(picture[:, : between[1]]), PATTERN)
    assert two.startswith("6 of 8 columns of the 8x6 board are in sight")


@pytest.fixture
def no_whole_board(monkeypatch: pytest.MonkeyPatch) -> None:
    """The detectors of whole boards find nothing, at once instead of after seconds."""
    for name in ("raw_candidates", "remapped_candidates"):
        monkeypatch.setattr(
            f"bikeped.lab.calibration.corners.board_detector.{name}", lambda grey, pattern: iter(())
        )


@pytest.mark.usefixtures("no_whole_board")
def test_the_picture_is_used_and_the_reason_is_passed_on() -> None:
    seen = detect_board(draw(0, 0.35), PATTERN)
    assert len(seen.ids) < 48
    reason = refusal_of(detect_board, draw(0, 0.2), BoardPattern(7, 5))
    assert reason.startswith("no whole 7x5 board found: the board has more inner corners than")
    empty = refusal_of(detect_board, np.full((480, 640), 90, np.uint8), PATTERN)
    assert empty == "no whole 8x6 board found"


def test_a_live_frame_has_no_time_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[BoardPattern] = []

    def asked(grey: ImageArray, pattern: BoardPattern) -> str:
        called.append(pattern)
        return "asked"

    monkeypatch.setattr("bikeped.lab.calibration.corners.board_detector.partial_board", asked)
    with pytest.raises(BoardRefusedError):
        detect_board(draw(0, 0.35), PATTERN, thorough=False)
    assert not called


@pytest.mark.parametrize("asked", [BoardPattern(8, 6), BoardPattern(9, 5), BoardPattern(10, 8)])
def test_another_board_than_the_one_that_was_asked_for_is_refused(asked: BoardPattern) -> None:
    drawn = BoardPattern(9, 7, 0.035)
    for number in range(3):
        answer = refusal_of(partial_board, draw(number, 0.1 * number, drawn), asked)
        assert "more inner corners than" in answer or "9 of 10 columns" in answer


def test_a_few_corners_are_too_few() -> None:
    """Stickers on all but the outer lines, and on some of these: too little is left."""
    picture = draw(1, 0.0)
    uv = truth(1).reshape(6, 8, 2)
    spots = [(row, column) for row in range(1, 5) for column in range(1, 7)]
    for row, column in [*spots, (0, 3), (0, 4), (5, 4)]:
        u, v = np.rint(uv[row, column]).astype(int)
        cv2.circle(picture, (int(u), int(v)), 6, 110, -1)
    answer = refusal_of(partial_board, picture, PATTERN)
    assert re.fullmatch(r"only (1\d|2[01]) of 48 corners can be seen clearly, not 24", answer)


@pytest.mark.usefixtures("no_whole_board")
def test_a_board_that_lacks_a_line_needs_another_picture_that_shows_them_all() -> None:
    """It may be a smaller board, cut: 7x6 when 8x6 was asked for."""
    pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 0.3]))
    uv = true_corners(CAMERA, PATTERN, pose)[0].reshape(6, 8, 2)
    cut = draw_picture(CAMERA, PATTERN, pose, style=RenderStyle(samples=3))
    cut[:, round(float((uv[2, 6, 0] + uv[2, 7, 0]) / 2)) :] = 0
    pictures = [
        CalibrationImage(f"{number}.png", 640, 480, f"{number:064x}", grey)
        for number, grey in enumerate([cut, draw(0, 0.2)])
    ]
    alone = detect_boards(pictures[:1], PATTERN, workers=1)
    assert not alone.views
    assert "no other picture shows all of them" in alone.refused[0].reason
    both = detect_boards(pictures, PATTERN, workers=1)
    assert [view.name for view in both.views] == ["0.png", "1.png"]


@pytest.mark.usefixtures("no_whole_board")
def test_the_lens_comes_out_as_from_whole_boards() -> None:
    found = detect_boards(
        [
            CalibrationImage(f"{number}.png", 640, 480, f"{number:064x}", draw(number, 0.1))
            for number in range(4)
        ],
        PATTERN,
        workers=1,
    )
    assert len(found.views) == 4
    assert sum(len(view) for view in found.views) < 4 * 48
    prepared = prepare_observations(found)
    assert not prepared.outliers
    fitted = adjust(prepared.observations, LensModel("equidistant"), prepared.start)
    assert fitted.sigma_px < 0.05
    assert fitted.state.lens[2] == pytest.approx(CAMERA.lens.focal_px, rel=1e-3)
    np.testing.assert_allclose(fitted.state.lens[:2], [CAMERA.cx, CAMERA.cy], atol=0.15)
