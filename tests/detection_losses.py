"""Missed detections drawn from a generator, one trial at a time."""

from __future__ import annotations

import numpy as np

from bikeped.lab.simulation.perception import missed_detections
from bikeped.types import BoolArray, FloatArray


def misses(
    recall: FloatArray, present: BoolArray, rng: np.random.Generator, burst: float | None = None
) -> BoolArray:
    """Which detections [f, a] of one trial are missed."""
    return missed_detections(rng.random(recall.shape), recall, present, burst)
