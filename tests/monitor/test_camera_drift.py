"""What the drift check says of cameras that are turned, moved or covered, by day and by night."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.geometry.lens import Lens
from bikeped.lab.rendering import Conditions, ScenePainter
from bikeped.lab.rendering.dataset import random_scenario
from bikeped.lab.rendering.render_camera import (
    DEFAULT_POSE,
    SceneCamera,
    lens_camera,
    rectilinear_camera,
)
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.monitor.camera_drift import Drift, DriftCheck, misplaced_m
from bikeped.monitor.drift_reference import DriftReference, make_reference
from bikeped.monitor.patch_fit import Pose, rotation
from bikeped.types import FloatArray, ImageArray

WIDTH, HEIGHT = 640, 360
SCENE = lens_camera(
    Lens.from_circle("equidistant", 291.0, 197.9), (WIDTH, HEIGHT), height_m=3.6, pitch_deg=-4.0
)
CAMERA, FRAMING = SCENE.camera, SCENE.framing


@cache
def street(
    traffic: int = 1, light: str = "day", t_s: float = 1.0, scene: SceneCamera = SCENE
) -> ImageArray:
    """The same street with other people, in other light, through the same or another camera."""
    conditions = Conditions(seed=traffic, light=light, place=5)
    return ScenePainter(random_scenario(traffic), scene, conditions).frame(t_s)


def turn(pitch_deg: float = 0, heading_deg: float = 0, roll_deg: float = 0) -> FloatArray:
    """The turn, in ground axes, that changes the camera's pose by these angles."""

    def axes(pitch_deg: float, heading_deg: float, roll_deg: float) -> FloatArray:
        about = {(0, 0, 1): heading_deg, (0, -1, 0): pitch_deg, (1, 0, 0): roll_deg}
        first, second, third = (rotation(math.radians(a) * np.array(v)) for v, a in about.items())
        return first @ second @ third

    before = axes(CAMERA.pitch_deg, CAMERA.heading_deg, 0)
    after = axes(CAMERA.pitch_deg + pitch_deg, CAMERA.heading_deg + heading_deg, roll_deg)
    return after @ before.T


def seen_turned(picture: ImageArray, turned: FloatArray) -> ImageArray:
    """What the camera sees of a far street after a turn."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = CAMERA.rays(FRAMING.frame_to_crop(np.stack([u, v], axis=-1))) @ turned.T
    before, _ = CAMERA.project(np.nan_to_num(rays) + np.array([0, 0, CAMERA.height_m]))
    at = np.where(np.isfinite(rays[..., :2]), FRAMING.crop_to_frame(before), -9) - 0.5
    return np.asarray(cv2.remap(picture, at.astype(np.float32), None, cv2.INTER_LINEAR), np.uint8)


@cache
def reference() -> DriftReference:
    return make_reference([street(1, t_s=t) for t in (1.0, 2.0, 3.0)], CAMERA, FRAMING)


def shown(check: DriftCheck, picture: ImageArray, seconds: int = 6, start_s: float = 0.0) -> Drift:
    """What the check says after some seconds of one picture."""
    for second in range(seconds):
        drift = check.update(picture, start_s + second)
    assert drift is not None
    return drift


def checked(picture: ImageArray) -> Drift:
    return shown(DriftCheck(reference(), CAMERA, FRAMING), picture)


@pytest.mark.parametrize(
    "angles",
    [
        *[{"pitch_deg": a} for a in (-5.0, -0.3, 0.3, 1.0, 2.0, 5.0)],
        *[{"heading_deg": a} for a in (-5.0, 0.5, 2.0)],
        *[{"roll_deg": a} for a in (-5.0, 0.5, 2.0)],
        {"pitch_deg": 3.0, "heading_deg": -2.0, "roll_deg": 1.5},
        {"pitch_deg": 8.0, "heading_deg": 10.0},
    ],
    ids=str,
)
def test_a_turn_is_measured_in_other_traffic(angles: dict[str, float]) -> None:
    drift = checked(seen_turned(street(2), turn(**angles)))
    assert drift.judged
    for name in ("pitch_deg", "heading_deg", "roll_deg"):
        assert getattr(drift, name) == pytest.approx(angles.get(name, 0.0), abs=0.15), name
    assert drift.shift_m < 0.05
    assert drift.degrees == pytest.approx(np.linalg.norm(list(angles.values())), rel=0.02, abs=0.1)


@pytest.mark.parametrize(
    ("angles", "moved", "slightly"),
    [
        ({}, False, False),
        ({"pitch_deg": 0.3}, False, False),
        ({"pitch_deg": 1.0}, False, True),
        ({"pitch_deg": 2.0}, True, False),
        ({"pitch_deg": -2.0}, True, False),
        ({"roll_deg": 2.0}, True, False),
        ({"heading_deg": 2.5}, False, True),
        ({"heading_deg": 5.0}, True, False),
    ],
    ids=str,
)
def test_bounds_of_notice_and_fault(angles: dict[str, float], moved: bool, slightly: bool) -> None:
    drift = checked(seen_turned(street(2), turn(**angles)))
    assert (drift.moved, drift.moved_slightly) == (moved, slightly)
    fault = drift.fault()
    assert (None if fault is None else fault.code) == {
        (True, False): "camera.moved",
        (False, True): "camera.moved_slightly",
        (False, False): None,
    }[moved, slightly]


@pytest.mark.parametrize("light", ["overcast", "dusk", "night", "glare"])
def test_light_is_no_drift_and_hides_none(light: str) -> None:
    drift = checked(street(3, light))
    assert drift.judged
    assert not (drift.moved)
    assert not (drift.moved_slightly)
    assert drift.degrees < 0.35
    drift = checked(seen_turned(street(3, light), turn(pitch_deg=2.5)))
    assert drift.moved
    assert drift.pitch_deg == pytest.approx(2.5, abs=0.35)


def test_a_lower_camera_misplaces_the_ground() -> None:
    lower = replace(SCENE, camera=replace(CAMERA, height_m=CAMERA.height_m - 0.25))
    drift = checked(street(2, scene=lower))
    assert drift.judged
    # A point at 10 m looks 10 * 0.25 / 3.35 m nearer to the eye that is lower by so much.
    assert drift.metres_at_10m == pytest.approx(10 * 0.25 / (CAMERA.height_m - 0.25), abs=0.25)
    assert drift.moved_slightly


@pytest.mark.parametrize("east_m", [0.6, -0.6])
def test_a_camera_shifted_along_the_street(east_m: float) -> None:
    pose = replace(DEFAULT_POSE, x_m=DEFAULT_POSE.x_m + east_m)
    check = DriftCheck(reference(), CAMERA, FRAMING)
    assert shown(check, street(2)).metres_at_10m < 0.1
    # What is near has gone out of reach of the quick fit: the one from coarse pictures finds it.
    drift = shown(check, street(2, scene=replace(SCENE, pose=pose)), 20, 10.0)
    assert drift.judged
    assert drift.metres_at_10m == pytest.approx(0.6, abs=0.05)
    assert drift.moved_slightly


def test_roll_counts_where_a_narrow_view_hides_it() -> None:
    scene = rectilinear_camera(60, (WIDTH, HEIGHT), pitch_deg=-20)
    made = make_reference([street(1, scene=scene)], scene.camera, scene.framing)
    check = DriftCheck(made, scene.camera, scene.framing)
    drift = shown(check, rolled(street(2, scene=scene), 2.1, cv2.BORDER_REPLICATE))
    assert drift.metres_at_10m < 0.9
    assert drift.roll_deg == pytest.approx(2.1, abs=0.1)
    assert drift.moved


def shifted_up(picture: ImageArray, border: int) -> ImageArray:
    shift_px = CAMERA.lens.focal_px * math.radians(5)
    matrix = np.array([[1, 0, 0], [0, 1, -shift_px]], np.float32)
    return np.asarray(cv2.warpAffine(picture, matrix, (WIDTH, HEIGHT), borderMode=border), np.uint8)


def rolled(picture: ImageArray, degrees: float, border: int) -> ImageArray:
    matrix = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), -degrees, 1)
    return np.asarray(cv2.warpAffine(picture, matrix, (WIDTH, HEIGHT), borderMode=border), np.uint8)


@pytest.mark.parametrize("border", [cv2.BORDER_CONSTANT, cv2.BORDER_REPLICATE])
@pytest.mark.parametrize("change", ["up by 5", "rolled by 5", "rolled by 2"])
def test_without_a_saved_reference_the_first_seconds_are_it(change: str, border: int) -> None:
    check, since = DriftCheck(None, CAMERA, FRAMING), None
    for second in range(10):
        picture = street(4, t_s=0.5 * second)
        if second > 3:
            up = change == "up by 5"
            picture = (
                shifted_up(picture, border) if up else rolled(picture, float(change[-1]), border)
            )
        drift = check.update(picture, float(second))
        assert (drift is None) == (second <= 2)
        assert drift is None or drift.since_start
        if drift is not None and drift.moved and since is None:
            since = second
    assert since is not None
    assert 3 < since <= 9


def test_passing_gusts_are_no_verdict() -> None:
    check = DriftCheck(reference(), CAMERA, FRAMING)
    gust = seen_turned(street(2), turn(pitch_deg=2.5))
    for second in range(30):
        drift = check.update(gust if second % 4 == 0 else street(2), float(second))
        assert drift is not None
        assert not drift.moved


def test_verdicts_stay_in_the_dark_and_end_when_the_camera_is_back() -> None:
    check = DriftCheck(reference(), CAMERA, FRAMING)
    assert shown(check, seen_turned(street(2), turn(pitch_deg=3.0))).moved
    dark = shown(check, np.full((HEIGHT, WIDTH), 3, np.uint8), 30, 10.0)
    assert dark.moved
    assert not dark.judged
    assert dark.inliers == 0
    assert dark.pitch_deg == pytest.approx(3.0, abs=0.15)
    assert not shown(check, street(2), 10, 50.0).moved


def test_slow_drift_does_not_become_normal() -> None:
    check = DriftCheck(reference(), CAMERA, FRAMING)
    for step in range(26):
        picture = seen_turned(street(2), turn(pitch_deg=0.1 * step))
        drift = check.update(picture, 10.0 * step)
        drift = check.update(picture, 10.0 * step + 5.0)
    assert drift is not None
    assert drift.moved
    assert drift.pitch_deg == pytest.approx(2.5, abs=0.2)


def test_a_view_that_is_suddenly_another_is_lost() -> None:
    check = DriftCheck(reference(), CAMERA, FRAMING)
    assert not shown(check, street(2)).moved
    drift = shown(check, seen_turned(street(2), turn(heading_deg=120.0)), 14, 10.0)
    assert not drift.judged
    assert not drift.moved
    drift = shown(check, seen_turned(street(2), turn(heading_deg=120.0)), 10, 24.0)
    assert drift.lost
    assert drift.moved
    assert str(drift.fault()) == "camera: sees nothing of what it saw when it was aligned"


def test_a_view_that_changes_right_after_the_start_is_lost() -> None:
    check = DriftCheck(None, CAMERA, FRAMING)
    for second in range(3):
        check.update(street(4, t_s=0.5 * second), float(second))
    drift = shown(check, seen_turned(street(4), turn(heading_deg=120.0)), 20, 3.0)
    assert drift.lost
    assert str(drift.fault()) == "camera: sees nothing of what it saw when the service started"


@pytest.mark.parametrize("picture", ["covered", "blurred", "noise by night"])
def test_what_cannot_be_judged_is_not_moved(picture: str) -> None:
    rng = np.random.default_rng(5)
    bad = {
        "covered": np.full((HEIGHT, WIDTH, 3), 90, np.uint8),
        "blurred": np.asarray(cv2.GaussianBlur(street(2), (0, 0), 7), np.uint8),
        "noise by night": rng.normal(12, 2, (HEIGHT, WIDTH)).clip(0, 255).astype(np.uint8),
    }[picture]
    check = DriftCheck(reference(), CAMERA, FRAMING)
    assert shown(check, street(2)).judged
    drift = shown(check, bad, 25, 10.0)
    assert not (drift.judged)
    assert not (drift.moved)
    assert not (drift.lost)
    assert drift.match < 0.2


def test_another_street_is_never_a_pose() -> None:
    rng = np.random.default_rng(2)
    other = street(6, scene=replace(SCENE, pose=CameraPose(40.0, 30.0, 200.0)))
    noise = cv2.GaussianBlur(rng.integers(0, 255, (HEIGHT, WIDTH), np.uint8), (0, 0), 1.5)
    for picture in (other, np.asarray(noise, np.uint8)):
        drift = shown(DriftCheck(reference(), CAMERA, FRAMING), picture, 17)
        assert not drift.judged


def test_too_dark_a_start_waits_for_a_reference() -> None:
    check = DriftCheck(None, CAMERA, FRAMING)
    dark = np.full((HEIGHT, WIDTH), 3, np.uint8)
    assert [check.update(dark, float(t)) for t in range(6)] == [None] * 6
    assert shown(check, street(1), 10, 6.0).judged
    with pytest.raises(GeometryError, match="only 0 places"):
        make_reference([dark], CAMERA, FRAMING)


def test_sizes_of_pictures_do_not_matter() -> None:
    check = DriftCheck(reference(), CAMERA, FRAMING)
    large = np.asarray(cv2.resize(street(2), (1920, 1080)), np.uint8)
    assert shown(check, large).degrees < 0.1


def test_what_moves_is_no_place_of_the_reference() -> None:
    """A checkered van crosses a quiet street while the reference is made."""
    pictures = [street(1, t_s=1.0).copy() for _ in range(3)]
    for number, picture in enumerate(pictures):
        tiles = np.kron(np.indices((8, 12)).sum(axis=0) % 2, np.ones((10, 10))) * 255
        picture[200:280, 100 + 90 * number : 220 + 90 * number] = tiles[..., None]
    found = make_reference(pictures, CAMERA, FRAMING)
    u, v = found.uv_px.T
    inside = (v > 208) & (v < 272) & (u > 108) & (u < 392)
    alone = make_reference(pictures[:1], CAMERA, FRAMING).uv_px
    assert ((alone[:, 0] > 108) & (alone[:, 0] < 212) & (alone[:, 1] > 208)).sum() > 10
    assert inside.sum() <= 2


def test_metres_at_10m() -> None:
    """Pitched up by an angle, the ground at 10 m is looked at that much more steeply."""
    high = CAMERA.height_m
    for degrees in (-2.0, 0.5, 2.0):
        pose = Pose(turn(pitch_deg=degrees), np.zeros(3))
        down = math.atan2(high, 10.0) + math.radians(degrees)
        ahead = abs(high / math.tan(down) - 10.0)
        assert misplaced_m(CAMERA, pose) == pytest.approx(ahead, rel=1e-3)
    up = Pose(turn(pitch_deg=-25.0), np.zeros(3))  # the old pose reads the sky there
    assert misplaced_m(CAMERA, up) == 100.0
    along = Pose(np.eye(3), np.array([0.0, 0.7, 0.0]))
    assert misplaced_m(CAMERA, along) == pytest.approx(0.7)


def test_the_file_holds_the_reference() -> None:
    content = reference().to_json()
    again = DriftReference.from_json(content, "x.json")
    assert (again.camera, again.framing) == (CAMERA, FRAMING)
    np.testing.assert_array_equal(again.uv_px, reference().uv_px)
    np.testing.assert_array_equal(again.ground_m, reference().ground_m)
    near = np.isfinite(again.ground_m[:, 0])
    assert near.sum() > 50
    uv, _ = CAMERA.project(again.ground_m[near])
    np.testing.assert_allclose(FRAMING.crop_to_frame(uv), again.uv_px[near], atol=1e-6)
    assert shown(DriftCheck(again, CAMERA, FRAMING), street(2)).degrees < 0.1
    assert len(content) < 300_000


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_damaged_file_is_named(data: st.DataObject) -> None:
    content = bytearray(reference().to_json())
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    else:
        first = data.draw(st.integers(0, len(content) - 64))
        content[first : first + 64] = bytes(64)
    with pytest.raises(GeometryError, match=r"^site.json: is not a camera reference .* align"):
        DriftReference.from_json(bytes(content), "site.json")


def test_a_reference_of_another_pose_or_sensor_is_refused() -> None:
    other: list[tuple[GroundCamera, Framing]] = [
        (replace(CAMERA, height_m=4.0), FRAMING),
        (replace(CAMERA, cx=CAMERA.cx + 1), FRAMING),
        (CAMERA, Framing(1280, 720)),
    ]
    for camera, framing in other:
        with pytest.raises(GeometryError, match=r"camera\.reference: .* align the camera again"):
            DriftCheck(reference(), camera, framing)
