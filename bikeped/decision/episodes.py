"""Where alerts begin and end: one definition for messages, summaries, pages and figures. Pure.

An alert episode is a maximal run of consecutive frames (or shown signals) in ALERT; it is counted
at its onset, the first of them. The functions take whole arrays, `EpisodeTracker` one frame after
another.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import numpy.typing as npt

from bikeped.types import BoolArray, IntArray

Change = Literal["begins", "lasts", "ends", "none"]


def runs(codes: npt.ArrayLike) -> IntArray:
    """Runs [r, 2] of equal neighbours in `codes` [f]: first frame, and the one after the last."""
    array = np.asarray(codes)
    if len(array) == 0:
        return np.zeros((0, 2), np.int64)
    edges = np.flatnonzero(array[1:] != array[:-1]) + 1
    return np.stack([np.r_[0, edges], np.r_[edges, len(array)]], axis=1)


def onsets(active: BoolArray, scene_start: npt.ArrayLike = ()) -> BoolArray:
    """Frames [f] at which an episode begins, from the frames [f] in which it is active.

    `scene_start` lists the first frame of each independent scene; no episode spans two scenes.
    """
    before = np.r_[False, active[:-1]] if len(active) else active
    before[np.asarray(scene_start, np.int64)] = False
    return np.asarray(active & ~before)


class EpisodeTracker:
    """Follows episodes frame by frame."""

    def __init__(self) -> None:
        self.count = 0  #: episodes that have begun
        self.active = False

    def update(self, active: bool) -> Change:
        """Takes the next frame; what it is to the episode."""
        before, self.active = self.active, active
        if active:
            self.count += not before
            return "lasts" if before else "begins"
        return "ends" if before else "none"
