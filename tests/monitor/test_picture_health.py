"""Picture health on a small noisy street, whole and with every fault of the campaign."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.faults import FAULT_KINDS, Effect
from bikeped.monitor.picture_health import PictureHealth
from bikeped.monitor.reduced_picture import reduce
from bikeped.monitor.repeated_pictures import RepeatedPictures
from bikeped.monitor.verdicts import Hold
from bikeped.types import ImageArray

FPS = 10
BEGINS_S = 3.0
SIZE = (240, 320)
#: Time of day by brightness: a dark night still works.
DAY, NIGHT = 1.0, 0.12
Frames = list[ImageArray]


def street(size: tuple[int, int] = SIZE) -> ImageArray:
    """A street with texture and sharp edges all over, under a flat sky."""
    rng = np.random.default_rng(7)
    height, width = size
    texture = cv2.resize(
        rng.normal(0, 12, (height // 6, width // 6)).astype(np.float32), size[::-1]
    )
    picture = np.clip(110 + texture, 0, 255).astype(np.uint8)
    picture[: height // 6] = 190
    for _ in range(90):
        u, v = int(rng.uniform(0, width)), int(rng.uniform(height / 6, height))
        w, h = (int(x) for x in rng.uniform(6, 30, 2))
        cv2.rectangle(picture, (u, v), (u + w, v + h), int(rng.uniform(30, 230)), -1)
    return np.asarray(cv2.merge([picture, picture, cv2.convertScaleAbs(picture, alpha=0.9)]))


@cache
def frames(
    seconds: float, fps: float = FPS, light: float = DAY, noise: float = 2.5, walker: bool = True
) -> Frames:
    """The street with fresh noise in every frame, and a person who walks."""
    rng = np.random.default_rng(3)
    base = street().astype(np.int16)
    field = np.round(rng.normal(0, noise, (2 * SIZE[0], 2 * SIZE[1], 1))).astype(np.int16)
    made = []
    for number in range(round(seconds * fps)):
        picture = base.copy()
        if walker:
            u = int(10 + 20 * number / fps)
            picture[150:155, u : u + 3] = 20
        picture = (picture * light).astype(np.int16)
        v, u = (int(rng.integers(0, side)) for side in SIZE)
        made.append(np.clip(picture + field[v:, u:][: SIZE[0], : SIZE[1]], 0, 255).astype(np.uint8))
    return made


def change(pictures: Frames, effect: Callable[[int, ImageArray], ImageArray]) -> Frames:
    """The pictures, from three seconds on with `effect(number since then, picture)`."""
    first = round(BEGINS_S * FPS)
    return pictures[:first] + [effect(i, p) for i, p in enumerate(pictures[first:])]


def times(
    pictures: Iterable[ImageArray], fps: float = FPS, health: PictureHealth | None = None
) -> dict[str, float]:
    """When each code became active, in seconds after the third."""
    health = health or PictureHealth()
    found: dict[str, float] = {}
    for number, picture in enumerate(pictures):
        for verdict in health.update(picture, number / fps):
            if verdict.active:
                found.setdefault(verdict.code, number / fps - BEGINS_S)
    return found


def half(patch: ImageArray | int) -> Callable[[int, ImageArray], ImageArray]:
    """An effect: the left half covered."""

    def cover(number: int, picture: ImageArray) -> ImageArray:
        covered = picture.copy()
        covered[:, : SIZE[1] // 2] = patch if isinstance(patch, int) else patch[:, : SIZE[1] // 2]
        return covered

    return cover


def fresh(level: float, deviation: float) -> Callable[[int, ImageArray], ImageArray]:
    """An effect: nothing but noise around a level."""
    rng = np.random.default_rng(5)
    field = np.clip(rng.normal(level, deviation, (2 * SIZE[0], 2 * SIZE[1], 3)), 0, 255)
    field = field.astype(np.uint8)

    def draw(number: int, picture: ImageArray) -> ImageArray:
        v, u = (int(rng.integers(0, side)) for side in SIZE)
        return field[v:, u:][: SIZE[0], : SIZE[1]]

    return draw


def blurred(number: int, picture: ImageArray) -> ImageArray:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 7.0), np.uint8)


def sprayed(number: int, picture: ImageArray) -> ImageArray:
    rng = np.random.default_rng(2)
    drops = np.zeros(SIZE, np.uint8)
    for _ in range(45):
        at = (int(rng.uniform(0, SIZE[1])), int(rng.uniform(0, SIZE[0])))
        cv2.circle(drops, at, int(rng.uniform(8, 18)), 1, -1)
    return np.where(drops[..., None] > 0, cv2.GaussianBlur(picture, (0, 0), 5.0), picture)


@pytest.fixture(scope="module")
def quiet() -> Frames:
    return frames(9.0)


def recoded(pictures: Frames, codec: str, path: Path) -> Frames:
    """The pictures as OpenCV writes and reads them."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), FPS, SIZE[::-1])
    for picture in pictures:
        writer.write(picture)
    writer.release()
    reader, read = cv2.VideoCapture(str(path)), []
    while (answer := reader.read())[0]:
        read.append(np.asarray(answer[1], np.uint8))
    return read


def test_every_code_is_a_known_fault_with_its_effect() -> None:
    effects = {v.code: FAULT_KINDS[v.code].effect for v in PictureHealth().update(street(), 0.0)}
    assert len(effects) == 9
    assert effects["picture.blurred"] is effects["picture.spray"] is Effect.WITHHELD
    assert effects["picture.frozen"] is effects["picture.covered"] is Effect.FAULT
    assert effects["picture.underexposed"] is Effect.NOTICE


@pytest.mark.parametrize(("light", "noise"), [(DAY, 2.5), (DAY, 0.8), (NIGHT, 1.5)])
def test_a_working_picture_has_no_fault(light: float, noise: float) -> None:
    found = times(frames(9.0, light=light, noise=noise))
    assert set(found) <= {"picture.underexposed"}
    assert ("picture.underexposed" in found) == (light == NIGHT)


@pytest.mark.parametrize("codec", ["MJPG", "mp4v"])
@pytest.mark.parametrize("period", [1, 7, 30])
def test_a_frozen_picture_or_loop_is_found_in_two_seconds(
    quiet: Frames, codec: str, period: int, tmp_path: Path
) -> None:
    first = round(BEGINS_S * FPS)
    stuck = change(quiet, lambda i, _: quiet[first - period + i % period])
    suffix = {"MJPG": "avi", "mp4v": "mp4"}[codec]
    found = times(recoded(stuck, codec, tmp_path / f"clip.{suffix}"))
    assert 0.5 < found.pop("picture.frozen") <= 2.0
    assert not found


@pytest.mark.parametrize("shown", [25 / 30, 1 / 3])
def test_single_repeated_frames_are_no_frozen_picture(quiet: Frames, shown: float) -> None:
    assert not times([quiet[int(i * shown)] for i in range(len(quiet))])


def test_a_small_walker_without_noise_is_no_frozen_picture_until_he_has_gone() -> None:
    still = frames(8.0, noise=0.0, walker=False)
    assert not times(frames(8.0, noise=0.0))
    assert set(times(still)) == {"picture.frozen"}


@pytest.mark.parametrize(("level", "code"), [(0, "black"), (255, "white"), (120, "one_colour")])
@pytest.mark.parametrize("deviation", [0.0, 4.0])
def test_one_colour_is_found_in_a_second_also_from_the_start(
    quiet: Frames, level: int, code: str, deviation: float
) -> None:
    flat = change(quiet, fresh(level, deviation))
    assert times(flat)[f"picture.{code}"] <= 1.0
    start = times(flat[round(BEGINS_S * FPS) :])[f"picture.{code}"] + BEGINS_S
    assert start <= 1.0


COVERS: dict[str, Callable[[int, ImageArray], ImageArray]] = {
    "grey half": half(128),
    "black half": half(0),
    "white half": half(250),
    "half of noise": half(fresh(120, 12)(0, street())),
    "bag": fresh(30, 3),
    "whole of noise": fresh(110, 20),
}


@pytest.mark.parametrize("name", COVERS)
@pytest.mark.parametrize("light", [DAY, 0.3])
def test_a_cover_is_found_in_five_seconds_and_never_learnt(name: str, light: float) -> None:
    health, pictures = PictureHealth(), change(frames(12.0, light=light), COVERS[name])
    found = times(pictures, health=health)
    assert 1.0 < found["picture.covered"] <= 5.0
    verdicts = {v.code: v for v in health.update(pictures[-2], 12.0)}
    assert verdicts["picture.covered"].active


@pytest.mark.parametrize("share", [0.15, 0.3])
def test_a_vehicle_that_stops_before_the_camera_is_no_cover(quiet: Frames, share: float) -> None:
    width, height = (round(side * math.sqrt(share)) for side in SIZE[::-1])

    def van(number: int, picture: ImageArray) -> ImageArray:
        parked = picture.copy()
        left = min(number * 12, SIZE[1] // 2) - width // 2
        side = parked[120 - height // 2 : 120 + height // 2, max(left, 0) : left + width]
        side[:] = 205
        side[height // 4 : height // 2, 4::20] = 60
        return parked

    assert "picture.covered" not in times(change(quiet, van))


@pytest.mark.parametrize("light", [DAY, 0.3])
def test_blur_is_found_in_ten_seconds_also_from_the_start(light: float) -> None:
    pictures = change(frames(9.0, light=light), blurred)
    found = times(pictures)
    assert 1.0 < found["picture.blurred"] <= 7.0
    start = times(pictures[round(BEGINS_S * FPS) :])
    assert start["picture.blurred"] + BEGINS_S <= 5.0
    assert "picture.covered" not in start


def test_blur_is_never_learnt(quiet: Frames) -> None:
    health = PictureHealth()
    times(quiet, health=health)
    for number in range(400):
        picture = cv2.GaussianBlur(quiet[number % 60], (0, 0), 2.2)
        verdicts = health.update(picture, 10.0 + number / 5)
    assert {v.code for v in verdicts if v.active} == {"picture.blurred"}


def test_drops_are_found_in_ten_seconds() -> None:
    found = times(change(frames(13.0), sprayed))
    assert set(found) == {"picture.spray"}
    assert 2.0 < found["picture.spray"] <= 10.0


def test_a_sudden_change_of_light_is_no_fault(quiet: Frames) -> None:
    assert not times(change(quiet, lambda _, p: np.asarray(p // 2 + 20, np.uint8)))


def test_verdicts_end_when_the_cause_has_gone(quiet: Frames) -> None:
    health = PictureHealth()
    assert "picture.covered" in times(change(quiet, half(128)), health=health)
    active = set()
    for number, picture in enumerate(quiet):
        verdicts = health.update(picture, 9.0 + number / FPS)
        active = {v.code for v in verdicts if v.active}
    assert not active


def test_the_image_circle_leaves_out_what_lies_outside() -> None:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    outside = np.hypot(columns - 160, rows - 120) > 118
    pictures = change(frames(8.0), fresh(250, 0.0))
    pictures = [np.where(outside[..., None], 0, p).astype(np.uint8) for p in pictures]
    for circle in ((0.5, 0.5, 118 / 320), None):
        assert times(pictures, health=PictureHealth(circle))["picture.white"] <= 1.0


def odd_pictures() -> Iterator[ImageArray]:
    yield np.zeros((0, 0, 3), np.uint8)
    yield np.zeros((240, 320), np.uint8)  # type: ignore[misc]
    yield np.zeros((8, 320, 3), np.uint8)
    yield np.zeros((240, 320, 4), np.uint8)
    yield np.full((240, 320, 3), np.nan).astype(np.float64)  # type: ignore[misc]


def test_what_cannot_be_judged_changes_nothing(quiet: Frames) -> None:
    health = PictureHealth()
    for number, picture in enumerate(change(quiet, half(0))):
        verdicts = health.update(picture, number / FPS)
    assert any(v.active for v in verdicts)
    for odd in odd_pictures():
        assert health.update(odd, 100.0) == verdicts
    for time_s in (math.nan, math.inf, -math.inf):
        assert health.update(quiet[0], time_s) == verdicts


@settings(max_examples=60, deadline=None)
@given(
    st.integers(48, 130),
    st.integers(48, 130),
    st.lists(st.floats(allow_nan=True), min_size=1, max_size=8),
    st.integers(0, 255),
)
def test_any_size_and_any_time_is_judged(
    height: int, width: int, stamps: list[float], level: int
) -> None:
    health = PictureHealth((0.5, 0.5, 0.4))
    for time_s in stamps:
        verdicts = health.update(np.full((height, width, 3), level, np.uint8), time_s)
        assert len(verdicts) == 9
        assert len({v.code for v in verdicts}) == 9


@given(
    st.lists(st.tuples(st.floats(0.01, 1.0), st.sampled_from([0.0, 2.0, math.nan])), max_size=40)
)
def test_a_verdict_is_active_only_after_its_hold_without_a_good_value(
    steps: list[tuple[float, float]],
) -> None:
    hold, time_s, bad_since = Hold("picture.covered", 1.0, "covered"), 0.0, math.inf
    active = False
    for passed_s, value in steps:
        time_s += passed_s
        now = hold.update(value, 1.0, time_s).active
        if value >= 1.0:
            bad_since = min(bad_since, time_s)
        if now and not active:
            assert value >= 1.0
            assert time_s - bad_since >= 1.0
        if active and not now:
            assert value < 1.0
        if value < 1.0 and not now:
            bad_since = math.inf
        active = now


def test_a_gap_is_no_frozen_picture(quiet: Frames) -> None:
    repeated = RepeatedPictures()
    stamps = [*np.arange(30) / FPS, *(60 + np.arange(30) / FPS)]
    assert (
        max(
            repeated.update(p, float(t), partial(reduce, p))
            for p, t in zip(quiet, stamps, strict=False)
        )
        < 1.2
    )
