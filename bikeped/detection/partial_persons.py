"""Suppresses a person's upper half beside the whole person.

For a person whose legs are hard to see, detectors return both boxes. They overlap by about half,
which suppression lets pass, and the bottom of the upper box is not at the feet: on the ground it
would be a second pedestrian, metres behind the first, that closes in with it.
"""

from __future__ import annotations

import numpy as np

from bikeped.geometry.boxes import intersection_area
from bikeped.types import BoolArray, Detections, Kind

# At least this share of the half lies within the whole; it
_WITHIN = 0.85
# starts within this share of the whole's height from its top (a child in front: lower),
_TOP = 0.2
# is lower than this share of it (else ordinary suppression applies),
_HEIGHT = 0.8
# and is at least this share as wide (a narrow person within a group's box is a person).
_WIDTH = 0.5


def suppress_partial_person_boxes(found: Detections) -> Detections:
    """The detections without pedestrians that are another's upper half, most confident first.

    The whole gets the greater confidence of the two. Without such a half, `found` itself.
    """
    person = np.nonzero(found.kind == Kind.PEDESTRIAN)[0]
    if len(person) < 2:
        return found
    half = _is_half(found.box_px[person].astype(np.float64))
    if not half.any():
        return found
    score = found.confidence.copy()
    own = found.confidence[person]
    best = np.where(half, own[:, None], 0).max(axis=0)
    score[person] = np.maximum(own, best)
    left = np.setdiff1d(np.arange(len(found)), person[half.any(axis=1)])
    order = left[np.argsort(-score[left], kind="stable")]
    return Detections(found.kind[order], score[order], found.box_px[order])


def _is_half(box: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> BoolArray:
    """[n, n]: whether the row's box is the upper half of the column's."""
    small, large = box[:, None, :], box[None, :, :]
    small_wide, small_high = small[..., 2] - small[..., 0], small[..., 3] - small[..., 1]
    large_wide, large_high = large[..., 2] - large[..., 0], large[..., 3] - large[..., 1]
    return np.asarray(
        (intersection_area(small, large) >= _WITHIN * small_wide * small_high)
        & (np.abs(small[..., 1] - large[..., 1]) <= _TOP * large_high)
        & (small_high < _HEIGHT * large_high)
        & (small_wide >= _WIDTH * large_wide)
    )
