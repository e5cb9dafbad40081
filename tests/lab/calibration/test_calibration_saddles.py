"""Crossings by themselves: where they are, which way their edges run, and who neighbours whom."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bikeped.lab.calibration.corners.grid_growing import find_saddle_points, link_neighbours
from bikeped.types import FloatArray, ImageArray


def crossing_score(angle_deg: float, between_deg: float, at: tuple[float, float]) -> ImageArray:
    """One crossing in the middle of nothing: dark, light, dark, light round it."""
    v, u = np.mgrid[:80, :80].astype(np.float64)
    sides = [
        (v - at[1]) * np.cos(turn) - (u - at[0]) * np.sin(turn)
        for turn in np.radians([angle_deg, angle_deg + between_deg])
    ]
    smooth = np.prod([np.clip(side, -0.5, 0.5) * 2 for side in sides], axis=0)
    return np.asarray(np.rint(125 + 90 * cv2.GaussianBlur(smooth, (0, 0), 0.7)), np.uint8)


def board(columns: int, rows: int, side: int) -> ImageArray:
    """Squares of `side` pixels, the first one dark, with a light margin of a square."""
    squares = np.indices((rows + 1, columns + 1)).sum(0) % 2 * 180 + 40
    return np.pad(np.kron(squares, np.ones((side, side))), side, constant_values=220).astype(
        np.uint8
    )


def angle_to(edge: FloatArray, angle_deg: float) -> float:
    """Degrees between a line and a direction."""
    way = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    return float(np.degrees(np.arccos(min(1.0, abs(float(edge @ way))))))


@pytest.mark.parametrize(("angle_deg", "between_deg"), [(0, 90), (31, 90), (-50, 60), (110, 130)])
def test_a_crossing_is_found_with_its_edges(angle_deg: float, between_deg: float) -> None:
    found = find_saddle_points(crossing_score(angle_deg, between_deg, (40.3, 38.6)))
    first = int(found.contrast.argmax())
    np.testing.assert_allclose(found.uv_px[first], [40.3, 38.6], atol=0.12)
    edges = (angle_deg, angle_deg + between_deg)
    most = abs(90 - between_deg) / 2 + 3  # smoothing makes a right angle of any
    for edge in found.edge[first]:
        assert min(angle_to(edge, angle) for angle in edges) < most


def test_light_lies_to_the_left_of_edges_of_the_first_type_whichever_way_one_looks() -> None:
    picture = crossing_score(20, 80, (40, 40)).astype(np.float64)
    found = find_saddle_points(picture.astype(np.uint8))
    first = int(found.contrast.argmax())
    for kind in (0, 1):
        for way in (found.edge[first, kind], -found.edge[first, kind]):
            left = np.array([way[1], -way[0]])
            on = found.uv_px[first] + 12 * way
            u, v = np.rint([on + 3 * left, on - 3 * left]).astype(int).T
            assert (picture[v[0], u[0]] > picture[v[1], u[1]]) == (kind == 0)


def test_neighbours_on_a_board_find_each_other_and_nobody_else() -> None:
    picture = cv2.GaussianBlur(board(5, 4, 14), (0, 0), 0.7)
    found = find_saddle_points(np.asarray(picture, np.uint8))
    place = np.rint((found.uv_px + 0.5) / 14 - 2).astype(int)
    inner = (place >= 0).all(1) & (place < [5, 4]).all(1) & (found.contrast > 90)
    assert int(inner.sum()) == 20
    link = link_neighbours(np.asarray(picture, np.uint8), found)
    for one in np.flatnonzero(inner):
        near = {tuple(place[other]) for other in link[one].ravel() if other >= 0 and inner[other]}
        c, r = place[one]
        around = {(c + 1, r), (c - 1, r), (c, r + 1), (c, r - 1)}
        assert near == {(x, y) for x, y in around if 0 <= x < 5 and 0 <= y < 4}


def test_a_plain_picture_has_no_crossing() -> None:
    for picture in (np.full((60, 80), 90), np.tile(np.arange(80), (60, 1))):
        grey = picture.astype(np.uint8)
        found = find_saddle_points(grey)
        assert len(found) == 0
        assert link_neighbours(grey, found).shape == (0, 2, 2)
