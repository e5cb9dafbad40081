"""Whom the decision may count (definitions, section 13): people who are there now. Pure.

A track that coasts keeps its identity for seconds, a bicycle may stand parked, and a detector may
see a rider as a cyclist and a pedestrian. None of these is a cyclist and a pedestrian who meet.
"""

from __future__ import annotations

import numpy as np

from bikeped.decision.track_rows import EPSILON_S, IndexArray, Pairs, TrackRows
from bikeped.types import BoolArray, FloatArray

#: A cyclist and a pedestrian no farther apart and no different in velocity, for so long, are one
#: rider. A walker is overtaken within 1.5 m too, but at another speed.
RIDER_M, RIDER_MPS, RIDER_S = 1.5, 0.7, 0.5


def counts(unseen_s: FloatArray, parked: BoolArray, max_unseen_s: float) -> BoolArray:
    """Which tracks are present, remembered and paired: seen within `max_unseen_s`, not parked."""
    return np.asarray((unseen_s <= max_unseen_s + EPSILON_S) & ~parked)


def without_riders(rows: TrackRows, pairs: Pairs, fires: BoolArray) -> BoolArray:
    """`fires` [m] without the pairs that are one rider: that move alike, or are too young to tell
    and were always near. Only pairs that fire are looked at."""
    index = fires.nonzero()[0]
    cyclist, pedestrian = pairs.cyclist_row[pairs.cyclist[index]], pairs.pedestrian_row[index]
    since_s = rows.time_s[cyclist] - (RIDER_S - EPSILON_S)
    apart_now = rows.xy_m[cyclist] - rows.xy_m[pedestrian]
    # By the filter's velocities, or by what their distance really did: either may be disturbed.
    difference = rows.velocity_mps[cyclist] - rows.velocity_mps[pedestrian]
    steady = (difference**2).sum(-1) <= RIDER_MPS**2
    fires = fires.copy()
    while len(index):
        near = _near(rows, cyclist, pedestrian)
        moved = apart_now - (rows.xy_m[cyclist] - rows.xy_m[pedestrian])
        alike = near & (steady | ((moved**2).sum(-1) <= (RIDER_MPS * RIDER_S) ** 2))
        old = rows.time_s[cyclist] <= since_s
        before = rows.previous[cyclist], rows.previous[pedestrian]
        young = ~old & ((before[0] < 0) | (before[1] < 0))
        fires[index[(old & alike) | (young & near)]] = False
        go = near & ~old & ~young
        index, since_s, apart_now, steady = index[go], since_s[go], apart_now[go], steady[go]
        cyclist, pedestrian = before[0][go], before[1][go]
    return fires


def _near(rows: TrackRows, cyclist: IndexArray, pedestrian: IndexArray) -> BoolArray:
    apart = rows.xy_m[cyclist] - rows.xy_m[pedestrian]
    return np.asarray((apart**2).sum(-1) <= RIDER_M**2)
