"""The README's promise, sentence by sentence: no blue and no green for what cannot be seen.

What a killed, stopped or held service leaves on the lamp is in `tests/lamp`; a detector that misses
its check picture in `test_pipeline_detector_watch.py`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import simplejpeg
from drawn_detectors import OracleDetector
from pipeline_fakes import Rig

from bikeped.config.load import load_config
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.rendering.clip import AviWriter
from bikeped.lab.rendering.dataset import random_scenario
from bikeped.pipeline.replay import replay
from bikeped.types import Detections, ImageArray

FPS, SIZE = 15, (640, 360)
GOOD_S = 4.0
REASSURING = {"IDLE", "SAFE"}


@pytest.fixture(scope="module")
def street() -> list[ImageArray]:
    """A quiet street through the deployed lens, with the noise of its sensor."""
    camera = scene_camera(load_config(), SIZE)
    painter = ScenePainter(random_scenario(1), camera, Conditions(place=5))
    return [painter.frame(number / FPS) for number in range(45)]


def lights(pictures: list[ImageArray], folder: Path) -> list[tuple[str, set[str]]]:
    """What the light shows with each picture, and the faults' codes; no person is detected."""
    clip, events = folder / "clip.avi", folder / "events.jsonl"
    with AviWriter(clip, FPS, SIZE) as writer:
        for rgb in pictures:
            writer.write(simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=90))
    blind = OracleDetector(lambda number: Detections.empty())
    replay(load_config(), str(clip), detector=blind, events=events)
    lines = [json.loads(line) for line in events.read_text().splitlines()[1:]]
    return [(line["light"], {fault["code"] for fault in line["faults"]}) for line in lines]


def one_colour(level: int) -> Callable[[ImageArray], ImageArray]:
    return lambda rgb: np.full_like(rgb, level)


def half_covered(rgb: ImageArray) -> ImageArray:
    covered = rgb.copy()
    covered[:, : rgb.shape[1] // 2] = 40
    return covered


def turned(degrees: float, down_px: float) -> Callable[[ImageArray], ImageArray]:
    def change(rgb: ImageArray) -> ImageArray:
        width, height = rgb.shape[1], rgb.shape[0]
        matrix = cv2.getRotationMatrix2D((width / 2, height / 2), degrees, 1.0)
        matrix[1, 2] += down_px
        return np.asarray(cv2.warpAffine(rgb, matrix, (width, height)), np.uint8)

    return change


#: Five degrees of the deployed lens, f = 1013 px on 3840, in this picture.
FIVE_DEG_PX = 1013.3 * np.radians(5) * SIZE[0] / 3840

CASES: list[tuple[str, Callable[[ImageArray], ImageArray] | None, set[str], float]] = [
    ("frozen", None, {"picture.frozen"}, 2.0),
    ("black", one_colour(0), {"picture.black"}, 1.0),
    ("white", one_colour(255), {"picture.white"}, 1.0),
    ("one colour", one_colour(90), {"picture.one_colour"}, 1.0),
    ("half covered", half_covered, {"picture.covered"}, 5.0),
    ("blurred", lambda rgb: cv2.GaussianBlur(rgb, (0, 0), 7), {"picture.blurred"}, 10.0),
    ("turned up", turned(0, FIVE_DEG_PX), {"camera.moved", "picture.covered"}, 30.0),
    ("rolled", turned(5, 0), {"camera.moved", "picture.covered"}, 30.0),
]


@pytest.mark.parametrize(
    ("change", "codes", "within_s"), [c[1:] for c in CASES], ids=[c[0] for c in CASES]
)
def test_no_blue_and_no_green_for_what_cannot_be_seen(
    street: list[ImageArray],
    tmp_path: Path,
    change: Callable[[ImageArray], ImageArray] | None,
    codes: set[str],
    within_s: float,
) -> None:
    back_and_forth = [*street, *street[-2:0:-1]]
    good = [back_and_forth[n % len(back_and_forth)] for n in range(round(GOOD_S * FPS))]
    shown_s = min(within_s, 8.0) + 1.0
    scene = [
        back_and_forth[(len(good) + n) % len(back_and_forth)] for n in range(round(shown_s * FPS))
    ]
    bad = [good[-1]] * len(scene) if change is None else [change(rgb) for rgb in scene]
    shown = lights([*good, *bad], tmp_path)
    assert {light for light, _ in shown[FPS : len(good)]} == {"IDLE"}
    late = shown[len(good) + round(min(within_s, 8.0) * FPS) :]
    assert late
    assert not REASSURING & {light for light, _ in late}
    assert all(codes & found for _, found in late)


async def test_without_a_picture_or_an_answer_the_light_shows_fault() -> None:
    async with Rig() as rig:
        await rig.frames(6)
        assert rig.recorder.name == "IDLE"
        rig.clock.now_s += 1.0  # no frame comes
        await rig.recorder.some_ticks()
        assert rig.recorder.name == "FAULT"
