"""Greedy nearest-neighbour matching, vectorised and exact.

Greedy and not optimal (Hungarian): a resident can follow "nearest first" with a finger on the
plan, and the paper's tracker does it. The exact order is: all allowed pairs sorted by distance
(ties: lower track slot, then lower detection), each taken if both are still free. A pair that is
the nearest of its track *and* of its detection is taken by that order whatever the others do, so
all such pairs are taken at once, and the rest is looked at again: a few rounds instead of a sort.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bikeped.types import FloatArray

IndexArray = npt.NDArray[np.intp]


def match_greedy(cost: FloatArray) -> IndexArray:
    """Detection of each track [lanes, tracks], -1 for none, of `cost` [lanes, tracks, detections].

    Forbidden pairs cost infinity. `cost` is used up: it is overwritten.
    """
    lanes, tracks, detections = cost.shape
    matched = np.full((lanes, tracks), -1, np.intp)
    if tracks == 0 or detections == 0:
        return matched
    lane_index = np.arange(lanes)[:, None]
    track_index = np.arange(tracks)[None, :]
    while True:
        # argmin gives the first of equal values along each axis, which is the tie rule above.
        best_detection = cost.argmin(axis=2)
        best_cost = np.take_along_axis(cost, best_detection[..., None], 2)[..., 0]
        best_track = cost.argmin(axis=1)
        mutual = (best_track[lane_index, best_detection] == track_index) & (best_cost < np.inf)
        lane, track = np.nonzero(mutual)
        if len(lane) == 0:
            return matched
        detection = best_detection[lane, track]
        matched[lane, track] = detection
        cost[lane, track, :] = np.inf
        cost[lane, :, detection] = np.inf
