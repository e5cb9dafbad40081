"""Whether a track is a pedestrian or a cyclist: it follows the recent detections of it. Pure.

A detector sees a small bicycle in some frames and only its rider in others, and now and then takes
the shadow or the bag of a walker for a bicycle. So a track carries the smoothed *share* of cycles
among its detections, each weighted by how clear it was.
"""

from __future__ import annotations

import numpy as np

from bikeped.types import BoolArray, Float32Array, FloatArray, IntArray, Kind, KindArray

_PEDESTRIAN, _CYCLIST = int(Kind.PEDESTRIAN), int(Kind.CYCLIST)
#: Weight of the newest detection in the share, a time constant of 0.4 s at 30 frames/s.
_WEIGHT = 0.08
#: A cycle of this confidence is one; the evidence of fainter ones is in proportion. Those of a real
#: rider are found again and again, those of a walker once or twice.
_CLEAR_CONFIDENCE = 0.3
#: Above the first share a pedestrian becomes a cyclist, below the second the reverse. Where a
#: bicycle is easily missed, two clear ones in a row make a cyclist, and 0.7 to 2.3 s of persons
#: alone a pedestrian again; where one box holds rider and cycle, the most frequent kind is right.
_CYCLE_SHARES = (0.12, 0.03)
_MAJORITY_SHARES = (0.55, 0.45)


def cycle_evidence(kind: KindArray, confidence: Float32Array | None) -> FloatArray:
    """How surely each detection is a cycle, 0 to 1, from its kind and its confidence (None: all
    are clear)."""
    cycle = (kind == _CYCLIST).astype(np.float64)
    if confidence is not None:
        cycle *= np.minimum(confidence / _CLEAR_CONFIDENCE, 1.0)
    return np.asarray(cycle)


def first_kind(
    kind: KindArray, cycle: FloatArray, ridden: BoolArray | None
) -> tuple[KindArray, FloatArray]:
    """Kind and share [n] of new tracks: what may be a bicycle under a person is a walker's."""
    if ridden is None:
        return kind, cycle
    walks = ridden & (cycle < 0.5)
    return np.where(walks, np.int8(_PEDESTRIAN), kind), np.where(walks, _WEIGHT * cycle, cycle)


def next_kind(
    kind: KindArray, share: FloatArray, cycle: FloatArray, hits: IntArray, whole: bool
) -> tuple[KindArray, FloatArray]:
    """Kind and share [n] of pedestrians and cyclists after a detection with evidence `cycle` [n].

    `hits` [n]: detections so far; `whole`: one box holds rider and cycle.
    """
    # There a young track has few detections: all of them count alike.
    weight = np.maximum(_WEIGHT, 1 / hits) if whole else _WEIGHT
    share = share + weight * (cycle - share)
    on, off = _MAJORITY_SHARES if whole else _CYCLE_SHARES
    rides = (kind == _PEDESTRIAN) & (share > on)
    walks = (kind == _CYCLIST) & (share < off)
    if whole:  # of the first two the newer is likelier right: most people come nearer
        rides |= (hits == 2) & (cycle > 0)
        walks |= (hits == 2) & (cycle == 0)
    return np.where(rides, np.int8(_CYCLIST), np.where(walks, np.int8(_PEDESTRIAN), kind)), share
