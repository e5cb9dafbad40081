"""docs/examples/ordinary-video.yaml on the clip that it was written for, with a real network.

Model and clip lie outside the project, in `../shared`; without them this test is skipped.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from shared_inputs import CLIP, MODEL, missing

from bikeped.config.load import load_config
from bikeped.pipeline.replay import replay
from bikeped.telemetry.builders import decision_digest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "examples" / "ordinary-video.yaml"


def test_the_example_is_a_configuration():
    assert load_config(EXAMPLE).config.camera.projection == "perspective"


@pytest.mark.skipif(bool(missing(MODEL, CLIP)), reason=missing(MODEL, CLIP))
def test_the_clip_has_a_walker_a_bicycle_and_cars_at_plausible_speeds(tmp_path):
    loaded = load_config(EXAMPLE, [f"detection.model={MODEL}", "detection.threads=1"])
    digests = []
    for run in range(2):
        events = tmp_path / f"{run}.jsonl"
        result = replay(loaded, str(CLIP), events=events)
        digests.append(decision_digest(events.read_bytes().splitlines()))
    assert digests[0] == digests[1]

    summary = result.as_dict()
    assert all(summary["tracks"][kind] >= 1 for kind in ("pedestrian", "cyclist", "vehicle"))
    assert summary["undecodable"] == 0
    assert summary["not_on_ground"] == 0
    assert summary["warnings"] == []
    speeds = _speeds(events)
    # The walker is the pedestrian seen longest. The bicycle is pushed, so it is no faster.
    assert 1.1 < speeds["pedestrian"] < 1.7
    assert 1.0 < speeds["cyclist"] < 3.0
    assert 0.5 < speeds["vehicle"] < 8.0


def _speeds(events: Path) -> dict[str, float]:
    """Of each kind the track seen longest: how far it came over the time that took, m/s."""
    sights: dict[tuple[str, int], list[tuple[float, float, float]]] = {}
    for line in events.read_bytes().splitlines()[1:]:
        event = json.loads(line)
        for track in event["tracks"]:
            if not track["lost"]:
                key = (track["kind"], track["id"])
                sights.setdefault(key, []).append((event["t"], track["x"], track["y"]))
    speeds: dict[str, float] = {}
    for (kind, _), path in sorted(sights.items(), key=lambda item: len(item[1])):
        t, x, y = np.array(path).T
        speeds[kind] = math.hypot(x[-1] - x[0], y[-1] - y[0]) / max(t[-1] - t[0], 1e-9)
    return speeds
