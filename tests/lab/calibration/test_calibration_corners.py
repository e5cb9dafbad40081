"""Corners in drawn pictures with known truth: found, where they are, and who is refused why."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_render import RenderStyle, draw_picture
from calibration_scenes import refusal_of
from synthetic_boards import BoardPose, DrawnCamera, spread_poses, true_corners, turn

from bikeped.errors import CalibrationError
from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.capture.images import CalibrationImage, load_images
from bikeped.lab.calibration.corners.board_detector import detect_board
from bikeped.lab.calibration.corners.corner_refinement import refine_corners
from bikeped.lab.calibration.image_pipeline import detect_boards
from bikeped.types import FloatArray, ImageArray

PATTERN = BoardPattern(8, 6, 0.04)
ODD = BoardPattern(7, 6, 0.04)


def camera(width: int = 640, height: int = 480, radius_px: float = 300.0) -> DrawnCamera:
    lens = Lens.from_circle("equidistant", radius_px, 190)
    return DrawnCamera(lens, width / 2 + 3.3, height / 2 - 2.7, width, height)


def poses(
    count: int, span_deg: tuple[float, float], pattern: BoardPattern = PATTERN
) -> list[BoardPose]:
    return spread_poses(camera(), pattern, count, seed=3, span_deg=span_deg, margin_px=25)


def as_pictures(drawn: list[ImageArray], names: str = "abcdefgh") -> list[CalibrationImage]:
    return [
        CalibrationImage(f"{name}.png", one.shape[1], one.shape[0], f"{number:064x}", one)
        for number, (name, one) in enumerate(zip(names, drawn, strict=False))
    ]


def off_px(uv: FloatArray, truth: FloatArray) -> FloatArray:
    """[n] distances; a board that looks the same turned by half may carry its ids either way."""
    ways = [np.linalg.norm(uv - way, axis=1) for way in (truth, truth[::-1])]
    return min(ways, key=lambda way: float(way.mean()))


@pytest.mark.parametrize(
    ("span_deg", "most_px"), [((14, 20), 0.025), ((22, 40), 0.02), ((70, 95), 0.03)]
)
def test_corners_are_within_hundredths_of_a_pixel(
    span_deg: tuple[float, float], most_px: float
) -> None:
    """From squares of 5 px to squares of 60."""
    errors = []
    for number, pose in enumerate(poses(4, span_deg)):
        picture = draw_picture(
            camera(),
            PATTERN,
            pose,
            style=RenderStyle(noise=0.5, samples=6, blur_px=0.6),
            seed=number,
        )
        seen = detect_board(picture, PATTERN)
        truth, _ = true_corners(camera(), PATTERN, pose)
        assert len(seen.ids) == 48
        errors.append(off_px(seen.uv_px, truth))
    error = np.concatenate(errors)
    assert math.sqrt(float(np.mean(error**2))) < most_px
    assert error.max() < 0.12


def test_bent_edges_are_followed_where_the_gradient_method_is_not_good_enough() -> None:
    """A board that fills the view: cv2.cornerSubPix, with a window that suits it, and `refine`."""
    rng = np.random.default_rng(2)
    wide = camera(1032, 778, 560)
    seen = np.stack([np.arange(48) % 8, np.arange(48) // 8], axis=1).astype(np.float64)
    stop = (3, 60, 0.001)
    theirs, ours = [], []
    for pose in spread_poses(wide, PATTERN, 3, seed=3, span_deg=(70, 100), margin_px=8):
        picture = draw_picture(wide, PATTERN, pose, style=RenderStyle(noise=0.5, samples=6))
        truth, _ = true_corners(wide, PATTERN, pose)
        start = truth + rng.normal(0, 0.4, truth.shape)
        gradient = cv2.cornerSubPix(
            picture, start.astype(np.float32).reshape(-1, 1, 2), (5, 5), (-1, -1), stop
        )
        # At the very rim half of a corner is missing: nobody can refine that.
        whole = np.linalg.norm(truth - [wide.cx, wide.cy], axis=1) < 550
        theirs.append(np.linalg.norm(np.asarray(gradient).reshape(-1, 2) - truth, axis=1)[whole])
        ours.append(
            np.linalg.norm(refine_corners(picture, seen, start).uv_px - truth, axis=1)[whole]
        )
    rms = [math.sqrt(float(np.mean(np.concatenate(e) ** 2))) for e in (theirs, ours)]
    assert rms[1] < 0.02
    assert rms[1] < 0.5 * rms[0]


def test_every_id_is_a_place_on_the_board_and_colours_tell_which_way_round() -> None:
    """7 + 6 is odd: turned by half, the colours change, so ids mean the same in every picture."""
    drawn, truth = [], []
    for number, pose in enumerate(poses(3, (40, 60), ODD)):
        for roll in (0.0, 2.0, math.pi):
            turned = BoardPose(pose.rotation @ turn([0, 0, roll]), pose.translation_m)
            drawn.append(draw_picture(camera(), ODD, turned, seed=number))
            truth.append(true_corners(camera(), ODD, turned)[0])
    found = detect_boards(as_pictures(drawn, "abcdefghi"), ODD)
    assert [view.name for view in found.views] == [f"{name}.png" for name in "abcdefghi"]
    for view, uv in zip(found.views, truth, strict=True):
        np.testing.assert_allclose(view.uv_px, uv[view.ids], atol=0.3)


def test_a_symmetric_board_keeps_its_ids_while_it_is_turned_by_less_than_a_right_angle() -> None:
    pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 0.3]))
    for roll_deg in (-80, -30, 30, 80):
        turned = BoardPose(turn([0, 0, math.radians(roll_deg)]), pose.translation_m)
        seen = detect_board(draw_picture(camera(), PATTERN, turned), PATTERN)
        truth, _ = true_corners(camera(), PATTERN, turned)
        np.testing.assert_allclose(seen.uv_px, truth[seen.ids], atol=0.3)


def test_the_same_picture_is_named_and_used_once() -> None:
    first, second = (
        draw_picture(camera(), PATTERN, pose, seed=number)
        for number, pose in enumerate(poses(2, (40, 60)))
    )
    again = cv2.imdecode(cv2.imencode(".jpg", first)[1], cv2.IMREAD_GRAYSCALE)  # not its bytes
    pictures = as_pictures([first, second, np.asarray(again, np.uint8), second])
    pictures[3] = dataclasses.replace(pictures[3], digest=pictures[1].digest)
    found = detect_boards(pictures, PATTERN)
    assert [view.name for view in found.views] == ["a.png", "b.png"]
    assert {one.file: one.reason for one in found.refused} == {
        "c.png": "same picture as a.png",
        "d.png": "same picture as b.png",
    }
    assert found.images == 4


def test_a_blurred_picture_is_refused_with_what_to_do() -> None:
    drawn = [
        draw_picture(camera(), PATTERN, pose, seed=number)
        for number, pose in enumerate(poses(4, (60, 80)))
    ]
    drawn[2] = np.asarray(cv2.GaussianBlur(drawn[2], (0, 0), 3.5), np.uint8)
    found = detect_boards(as_pictures(drawn), PATTERN)
    assert len(found.views) == 3
    assert found.refused[0].file == "c.png"
    assert "blurred" in found.refused[0].reason
    assert "held still" in found.refused[0].reason


def test_a_corner_that_the_detector_misplaced_is_put_right(monkeypatch: pytest.MonkeyPatch) -> None:
    pose = poses(3, (60, 80))[1]
    picture = draw_picture(camera(), PATTERN, pose)
    truth, _ = true_corners(camera(), PATTERN, pose)
    claimed = truth.copy()
    claimed[[9, 20]] += [[14.0, -9.0], [-10.0, 10.0]]
    monkeypatch.setattr(
        "bikeped.lab.calibration.corners.board_detector.raw_candidates",
        lambda grey, pattern: iter([claimed]),
    )
    seen = detect_board(picture, PATTERN)
    assert off_px(seen.uv_px, truth).max() < 0.15


def test_a_corner_that_cannot_be_seen_is_left_out() -> None:
    """Under a sticker: the board stays, the corner goes, and no other is moved by it."""
    pose = poses(3, (60, 80))[0]
    picture = draw_picture(camera(), PATTERN, pose)
    truth, _ = true_corners(camera(), PATTERN, pose)
    hidden = int(np.argmin(np.abs(truth - truth.mean(0)).sum(1)))
    u, v = truth[hidden]
    cv2.circle(picture, (round(float(u)), round(float(v))), 9, 130, -1)
    from bikeped.lab.calibration.corners.board_check import check_board

    checked = check_board(picture, PATTERN, truth)
    gone = set(range(48)) - set(checked.ids.tolist())
    assert len(gone) == 1
    spots = {hidden, 47 - hidden}  # ids may run either way
    assert gone <= spots


def test_random_corners_make_no_board() -> None:
    rng = np.random.default_rng(4)
    picture = rng.integers(0, 255, (480, 640)).astype(np.uint8)
    from bikeped.lab.calibration.corners.board_check import check_board

    noise = rng.uniform(50, 400, (48, 2))
    assert refusal_of(check_board, picture, PATTERN, noise) == "its corners make no regular board"
    grid = np.stack([*np.meshgrid(np.arange(8) * 30.0 + 50, np.arange(6) * 30.0 + 50)], -1)
    assert "of 48 corners can be seen clearly" in refusal_of(
        check_board, picture, PATTERN, grid.reshape(-1, 2)
    )


def test_a_smaller_pattern_than_the_board_is_refused() -> None:
    pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 0.3]))
    picture = draw_picture(camera(), PATTERN, pose)
    truth = true_corners(camera(), PATTERN, pose)[0].reshape(6, 8, 2)
    from bikeped.lab.calibration.corners.board_check import check_board

    for part, pattern in ((truth[:, :7], BoardPattern(7, 6)), (truth[1:, 1:], BoardPattern(7, 5))):
        reason = refusal_of(check_board, picture, pattern, part.reshape(-1, 2))
        assert "more inner corners" in reason


def test_no_board_and_a_pattern_that_is_none() -> None:
    empty = as_pictures([np.full((120, 160), 128, np.uint8)])
    found = detect_boards(empty, PATTERN)
    assert not found.views
    assert found.refused[0].reason == "no whole 8x6 board found"
    with pytest.raises(CalibrationError, match="at least 3x3"):
        detect_boards(empty, BoardPattern(2, 6))
    with pytest.raises(CalibrationError, match="no picture"):
        detect_boards([], PATTERN)


def test_progress_counts_every_picture_and_paths_are_read(tmp_path: Path) -> None:
    for number, pose in enumerate(poses(2, (40, 60))):
        cv2.imwrite(str(tmp_path / f"{number}.png"), draw_picture(camera(), PATTERN, pose))
    told: list[int] = []
    found = detect_boards(load_images([tmp_path]), PATTERN, progress=told.append, workers=2)
    assert sorted(told) == [1, 2]
    assert [Path(view.name).name for view in found.views] == ["0.png", "1.png"]
    pictures = load_images([tmp_path])
    assert found.images_hash == detect_boards(pictures[::-1], PATTERN).images_hash
