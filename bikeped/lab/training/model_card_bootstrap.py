"""Confidence intervals of the card's figures, by a bootstrap over streets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bikeped.lab.rendering.dataset import PICTURES_A_STREET
from bikeped.lab.training.model_card import NEAR_M, WARNED, DetectionRecord, Records
from bikeped.types import FloatArray

_DRAWS = 2000
_LOW, _HIGH = 2.5, 97.5  #: percentiles


def bootstrap_spread(
    seen: Records, confidence: float, a_street: int = PICTURES_A_STREET
) -> dict[str, Any]:
    """95 % intervals of the recalls of pedestrians and cyclists within 15 m, and of the false
    positives of both per 100 frames.

    Streets are resampled with replacement (Efron and Tibshirani 1993, "An introduction to the
    bootstrap", section 13.3, percentiles), not pictures, for the `a_street` consecutive pictures of
    one street are alike. A recall without objects is None. Deterministic.
    """
    counts = np.array([_counts(picture, confidence) for picture in seen], np.float64)
    streets = np.add.reduceat(counts, np.arange(0, len(counts), a_street), axis=0)
    random = np.random.default_rng(0)
    drawn = random.integers(len(streets), size=(_DRAWS, len(streets)))
    sums = np.stack([streets[picks].sum(axis=0) for picks in drawn])
    result: dict[str, Any] = {
        "false_pedestrian_or_cyclist_per_100_frames": _bounds(100 * sums[:, -2] / sums[:, -1], 3)
    }
    for number, kind in enumerate(WARNED):
        found, asked = sums[:, 2 * number], sums[:, 2 * number + 1]
        some = asked > 0
        result[kind.label] = _bounds(found[some] / asked[some], 4) if some.any() else None
    return result


def _counts(picture: Sequence[DetectionRecord], confidence: float) -> list[int]:
    """Found objects and objects of each kind, false positives, and 1 for the frame."""
    row = []
    for kind in WARNED:
        mine = [s for s in picture if s.kind == kind and s.distance_m < NEAR_M]
        row += [sum(s.found_at(confidence) for s in mine), len(mine)]
    false = [s for s in picture if s.kind in WARNED and s.extra == "false"]
    return [*row, sum(s.confidence >= confidence for s in false), 1]


def _bounds(values: FloatArray, digits: int) -> list[float]:
    return [round(float(v), digits) for v in np.percentile(values, [_LOW, _HIGH])]
