"""The three stages (paper, algorithm 1): pedestrian present, cyclist remembered, approaching."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from bikeped.decision.track_rows import IndexArray
from bikeped.types import BoolArray, FloatArray, State

_EPSILON_S = 1e-6
_IDLE, _SAFE, _WARNING, _ALERT = (int(s) for s in State)
#: State by 4 * pedestrian present + 2 * cyclist remembered + approaching.
_STATES = np.asarray([_IDLE, _IDLE, _IDLE, _IDLE, _SAFE, _SAFE, _WARNING, _ALERT], np.int8)


def resolve_state(
    pedestrian_present: BoolArray, cyclist_remembered: BoolArray, approaching: BoolArray
) -> npt.NDArray[np.int8]:
    """State codes [n]: IDLE without a pedestrian, SAFE without a remembered cyclist, else ALERT or
    WARNING by the closing check."""
    stage = pedestrian_present * np.int8(4) + cyclist_remembered * np.int8(2) + approaching
    return np.asarray(_STATES[stage])


def is_remembered(now_s: FloatArray, last_cyclist_s: FloatArray, memory_s: float) -> BoolArray:
    """[n]: whether a cyclist was tracked within the last `memory_s`; 0 s means in this frame."""
    return np.asarray(now_s - last_cyclist_s <= memory_s + _EPSILON_S)


def frame_mask(frame: IndexArray, frames: int) -> BoolArray:
    """[frames]: true at the indices in `frame`."""
    out = np.zeros(frames, np.bool_)
    out[frame] = True
    return out
