"""Drawn sets of boards that several tests of the calibration share."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest
from synthetic_boards import BoardBend, DrawnCamera, draw_views, spread_poses

from bikeped.geometry.lens import Lens, Projection
from bikeped.lab.calibration.board_view import (
    BoardPattern,
    BoardRefusedError,
    BoardView,
    DetectedBoards,
    RefusedImage,
)

PATTERN = BoardPattern(8, 6, 0.1)
FLAT = BoardBend()


def camera(
    projection: Projection = "equidistant",
    half_deg: float = 100.0,
    k: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    size: int = 3500,
) -> DrawnCamera:
    """A lens whose circle fills the picture, its centre as far off as the paper's."""
    unit = Lens(projection, 1.0, math.radians(half_deg), k).max_radius_px
    lens = Lens(projection, size / 2 / unit, math.radians(half_deg), k)
    return DrawnCamera(lens, size / 2 + 2.7, size / 2 + 54.5, size, size)


def boards(
    drawn: DrawnCamera,
    count: int = 42,
    *,
    noise_px: float = 0.3,
    seed: int = 0,
    outlier_share: float = 0.0,
    bend: BoardBend = FLAT,
    span_deg: tuple[float, float] = (30.0, 70.0),
) -> list[BoardView]:
    """`count` boards that cover the circle; `seed` draws the noise, not the poses."""
    poses = spread_poses(drawn, PATTERN, count, seed=1, span_deg=span_deg)
    return draw_views(
        drawn, PATTERN, poses, noise_px=noise_px, outlier_share=outlier_share, bend=bend, seed=seed
    )


def refusal_of(detect: Callable[..., object], *arguments: object) -> str:
    """The reason for which a detector refuses an image."""
    with pytest.raises(BoardRefusedError) as caught:
        detect(*arguments)
    return str(caught.value)


def found(views: Sequence[BoardView], refused: Sequence[RefusedImage] = ()) -> DetectedBoards:
    """As the corner finder hands them over."""
    return DetectedBoards(PATTERN, views, refused, len(views) + len(refused), "0" * 64)
