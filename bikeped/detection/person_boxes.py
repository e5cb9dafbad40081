"""Boxes of persons: joins riders with their cycles, drops a second box of one person.

Detectors trained on COCO return two boxes for a rider, `person` and `bicycle`. Unjoined, every
cyclist would carry a pedestrian along, closing in on it forever. The joined box is the union, so
its bottom centre is on the wheel line; its confidence is the cycle's, for a confident person over
what may be a bicycle is not a confident cyclist.

A person beside, in front of or behind a cycle stays a pedestrian: the cycle must cover the person
from the waist down, the person's middle must be over the cycle, the feet near the wheel line and
the sizes in proportion. Each cycle takes one rider and each rider one cycle, best cover first
(greedy: competing pairs are rare, and the best pair is then the right one). A cycle without a rider
stays a cyclist; `join_riders` drops a weak one.

For a person whose legs are hard to see, detectors return the upper half beside the whole. They
overlap by about half, which suppression lets pass, and the upper box does not end at the feet: on
the ground it would be a second pedestrian, metres behind the first, that closes in with it.
"""

from __future__ import annotations

import numpy as np

from bikeped.geometry.boxes import box_area, intersection_area
from bikeped.types import BoolArray, Detections, Float32Array, Kind

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


# The feet against the wheel line, as shares of the cycle's height: farther below it is someone in
# front, farther above it someone behind.
_MAX_FEET_BELOW, _MAX_FEET_ABOVE = 0.25, 0.55
# Detectors often end a rider's box where the frame of the bicycle hides the legs. Such a box may
# end this far above the wheel line if head to wheel line is no more than a rider's: someone walking
# behind stands higher in the picture. (In the clip that the tests use, every rider is cut so.)
_MAX_CUT_ABOVE, _MAX_CUT_SPAN = 0.9, 2.0
# Person's height over the cycle's. A whole rider measures 1.2 to 2.2 of a bicycle, about one of a
# box that holds both; the bounds leave room for half-seen riders and for partial boxes.
_MIN_RATIO, _MAX_RATIO = 0.4, 3.5
# A second box of one rider shares this much of the smaller box with the first.
_MIN_SAME_RIDER = 0.8
# A part of a cycle (a wheel, a half) lies by this share of its area within the joined box, and is
# no larger than this share of it.
_MIN_PART_WITHIN, _MAX_PART_SIZE = 0.6, 0.5


def join_riders(found: Detections, overlap: float, confidence: float) -> Detections:
    """The detections with every rider and cycle joined to one cyclist, most confident first.

    `overlap` is `detection.rider_overlap`; 1 joins nothing. `confidence` is `detection.confidence`:
    cycles below it count only under a rider of at least that confidence. A faint cycle alone is
    noise; under a person it shows that the person is a cyclist. Equal confidences keep their order.
    """
    person = np.nonzero(found.kind == Kind.PEDESTRIAN)[0]
    cycle = np.nonzero(found.kind == Kind.CYCLIST)[0]
    box, score = found.box_px.copy(), found.confidence.copy()
    dropped = (found.kind == Kind.CYCLIST) & (score < confidence)
    ridden: BoolArray = np.zeros(len(found), np.bool_)
    if overlap < 1 and len(person) and len(cycle):
        pairs, fits = _pairs(found.box_px[person], found.box_px[cycle], overlap)
        ridden[cycle[[j for _, j in pairs]]] = True
        riding = np.zeros(len(found), np.bool_)
        riding[person[[i for i, _ in pairs]]] = True
        dropped |= riding
        dropped &= ~ridden
        for i, j in pairs:
            rider, own = person[i], cycle[j]
            box[own, :2] = np.minimum(box[rider, :2], box[own, :2])
            box[own, 2:] = np.maximum(box[rider, 2:], box[own, 2:])
            # A second box of the rider (head and shoulders) must not stay a pedestrian, nor a wheel
            # of the cycle another cyclist.
            shared = intersection_area(found.box_px[person], found.box_px[rider])
            area = box_area(found.box_px[person])
            least = np.minimum(area, area[i])
            dropped[person[fits[:, j] & (shared >= _MIN_SAME_RIDER * least)]] = True
            shared = intersection_area(found.box_px[cycle], box[own])
            area = box_area(found.box_px[cycle])
            part = (shared >= _MIN_PART_WITHIN * area) & (
                area <= _MAX_PART_SIZE * box_area(box[own])
            )
            fainter = found.confidence[cycle] <= max(score[rider], score[own])
            dropped[cycle[part & ~ridden[cycle] & fainter]] = True
    left = np.nonzero(~dropped)[0]
    order = left[np.argsort(-score[left], kind="stable")]
    return Detections(found.kind[order], score[order], box[order], ridden[order])


def _pairs(
    person: Float32Array, cycle: Float32Array, overlap: float
) -> tuple[list[tuple[int, int]], BoolArray]:
    """Rider and cycle of boxes [n, 4] and [m, 4], each used once: best cover first, then the
    smaller offset; and which persons could ride which cycles [n, m]."""
    p, c = person.astype(np.float64)[:, None, :], cycle.astype(np.float64)[None, :, :]
    legs = p.copy()  # from the waist down
    legs[..., 1] = (p[..., 1] + p[..., 3]) / 2
    # The share of the person from the waist down that the cycle's box covers.
    cover = intersection_area(legs, c) / np.maximum(box_area(legs), 1e-9)
    tall = np.maximum(c[..., 3] - c[..., 1], 1e-9)
    # Between the middles, as a share of the cycle's width.
    middle = (p[..., 0] + p[..., 2]) / 2
    offset = np.abs(middle - (c[..., 0] + c[..., 2]) / 2) / np.maximum(c[..., 2] - c[..., 0], 1e-9)
    feet = (p[..., 3] - c[..., 3]) / tall  # below the wheel line is positive
    span = (c[..., 3] - p[..., 1]) / tall
    ratio = (p[..., 3] - p[..., 1]) / tall
    stands = (feet >= -_MAX_FEET_ABOVE) | ((feet >= -_MAX_CUT_ABOVE) & (span <= _MAX_CUT_SPAN))
    fits = stands & (feet <= _MAX_FEET_BELOW) & (offset <= 0.5) & (cover >= overlap) & (cover > 0)
    fits &= (ratio >= _MIN_RATIO) & (ratio <= _MAX_RATIO)
    i, j = np.nonzero(fits)
    # Rounded: covers that differ in the last digit only are equal.
    order = np.lexsort((j, i, offset[i, j], -np.round(cover[i, j], 2)))
    pairs: list[tuple[int, int]] = []
    for a, b in zip(i[order].tolist(), j[order].tolist(), strict=True):
        if all(a != rider and b != ridden for rider, ridden in pairs):
            pairs.append((a, b))
    return pairs, fits
