"""Greedy matching of tracks with detections, nearest first. Pure."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bikeped.types import FloatArray

IndexArray = npt.NDArray[np.intp]


def match_greedy(
    track: IndexArray, detection: IndexArray, cost: FloatArray, tracks: int, detections: int
) -> IndexArray:
    """Detection of each track [tracks], -1 for none: greedy, nearest first.

    `track`, `detection`, `cost` [m] are the allowed pairs in ascending (track, detection) order,
    with indices below `tracks` and `detections`. Each pair, by distance (ties: lower track, then
    lower detection), is taken if both are free: not optimal (Hungarian), as in the paper, but a
    resident can follow it on a plan. A pair that is the nearest of both is taken in that order in
    any case, so all such pairs are taken at once, in a few rounds instead of a loop over pairs.
    """
    matched = np.full(tracks, -1, np.intp)
    if len(cost) == 0:
        return matched
    order = cost.argsort(kind="stable")
    track, detection = track[order], detection[order]
    first_of_track = np.empty(tracks, np.intp)
    first_of_detection = np.empty(detections, np.intp)
    while len(track):
        rank = np.arange(len(track))
        # Written backwards, the first (nearest) pair of each is what stays.
        first_of_track[track[::-1]] = rank[::-1]
        first_of_detection[detection[::-1]] = rank[::-1]
        mutual = (first_of_track[track] == rank) & (first_of_detection[detection] == rank)
        matched[track[mutual]] = detection[mutual]
        if np.count_nonzero(mutual) == len(mutual):
            break
        taken = np.zeros(detections, np.bool_)
        taken[detection[mutual]] = True
        rest = (matched[track] < 0) & ~taken[detection]
        track, detection = track[rest], detection[rest]
    return matched
