"""Drawn 4K street pictures as JPEG, about as large as a camera's."""

from __future__ import annotations

from functools import cache


@cache
def street_4k(count: int) -> list[bytes]:
    """`count` frames of the demo's crossing at 3840 x 2160, spread over its length."""
    import simplejpeg

    from bikeped.config import framing, ground_camera, load_config
    from bikeped.conformance.scenario import load_scenario
    from bikeped.demo import DEMO_POSE, Scene, bundled_scenario

    loaded = load_config()
    scenario = load_scenario(bundled_scenario())
    scene = Scene(scenario, ground_camera(loaded), framing(loaded), DEMO_POSE, (3840, 2160))
    step = scenario.duration_s / max(count, 2)
    return [
        simplejpeg.encode_jpeg(
            scene.frame(i * step + step / 2), quality=90, colorspace="RGB", colorsubsampling="420"
        )
        for i in range(count)
    ]
