"""Drawn corners: exact, all round the circle, with the noise that was asked for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from board_render import RenderStyle, draw_picture
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_boards import (
    BoardBend,
    BoardPose,
    DrawnCamera,
    draw_views,
    spread_poses,
    true_corners,
    turn,
)

from bikeped.errors import GeometryError
from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.corners.corner_refinement import refine_corners

PATTERN = BoardPattern(8, 6, 0.04)


def wide_camera(projection: str = "equidistant", half_deg: float = 100.0) -> DrawnCamera:
    lens = Lens.from_circle(projection, 1740.0, 2 * half_deg)
    return DrawnCamera(lens, 1752.7, 1748.5, 3500, 3500)


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(["equidistant", "equisolid", "stereographic"]),
    st.floats(85.0, 110.0),
    st.floats(-1, 1),
    st.floats(-1, 1),
)
def test_rays_undo_projection_up_to_the_rim(
    projection: str, half_deg: float, u: float, v: float
) -> None:
    camera = wide_camera(projection, half_deg)
    uv = np.array([[camera.cx + u * 1200, camera.cy + v * 1200]])
    again, seen = camera.project(3.0 * camera.rays(uv))
    assert seen.all()
    np.testing.assert_allclose(again, uv, atol=1e-7)


def test_poses_cover_the_circle_and_reach_the_rim() -> None:
    for half_deg in (85.0, 100.0, 110.0):
        camera = wide_camera(half_deg=half_deg)
        views = draw_views(camera, PATTERN, spread_poses(camera, PATTERN, 42, seed=1))
        assert [len(v) for v in views] == [48] * 42
        uv = np.concatenate([v.uv_px for v in views]) - [camera.cx, camera.cy]
        theta = np.degrees(camera.lens.theta(np.hypot(*uv.T)))
        assert theta.max() > half_deg - 2
        sector = np.floor(np.degrees(np.arctan2(uv[:, 1], uv[:, 0])) / 45).astype(int) % 8
        for number in range(8):
            outer = theta[sector == number]
            assert outer.max() > 0.9 * half_deg
            assert outer.min() < 0.35 * half_deg


def test_noise_and_outliers_are_as_asked() -> None:
    camera = wide_camera()
    poses = spread_poses(camera, PATTERN, 42)
    clean = np.stack([v.uv_px for v in draw_views(camera, PATTERN, poses)])
    noisy = np.stack([v.uv_px for v in draw_views(camera, PATTERN, poses, noise_px=0.3)])
    assert np.std(noisy - clean) == pytest.approx(0.3, rel=0.05)
    thrown = np.stack(
        [v.uv_px for v in draw_views(camera, PATTERN, poses, outlier_share=0.2, outlier_px=20)]
    )
    far = np.linalg.norm(thrown - clean, axis=-1)
    assert np.mean(far > 0) == pytest.approx(0.2, abs=0.02)
    assert far[far > 0].min() >= 20 - 1e-6
    assert far.max() <= 100 + 1e-6


def test_a_bend_moves_edges_and_leaves_the_middle() -> None:
    bend = BoardBend(along_columns=0.01)
    xy = np.array([[0.0, 0.0], [3.5 * 0.04, 0.0], [-3.5 * 0.04, 0.1]])
    np.testing.assert_allclose(bend.depth_m(PATTERN, xy), [0, 0.0004, 0.0004], atol=1e-12)
    camera = wide_camera()
    pose = spread_poses(camera, PATTERN, 6)[3]
    shift = true_corners(camera, PATTERN, pose, bend)[0] - true_corners(camera, PATTERN, pose)[0]
    middle = np.linalg.norm(shift.reshape(6, 8, 2)[:, 3:5], axis=-1).max()
    assert middle < 0.2 * np.linalg.norm(shift, axis=-1).max()


def test_the_back_of_a_board_has_no_corners() -> None:
    camera = wide_camera()
    pose = spread_poses(camera, PATTERN, 3)[0]
    back = type(pose)(pose.rotation @ turn([math.pi, 0, 0]), pose.translation_m)
    assert not true_corners(camera, PATTERN, back)[1].any()
    assert len(draw_views(camera, PATTERN, [back])[0]) == 0


def test_a_span_wider_than_the_lens_is_refused() -> None:
    camera = DrawnCamera(Lens.from_circle("equidistant", 400, 60), 400, 400, 801, 801)
    with pytest.raises(GeometryError, match="has no place"):
        spread_poses(camera, PATTERN, 3, span_deg=(100, 120))


def test_a_drawn_picture_shows_what_the_corners_say() -> None:
    """Between the corners lie the squares, dark and light in turn; beyond the circle, nothing."""
    camera = DrawnCamera(Lens.from_circle("equidistant", 300, 200), 303.0, 297.0, 600, 600)
    for number, pose in enumerate(spread_poses(camera, PATTERN, 4, margin_px=8)):
        picture = draw_picture(
            camera, PATTERN, pose, style=RenderStyle(noise=0, shade=0, blur_px=0.4)
        )
        corners = true_corners(camera, PATTERN, pose)[0].reshape(6, 8, 2)
        middle = (corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:] + corners[1:, 1:]) / 4
        at = np.rint(middle).astype(int)
        level = picture[at[..., 1], at[..., 0]]
        dark = (np.arange(5)[:, None] + np.arange(7)) % 2 == 0
        assert level[dark].max() < 80 < 160 < level[~dark].min(), number
        assert picture[2, 2] == 0  # outside the image circle


def test_a_drawn_pixel_on_an_edge_is_the_share_of_either_side() -> None:
    """Face on in an almost straight lens, an edge that cuts pixels at 0.3: 0.3 dark, 0.7 light."""
    camera = DrawnCamera(Lens.from_circle("equidistant", 4000, 20), 100.0, 100.0, 201, 201)
    plain = RenderStyle(black=0, white=200, noise=0, blur_px=0, shade=0, samples=20)
    # 100 px a square: the corner's edge u = 100 + 0.8 cuts pixel 101 (100.5 to 101.5) at 0.3.
    focal = camera.lens.focal_px
    square = 100 / focal
    pattern = BoardPattern(3, 3, square)
    pose = BoardPose(np.eye(3), np.array([0.8 / focal, 0.0, 1.0]))
    picture = draw_picture(camera, pattern, pose, style=plain)
    assert picture[150, 95] == picture[150, 100]
    sides = float(picture[150, 95]), float(picture[150, 106])
    assert sorted(sides) == [0, 200]
    assert picture[150, 101] == pytest.approx(0.3 * sides[0] + 0.7 * sides[1], abs=11)


def test_noise_blur_occlusion_and_shade_do_what_they_say() -> None:
    camera = DrawnCamera(Lens.from_circle("equidistant", 300, 200), 299.5, 299.5, 600, 600)
    pose = BoardPose(np.eye(3), np.array([0.0, 0.0, 0.3]))
    clean = draw_picture(camera, PATTERN, pose, style=RenderStyle(noise=0, shade=0)).astype(float)
    noisy = draw_picture(camera, PATTERN, pose, style=RenderStyle(noise=4, shade=0)).astype(float)
    middle = (slice(250, 350), slice(250, 350))
    assert np.std((noisy - clean)[middle]) == pytest.approx(4, rel=0.05)
    soft = draw_picture(
        camera, PATTERN, pose, style=RenderStyle(noise=0, shade=0, blur_px=3)
    ).astype(float)
    assert np.abs(np.diff(soft[middle])).max() < 0.4 * np.abs(np.diff(clean[middle])).max()
    hidden = draw_picture(camera, PATTERN, pose, style=RenderStyle(noise=0, shade=0, occluded=0.4))
    share = np.mean(np.abs(hidden.astype(float) - clean) > 50)
    assert 0.005 < share < 0.2
    shaded = draw_picture(camera, PATTERN, pose, style=RenderStyle(noise=0, shade=0.5))
    rim = int(299.5 + 0.95 * camera.lens.max_radius_px)
    assert shaded[300, rim] < 0.65 * clean[300, rim]


def test_a_bend_is_drawn_where_the_corners_say() -> None:
    camera = DrawnCamera(Lens.from_circle("equidistant", 300, 200), 299.5, 299.5, 600, 600)
    bend = BoardBend(along_columns=0.5, along_rows=-0.3, twist=0.2)
    pose = BoardPose(turn([0.3, -0.5, 0.2]), np.array([0.05, 0.0, 0.25]))
    picture = draw_picture(camera, PATTERN, pose, style=RenderStyle(noise=0, samples=6), bend=bend)
    truth, _ = true_corners(camera, PATTERN, pose, bend)
    flat, _ = true_corners(camera, PATTERN, pose)
    seen = np.stack([np.arange(48) % 8, np.arange(48) // 8], axis=1).astype(np.float64)
    refined = refine_corners(picture, seen, truth).uv_px
    assert np.linalg.norm(refined - truth, axis=1).max() < 0.12
    assert np.linalg.norm(refined - flat, axis=1).max() > 2
