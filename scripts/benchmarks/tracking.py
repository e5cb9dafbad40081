"""Tracking and decision together at 10, 50 and 200 objects, against plain loops."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from benchmarks.figures import Figures, in_turns
from bikeped.config.build import rule_settings, tracker_settings
from bikeped.config.load import load_config
from bikeped.decision.decider import Decider
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.tracking.tracker import Tracker
from bikeped.types import Detections, GroundPoints

FRAMES = 60
GOALS_MS = {10: 0.3, 50: 0.8, 200: 4.0}


def run(figures: Figures) -> None:
    """Walkers and cyclists in equal number on 40 x 40 m, with 3 cm of noise."""
    for count, goal in GOALS_MS.items():
        _objects(figures, count, goal)
    for count in (300, 2000):
        _crowd(figures, count)


def _objects(figures: Figures, count: int, goal_ms: float) -> None:
    config = load_config().config
    rng = np.random.default_rng(count)
    start = rng.uniform(-20, 20, (count, 2))
    velocity = rng.normal(0, 1.5, (count, 2))
    kind = (np.arange(count) % 2).astype(np.int8)
    scenes = []
    for i in range(FRAMES):
        order = rng.permutation(count)
        xy = start + velocity * i / 30 + rng.normal(0, 0.03, (count, 2))
        scenes.append((kind[order], xy[order]))

    def ours() -> None:
        tracker = Tracker(tracker_settings(config.tracking))
        decider = Decider(rule_settings(config.decision))
        for i, (kinds, xy) in enumerate(scenes):
            points = GroundPoints(kinds, xy, np.arange(len(kinds)))
            tracks = tracker.update(points, i / 30)
            decider.decide(i / 30, tracks.id, tracks.kind, tracks.xy_m)

    def obvious() -> None:
        plain = PlainPole()
        for kinds, xy in scenes:
            plain.step(kinds.tolist(), xy.tolist())

    a, b = in_turns(ours, obvious, 5)
    what = f"tracking and decision, {count} objects, a frame"
    figures.add(what, a / FRAMES * 1e3, b / FRAMES * 1e3, "ms", f"{goal_ms:g}")


def _crowd(figures: Figures, count: int) -> None:
    """A detector gone wrong: `count` boxes a frame, each frame anywhere; the decision's p99."""
    loaded = load_config()
    camera = loaded.config.camera
    track_and_decide, rng, took_ms = TrackAndDecide(loaded), np.random.default_rng(count), []
    for frame in range(5 * FRAMES):
        x = rng.uniform(0.1, 0.9, count) * camera.width
        y = rng.uniform(0.5, 0.95, count) * camera.height
        box = np.stack([x - 10, y - 40, x + 10, y], axis=1).astype(np.float32)
        score = np.sort(rng.uniform(0.1, 1, count)).astype(np.float32)[::-1]
        found = Detections((np.arange(count) % 3).astype(np.int8), score, box)
        began = time.thread_time()  # other processes do not count
        track_and_decide.update(found, camera.width, camera.height, frame / 30, 0.0)
        took_ms.append((time.thread_time() - began) * 1e3)
    what = f"tracking and decision, {count} stray boxes, p99"
    figures.add(what, float(np.percentile(took_ms[FRAMES:], 99)), None, "ms", "5")


class PlainPole:
    """Greedy matching and the pairwise rule as one would first write them."""

    def __init__(self) -> None:
        self.tracks: list[dict[str, Any]] = []

    def step(self, kinds: list[int], points: list[list[float]]) -> bool:
        pairs = []
        for i, track in enumerate(self.tracks):
            x, y = track["history"][-1]
            for j, (kind, point) in enumerate(zip(kinds, points, strict=True)):
                distance = math.hypot(x - point[0], y - point[1])
                if kind == track["kind"] and distance <= 3.0:
                    pairs.append((distance, i, j))
        pairs.sort()
        tracks, detections = set(), set()
        for _, i, j in pairs:
            if i not in tracks and j not in detections:
                tracks.add(i)
                detections.add(j)
                self.tracks[i]["history"] = [*self.tracks[i]["history"][-29:], tuple(points[j])]
        for j, (kind, point) in enumerate(zip(kinds, points, strict=True)):
            if j not in detections:
                self.tracks.append({"kind": kind, "history": [tuple(point)]})
        alert = False
        for c in self.tracks:
            for p in self.tracks:
                if c["kind"] == 1 and p["kind"] == 0:
                    old, new = c["history"], p["history"]
                    if len(old) > 2 and len(new) > 2:
                        now = math.dist(old[-1], new[-1])
                        moved = math.dist(old[-1], old[-3])
                        near = 1.9 <= now <= 24.8 and math.hypot(*old[-1]) <= 25
                        alert |= near and now < math.dist(old[-3], new[-3]) and moved > 0.147
        return alert
