"""Whom the decision may count (definitions, section 13): people who are there now. Pure.

A track that coasts keeps its identity for seconds, a bicycle may stand parked, and a detector may
see a rider as a cyclist and a pedestrian. None of these is a cyclist and a pedestrian who meet.
"""

from __future__ import annotations

import numpy as np

from bikeped.decision.track_rows import EPSILON_S, IndexArray, Pairs, TrackRows, pair_rows
from bikeped.types import BoolArray, FloatArray

#: A cyclist and a pedestrian no farther apart and no different in velocity, for so long, are one
#: rider. A walker is overtaken within 1.5 m too, but at another speed.
RIDER_M, RIDER_MPS, RIDER_S = 1.5, 0.7, 0.5


def counts(unseen_s: FloatArray, parked: BoolArray, max_unseen_s: float) -> BoolArray:
    """Which tracks are present, remembered and paired: seen within `max_unseen_s`, not parked."""
    return np.asarray((unseen_s <= max_unseen_s + EPSILON_S) & ~parked)


def counted_pairs(rows: TrackRows, first_row: int = 0, count_all: bool = False) -> Pairs:
    """The cyclist-pedestrian pairs of the rows from `first_row` on that a rule may judge.

    `count_all`: riders are not told apart, as in the paper's simulation.
    """
    pairs = pair_rows(rows, first_row)
    if count_all or len(pairs) == 0:
        return pairs
    rider = _one_rider(rows, pairs)
    return pairs.take(~rider) if np.count_nonzero(rider) else pairs


def _one_rider(rows: TrackRows, pairs: Pairs) -> BoolArray:
    """[m]: the pairs that move alike, and those too young to tell that were always near."""
    cyclist, pedestrian = pairs.cyclist_row[pairs.cyclist], pairs.pedestrian_row
    rider: BoolArray = np.zeros(len(pairs), np.bool_)
    index = _near(rows, cyclist, pedestrian).nonzero()[0]
    if len(index) == 0:
        return rider
    cyclist, pedestrian = cyclist[index], pedestrian[index]
    since_s = rows.time_s[cyclist] - (RIDER_S - EPSILON_S)
    alike: BoolArray = np.ones(len(index), np.bool_)
    while True:
        near = _near(rows, cyclist, pedestrian)
        difference = rows.velocity_mps[cyclist] - rows.velocity_mps[pedestrian]
        alike &= near & ((difference**2).sum(-1) <= RIDER_MPS**2)
        old = rows.time_s[cyclist] <= since_s
        before = rows.previous[cyclist], rows.previous[pedestrian]
        young = ~old & ((before[0] < 0) | (before[1] < 0))
        rider[index] |= (old & alike) | (young & near)
        go = near & ~old & ~young
        if not np.count_nonzero(go):
            return rider
        index, since_s, alike = index[go], since_s[go], alike[go]
        cyclist, pedestrian = before[0][go], before[1][go]


def _near(rows: TrackRows, cyclist: IndexArray, pedestrian: IndexArray) -> BoolArray:
    apart = rows.xy_m[cyclist] - rows.xy_m[pedestrian]
    return np.asarray((apart**2).sum(-1) <= RIDER_M**2)
