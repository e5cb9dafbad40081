"""Drawn 4K street pictures as JPEG, about as large as a camera's."""

from __future__ import annotations

from functools import cache


@cache
def street_4k(count: int) -> list[bytes]:
    """`count` frames of the demo's crossing at 3840 x 2160, spread over its length."""
    from bikeped.config import load_config
    from bikeped.lab.demo import bundled_scenario
    from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
    from bikeped.lab.rendering.clip import encode_jpeg
    from bikeped.lab.scenarios.scenario import load_scenario

    scenario = load_scenario(bundled_scenario())
    painter = ScenePainter(scenario, scene_camera(load_config(), (3840, 2160)), Conditions())
    step = scenario.duration_s / max(count, 2)
    return [encode_jpeg(painter.frame(i * step + step / 2), 90) for i in range(count)]
