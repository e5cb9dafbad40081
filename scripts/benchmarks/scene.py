"""Drawing scenes: frames a second of a crowded crossing, and what a new street costs."""

from __future__ import annotations

import cv2

from benchmarks.figures import Figures, in_turns
from bikeped.config.load import load_config
from bikeped.lab.rendering import Conditions, SceneCamera, ScenePainter, scene_camera
from bikeped.lab.rendering.backdrop import backdrop
from bikeped.lab.rendering.dataset import random_scenario
from bikeped.lab.rendering.render_camera import rays
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenario

_FRAMES = 8


def run(figures: Figures) -> None:
    """Beside the obvious way: everything anew for every frame, the street included."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the goal is for one core
    try:
        _clip(figures, (1920, 1080), "goal 10 or more")
        _clip(figures, (640, 360), "")
        _street(figures, (960, 540))
    finally:
        cv2.setNumThreads(threads)


def _clip(figures: Figures, size: tuple[int, int], goal: str) -> None:
    scenario = load_scenario(bundled_folder() / "dense-pedestrian-group.yaml")
    view = scene_camera(load_config(None, ()), size)
    painter = ScenePainter(scenario, view)

    def ours() -> None:
        for i in range(_FRAMES):
            painter.draw(5.0 + i / 30)

    def obvious() -> None:
        backdrop.cache_clear()
        ScenePainter(scenario, view).draw(5.0)

    fast, slow = in_turns(ours, obvious, runs=5)
    what = f"scene {size[0]} x {size[1]}, 9 people: picture and boxes"
    figures.add(what, _FRAMES / fast, 1 / slow, "frames/s", goal)


def _street(figures: Figures, size: tuple[int, int]) -> None:
    """A new scenario on the street that is there, against a street of its own for each."""
    view: SceneCamera = scene_camera(load_config(None, ()), size)
    conditions = Conditions(place=3)
    number = iter(range(10_000))

    def ours() -> None:
        ScenePainter(random_scenario(next(number)), view, conditions).draw(3.0)

    def obvious() -> None:
        backdrop.cache_clear()
        rays.cache_clear()
        ScenePainter(random_scenario(next(number)), view, conditions).draw(3.0)

    shared, own = in_turns(ours, obvious, runs=7)
    figures.add(
        f"scene {size[0]} x {size[1]}: another scenario, one picture", shared * 1e3, own * 1e3, "ms"
    )
