"""Remapped views: corners found in them come back to the pixels that they were taken from."""

from __future__ import annotations

import math

import numpy as np
import pytest
from board_render import draw_picture
from synthetic_boards import BoardPose, DrawnCamera, true_corners

from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.corners import candidates
from bikeped.lab.calibration.corners.board_detector import detect_board
from bikeped.lab.calibration.corners.candidates import (
    VIEWS,
    ViewDirection,
    at_scale,
    remapped_candidates,
    view_pixels,
)
from bikeped.types import FloatArray, ImageArray

PATTERN = BoardPattern(8, 6, 0.04)
LENS = Lens.from_circle("equidistant", 320, 190)
CAMERA = DrawnCamera(LENS, 319.5, 239.5, 640, 480)


@pytest.mark.parametrize("view", [VIEWS[0], VIEWS[2], VIEWS[3], VIEWS[-1]])
def test_the_middle_of_a_view_is_where_it_looks(view: ViewDirection) -> None:
    at = view_pixels(view, 640, 480)
    middle = at[399:401, 399:401].mean((0, 1)) - [319.5, 239.5]
    theta = math.radians(view.polar_deg)
    about = math.radians(view.azimuth_deg)
    expected = float(LENS.radius(theta)) * np.array([math.cos(about), math.sin(about)])
    np.testing.assert_allclose(middle, expected, atol=1.0)


def test_a_perspective_view_keeps_straight_lines_straight() -> None:
    """Three corners of one row of a board: in the view they lie on a line, in the picture not."""
    at = view_pixels(ViewDirection(0, 0, 110), 640, 480)
    row = at[100].astype(np.float64)
    rays = CAMERA.rays(row[::80])
    plane = np.linalg.svd(rays)[2][-1]
    assert np.abs(rays @ plane).max() < 1e-3
    assert np.ptp(row[:, 1]) > 20


def test_boards_are_found_when_the_picture_itself_gives_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "bikeped.lab.calibration.corners.board_detector.raw_candidates",
        lambda grey, pattern: iter(()),
    )
    for pose in (
        BoardPose(np.eye(3), np.array([0.0, 0.0, 0.13])),  # close: it fills the view
        BoardPose(np.eye(3), np.array([0.2, -0.1, 0.3])),
    ):
        seen = detect_board(draw_picture(CAMERA, PATTERN, pose), PATTERN)
        truth, _ = true_corners(CAMERA, PATTERN, pose)
        np.testing.assert_allclose(seen.uv_px, truth[seen.ids], atol=0.2)


def test_the_views_are_tried_only_as_far_as_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def third(grey: ImageArray, pattern: BoardPattern) -> FloatArray | None:
        tried.append(grey.shape[0])
        return np.full((48, 2), 399.5) if len(tried) == 3 else None

    monkeypatch.setattr(candidates, "classic", third)
    grey = np.zeros((480, 640), np.uint8)
    first = next(remapped_candidates(grey, PATTERN))
    np.testing.assert_allclose(first, np.full((48, 2), [319.5, 239.5]), atol=0.01)
    assert len(tried) == 3


def test_a_scaled_search_answers_in_pixels_of_the_picture() -> None:
    def corner_of_white(grey: ImageArray, pattern: BoardPattern) -> FloatArray:
        rows, columns = np.nonzero(grey > 127)
        return np.array([[columns.min() - 0.5, rows.min() - 0.5]])

    picture = np.zeros((200, 320), np.uint8)
    picture[80:, 120:] = 255
    for scale in (0.25, 0.5, 1.0, 2.0):
        found = next(at_scale(corner_of_white, picture, PATTERN, scale))
        np.testing.assert_allclose(found, [[119.5, 79.5]], atol=0.01)
