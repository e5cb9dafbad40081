"""Grids grown from crossings: round what hides the board, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from board_render import RenderStyle, draw_picture
from synthetic_boards import DrawnCamera, spread_poses, true_corners

from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.corners.grid_growing import find_grids
from bikeped.types import ImageArray

PATTERN = BoardPattern(8, 6, 0.04)
CAMERA = DrawnCamera(Lens.from_circle("equidistant", 300, 190), 321.0, 238.0, 640, 480)
POSES = spread_poses(CAMERA, PATTERN, 3, seed=3, span_deg=(45, 65), margin_px=25)


def bricks(rng: np.random.Generator) -> ImageArray:
    """Courses of bricks of several greys with light joints."""
    out = np.full((480, 640), 200.0)
    for course in range(24):
        for brick in range(-1, 17):
            left = brick * 40 + (course % 2) * 20
            out[course * 20 + 2 : course * 20 + 20, max(left + 2, 0) : max(left + 40, 0)] = (
                rng.uniform(50, 140)
            )
    return noisy(out, rng)


def windows(rng: np.random.Generator) -> ImageArray:
    """Dark panes in a light wall, at regular places."""
    out = np.full((480, 640), 180.0)
    for row in range(10, 470, 40):
        for column in range(10, 630, 34):
            out[row : row + 26, column : column + 18] = rng.uniform(20, 90)
    return noisy(out, rng)


def tiles(rng: np.random.Generator) -> ImageArray:
    """Square tiles of random greys: crossings everywhere, colours that never keep step."""
    return noisy(np.kron(rng.uniform(30, 220, (24, 32)), np.ones((20, 20))), rng)


def leaves(rng: np.random.Generator) -> ImageArray:
    return noisy(cv2.GaussianBlur(rng.normal(120, 500, (480, 640)), (0, 0), 2.5), rng)


def noisy(picture: np.ndarray, rng: np.random.Generator) -> ImageArray:
    out = cv2.GaussianBlur(np.asarray(picture, np.float32), (0, 0), 0.7)
    return np.asarray(np.clip(out + rng.normal(0, 3, out.shape), 0, 255), np.uint8)


@pytest.mark.parametrize("number", range(3))
def test_a_grid_goes_round_what_hides_the_board(number: int) -> None:
    style = RenderStyle(occluded=0.2, samples=3)
    picture = draw_picture(CAMERA, PATTERN, POSES[number], style=style, seed=number)
    grid = find_grids(picture)[0]
    truth, _ = true_corners(CAMERA, PATTERN, POSES[number])
    off = np.linalg.norm(grid.uv_px[:, None] - truth, axis=-1)
    nearest = off.argmin(1)
    right = off.min(1) < 1.0
    assert right.sum() >= 38
    # One step of the grid is one step of the board, one way or the other, for every corner.
    place = np.stack([nearest % 8, nearest // 8], axis=-1)[right]
    cell = grid.cell[right]
    steps = np.linalg.lstsq(np.column_stack([cell, np.ones(len(cell))]), place, rcond=None)[0]
    np.testing.assert_allclose(steps[:2], np.rint(steps[:2]), atol=1e-9)
    assert round(float(np.linalg.det(steps[:2]))) == 1  # turned, not mirrored
    np.testing.assert_allclose(cell @ steps[:2] + steps[2], place, atol=1e-9)


def test_a_finger_across_the_board_is_stepped_over() -> None:
    squares = np.indices((7, 9)).sum(0) % 2 * 170 + 40.0
    picture = np.pad(np.kron(squares, np.ones((24, 24))), 40, constant_values=210)
    picture[:, 40 + 24 * 3 + 14 : 40 + 24 * 5 - 14] = 120  # all of the fourth column
    grid = find_grids(noisy(picture, np.random.default_rng(1)))[0]
    assert len(grid) == 42
    assert sorted(np.ptp(grid.cell, axis=0) + 1) == [6, 8]


def test_two_boards_are_two_grids() -> None:
    squares = np.indices((7, 9)).sum(0) % 2 * 170 + 40.0
    one = np.pad(np.kron(squares, np.ones((20, 20))), 30, constant_values=210)
    both = noisy(
        np.concatenate([one, np.full((200, 40), 120.0), one], axis=1), np.random.default_rng(1)
    )
    found = find_grids(both)
    assert [len(grid) for grid in found] == [48, 48]
    assert not set(map(tuple, found[0].uv_px)) & set(map(tuple, found[1].uv_px))


@pytest.mark.parametrize("draw", [bricks, windows, tiles, leaves])
def test_busy_pictures_give_no_grid_of_a_board_s_size(draw: object) -> None:
    assert callable(draw)
    for seed in range(2):
        for grid in find_grids(draw(np.random.default_rng(seed))):
            assert len(grid) < PATTERN.count / 3
