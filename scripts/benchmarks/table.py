"""The ground table of the deployed camera: time to build, memory held, memory at the peak."""

from __future__ import annotations

import multiprocessing
import time
import tracemalloc
from collections.abc import Callable

import numpy as np

from benchmarks.figures import Figures
from bikeped.config.build import framing, ground_camera
from bikeped.config.load import load_config
from bikeped.geometry.camera import GroundTable


def _measured(build: Callable[[], float]) -> tuple[float, float, float]:
    """Seconds to build, MB held (as `build` says), MB at the peak.

    The peak is what numpy allocates, by tracemalloc, in a run of its own: tracing costs time.
    """
    began = time.perf_counter()
    held = build()
    took = time.perf_counter() - began
    tracemalloc.start()
    build()
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    return took, held, peak


def _ours() -> tuple[float, float, float]:
    loaded = load_config()
    camera, size = ground_camera(loaded), framing(loaded).crop_wh
    GroundTable(camera, 64, 64)
    return _measured(lambda: GroundTable(camera, *size).nbytes / 1e6)


def _obvious() -> tuple[float, float, float]:
    """Equations 1 to 5 of the paper over the whole pixel grid, in float64, x, y and z kept."""
    loaded = load_config()
    camera, (width, height) = ground_camera(loaded), framing(loaded).crop_wh

    def build() -> float:
        u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
        dx, dy = u - camera.cx, v - camera.cy
        theta = np.sqrt(dx**2 + dy**2) / camera.lens.focal_px
        phi = np.arctan2(dy, dx)
        rays = np.stack(
            [np.cos(theta), np.sin(theta) * np.cos(phi), -np.sin(theta) * np.sin(phi)], axis=-1
        )
        alpha = np.radians(camera.pitch_deg)
        turn = np.array(
            [[np.cos(alpha), 0, -np.sin(alpha)], [0, 1, 0], [np.sin(alpha), 0, np.cos(alpha)]]
        )
        rays = rays @ turn.T
        valid = rays[..., 2] < 0
        t = np.where(valid, -camera.height_m / np.where(valid, rays[..., 2], -1), np.nan)
        ground = np.array([0, 0, camera.height_m]) + t[..., None] * rays
        return float((ground.nbytes + valid.nbytes) / 1e6)

    return _measured(build)


def run(figures: Figures) -> None:
    """Each way in a fresh process, three times in turns."""
    context = multiprocessing.get_context("spawn")
    results: dict[str, list[tuple[float, float, float]]] = {"ours": [], "obvious": []}
    for _ in range(3):
        for name, way in (("ours", _ours), ("obvious", _obvious)):
            with context.Pool(1) as pool:
                results[name].append(pool.apply(way))
    ours, obvious = (np.median(np.asarray(results[n]), axis=0) for n in ("ours", "obvious"))
    figures.add("ground table 3500 x 3500: build", ours[0] * 1e3, obvious[0] * 1e3, "ms", "100")
    figures.add("ground table 3500 x 3500: memory held", ours[1], obvious[1], "MB", "100")
    figures.add("ground table 3500 x 3500: peak while built", ours[2], obvious[2], "MB", "130")
