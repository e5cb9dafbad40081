"""What it costs to ask whether the picture can be trusted."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import simplejpeg

from benchmarks.figures import Figures
from benchmarks.loop import street_4k
from bikeped.config.build import framing, ground_camera
from bikeped.config.load import load_config
from bikeped.lab.demo.summary import bundled_scenario
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.rendering.clip import write_clip
from bikeped.lab.scenarios.scenario import load_scenario
from bikeped.monitor.camera_drift import DriftCheck
from bikeped.monitor.picture_health import PictureHealth
from bikeped.pipeline.replay import replay
from bikeped.types import ImageArray

FPS, SECONDS = 30, 20


def run(figures: Figures) -> None:
    """Picture health and drift on the demo's crossing, in time of one core.

    The pictures are 4K, decoded at half scale, as the deployed detector needs them.
    """
    half = {"min_width": 1280, "min_height": 720}
    pictures = [np.asarray(simplejpeg.decode_jpeg(jpeg, **half)) for jpeg in street_4k(8)]
    loaded = load_config()
    health, drift = PictureHealth(), DriftCheck(None, ground_camera(loaded), framing(loaded))
    spent_ms = _spent_ms(health.update, pictures, FPS)
    every = round(0.2 * FPS)  # health judges the rest of a picture five times a second
    figures.add("picture health, a frame that is judged", np.median(spent_ms[::every]), None, "ms")
    figures.add("picture health, mean of all frames", spent_ms.mean(), None, "ms", "2")
    figures.add("  share of a frame's time", 100 * spent_ms.mean() * FPS / 1e3, None, "%")
    spent_ms = _spent_ms(drift.update, pictures, 1)[3:]
    figures.add("camera drift, a check (one a second)", np.median(spent_ms), None, "ms")
    figures.add("  share of a second", 100 * spent_ms.mean() / 1e3, None, "%")
    _with_and_without(figures)


def _with_and_without(figures: Figures) -> None:
    """Latency of the loop on the demo's crossing, with the checks and without, in turns."""
    configs = [
        load_config(None, ("detection.model=bundled", f"monitor.picture={on}"))
        for on in ("true", "false")
    ]
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.avi"
        camera = scene_camera(configs[0], (1920, 1080))
        write_clip(ScenePainter(load_scenario(bundled_scenario()), camera, Conditions()), clip)
        rounds = [[replay(each, str(clip), own_camera=True) for each in configs] for _ in range(3)]
    for which in ("p50", "p95", "p99"):
        with_checks, without = (
            statistics.median(r.times.percentiles()["total"][which] for r in results)
            for results in zip(*rounds, strict=True)
        )
        figures.add(f"loop with the checks (obvious: without), {which}", with_checks, without, "ms")
    rates = [[r.frames / r.wall_s for r in results] for results in zip(*rounds, strict=True)]
    figures.add("  frames a second", *map(statistics.median, rates), "frames/s")


def _spent_ms(
    check: Callable[[ImageArray, float], object], pictures: list[ImageArray], hz: int
) -> np.ndarray:
    """Processor time of each call, milliseconds."""
    spent = []
    for number in range(SECONDS * hz if hz > 1 else SECONDS):
        began = time.process_time()
        check(pictures[number % len(pictures)], number / hz)
        spent.append(time.process_time() - began)
    return np.asarray(spent) * 1e3
