"""The align page: a drawn street as a camera sees it that hangs higher than its configuration says,
with four marks; before the fit, with the loupe, and after it."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from bikeped.config.build import framing, ground_camera
from bikeped.config.load import load_config
from bikeped.lab.demo.summary import bundled_scenario
from bikeped.lab.rendering import Conditions, SceneCamera, ScenePainter
from bikeped.lab.scenarios.scenario import load_scenario
from bikeped.lab.simulation.camera_pose import CameraPose

if TYPE_CHECKING:
    from playwright.sync_api import Page
    from screenshots import Studio

ROOT = Path(__file__).parents[2]
AT_M = ((4.0, -1.5), (6.0, 2.0), (10.0, -3.0), (15.0, 4.0))
CHALK = (255, 90, 30)
PATIENCE_MS = 60_000


def take(studio: Studio) -> None:
    """Serves the drawn street with `bikeped align` on copies of the bundled configuration."""
    for name in ("config.yaml", "camera_calibration.json"):
        (studio.work / name).write_bytes((ROOT / name).read_bytes())
    config = studio.work / "config.yaml"
    picture = studio.work / "crossing.jpg"
    points = _draw(config, picture)
    process = subprocess.Popen(
        [sys.executable, "-m", "bikeped.cli.main", "align", picture, "-c", config, "--no-browser"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    assert process.stdout is not None
    url = next(found[0] for line in process.stdout if (found := re.search(r"http://\S+", line)))

    def with_marks(page: Page) -> None:
        page.wait_for_selector("html[data-ready=align]", timeout=PATIENCE_MS)
        page.set_input_files("#import-file", points)
        page.wait_for_selector(".pin >> nth=3")
        page.wait_for_function("() => document.querySelectorAll('.says')[3].textContent")

    def fitted(page: Page) -> None:
        with_marks(page)
        page.get_by_role("button", name="Fit to the marks").click()
        page.wait_for_selector("#fit-answer table")
        page.wait_for_function("() => /−/.test(document.querySelector('#ten-text').textContent)")
        page.evaluate("() => document.querySelectorAll('.toast').forEach((t) => t.remove())")
        page.evaluate("() => document.querySelector('#fit').scrollIntoView({block: 'center'})")

    def dragged(page: Page) -> None:
        with_marks(page)
        page.get_by_role("button", name="Zoom in").click()
        page.wait_for_function("() => +document.querySelector('#stage').dataset.scale > 0.2")
        box = page.locator(".pin").nth(1).bounding_box()
        assert box is not None
        x, y = box["x"] + 22, box["y"] + 22
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 9, y - 7, steps=3)

    try:
        studio.shoot("align", url, fitted, whole=())
        studio.shoot("align-loupe", url, dragged, sizes=("phone",), schemes=("light",), whole=())
    finally:
        process.terminate()
        process.wait()


def _draw(config: Path, picture: Path) -> Path:
    """The street from 4.21 m, pitched 7.3 degrees down, with chalk crosses; and their points."""
    loaded = load_config(config)
    frame = framing(loaded).for_frame(3840, 2160)
    camera = replace(ground_camera(loaded), height_m=4.21, pitch_deg=-7.3)
    eye = SceneCamera(camera, frame, CameraPose(5, -13, 90), (3840, 2160))
    image = ScenePainter(load_scenario(bundled_scenario()), eye, Conditions()).frame(0.0).copy()
    marks = []
    for number, (x, y) in enumerate(AT_M, 1):
        for way in (1, -1):
            arm = np.linspace(-0.35, 0.35, 20)
            uv, _ = camera.project(np.stack([x + arm, y + way * arm], axis=1))
            line = np.round(frame.crop_to_frame(uv) * 16).astype(np.int32)
            cv2.polylines(image, [line], False, CHALK, 5, cv2.LINE_AA, 4)
        u, v = frame.crop_to_frame(camera.project([(x, y)])[0])[0].round(1).tolist()
        distance_m = round(math.hypot(x, y), 2)
        marks.append({"name": str(number), "u": u, "v": v, "distance_m": distance_m, "right_m": y})
    cv2.imwrite(str(picture), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    points = picture.with_name("points.json")
    points.write_text(json.dumps({"frame": {"width": 3840, "height": 2160}, "marks": marks}))
    return points
