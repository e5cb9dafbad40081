"""Motion on the road: what people do there counts, what weather and light do does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bikeped.config.build import framing, ground_camera
from bikeped.config.load import parse_config
from bikeped.errors import GeometryError
from bikeped.monitor.road_motion import EVERY_S, RoadMotion
from bikeped.types import ImageArray

W, H = 640, 360
LOADED = parse_config(
    f"camera: {{width: {W}, height: {H}, projection: perspective, pad_size: null,"
    " crop_size: null, radius_px: 367, fov_deg: 80, height_m: 4.0, pitch_deg: -20}",
    "road.yaml",
    Path(),
)
CAMERA = ground_camera(LOADED)
RNG = np.random.default_rng(5)
_COARSE = np.clip(RNG.normal(110, 12, (H // 4, W // 4, 1)), 0, 255).astype(np.uint8)
STREET = _COARSE.repeat(4, axis=0).repeat(4, axis=1).repeat(3, axis=2)


_MOTION = RoadMotion(CAMERA, framing(LOADED), 25.0)  # to lay it out takes longest


def fresh() -> RoadMotion:
    _MOTION.restart()
    return _MOTION


def with_box(
    picture: ImageArray,
    x_m: float,
    y_m: float,
    wide_m: float = 0.6,
    high_m: float = 1.75,
    grey: int = 30,
) -> ImageArray:
    """The picture with an upright box that stands at x, y on the ground."""
    corners = [(x_m, y_m + side * wide_m / 2, up) for side in (-1, 1) for up in (0.0, high_m)]
    uv, _ = CAMERA.project(np.array(corners))
    (u1, v1), (u2, v2) = uv.min(axis=0).round().astype(int), uv.max(axis=0).round().astype(int)
    out = picture.copy()
    out[max(v1, 0) : max(v2, 0), max(u1, 0) : max(u2, 0)] = grey
    return out


def watch(
    picture: Callable[[float], ImageArray], seconds: float = 12.0, motion: RoadMotion | None = None
) -> tuple[float, int]:
    motion = motion or fresh()
    seen = (0.0, 0)
    for t in np.arange(0, seconds, EVERY_S).tolist():
        seen = motion.update(picture(t), t)
    return seen


def noisy(picture: ImageArray, level: float = 4.0) -> ImageArray:
    noise = RNG.normal(0, level, picture.shape[:2])[..., None]
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("speed_mps", "wide_m", "away_m"), [(1.3, 0.6, 8.0), (1.3, 0.6, 13.0), (4.0, 1.4, 9.0)]
)
def test_a_walker_and_a_rider_count_while_they_travel(
    speed_mps: float, wide_m: float, away_m: float
) -> None:
    crossing_s = min(10.0, 10.0 / speed_mps)
    seconds, movers = watch(
        lambda t: noisy(with_box(STREET, away_m, speed_mps * min(t, crossing_s) - 5.0, wide_m))
    )
    assert seconds == pytest.approx(crossing_s, abs=1.3)
    assert movers == 1


def test_two_at_once_are_two_things_in_one_time() -> None:
    seconds, movers = watch(
        lambda t: with_box(with_box(STREET, 8.0, 1.2 * t - 5.0), 14.0, 5.0 - 1.2 * t)
    )
    assert movers == 2
    assert 6.0 <= seconds <= 12.0


def test_motion_is_forgotten_after_a_minute() -> None:
    motion = fresh()
    assert watch(lambda t: with_box(STREET, 8.0, 1.3 * t - 4.0), 6.0, motion)[1] == 1
    for t in np.arange(6.0, 70.0, EVERY_S).tolist():
        seen = motion.update(STREET, t)
    assert seen == (0.0, 0)


def test_a_gap_begins_anew() -> None:
    motion = fresh()
    watch(lambda t: with_box(STREET, 8.0, 1.3 * t - 4.0), 6.0, motion)
    assert motion.update(STREET, 9.0) == (0.0, 0)


def rain(picture: ImageArray) -> ImageArray:
    out = picture.copy()
    for u, v in zip(RNG.integers(0, W - 2, 150), RNG.integers(0, H - 40, 150), strict=True):
        out[v : v + RNG.integers(8, 40), u : u + 2] = 190
    return out


def swaying(t: float) -> ImageArray:
    return with_box(STREET, 8.0, 0.5 * float(np.sin(2.5 * t)), 1.0, 2.4)


def lit(t: float) -> ImageArray:
    share = 0.6 if 3 <= t < 6 else 1.3 if t >= 9 else 1.0
    return np.clip(STREET * share, 0, 255).astype(np.uint8)


def shaded(t: float) -> ImageArray:
    """The shadow of a cloud, 6 m wide, crosses the street."""
    return np.minimum(STREET, with_box(STREET, 9.0, 3.0 * t - 15.0, 6.0, 3.0, 70))


@pytest.mark.parametrize(
    "picture",
    [
        lambda t: STREET,
        lambda t: noisy(STREET, 10.0),
        lambda t: noisy((STREET * 0.15).astype(np.uint8), 8.0),
        lambda t: rain(STREET),
        swaying,
        lit,
        shaded,
        lambda t: with_box(STREET, 8.0, 0.0) if t < 5 else STREET,  # parked, and gone
        lambda t: with_box(STREET, 9.0, 4.0 * t - 20.0, 4.6, 1.6),  # a lorry
        lambda t: with_box(STREET, 40.0, 3.0 * t - 15.0),  # beyond the range
    ],
    ids=["still", "noise", "night", "rain", "branch", "light", "shadow", "ghost", "lorry", "far"],
)
def test_weather_light_and_large_things_do_not_count(
    picture: Callable[[float], ImageArray],
) -> None:
    assert watch(picture, 20.0) == (0.0, 0)


def test_another_cameras_picture_is_refused() -> None:
    with pytest.raises(GeometryError, match=r"camera\.width"):
        fresh().update(np.zeros((100, 100, 3), np.uint8), 0.0)
