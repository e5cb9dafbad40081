"""Greedy non-maximum suppression, exact, over arrays.

The plain algorithm takes the strongest box, drops the weaker ones of its class that overlap it, and
goes on. Here a block of boxes is settled at a time: within the block, `keep` is what the plain
algorithm keeps once it stops changing (row i is final after i rounds at most, in practice after a
handful); then everything that the block's survivors overlap is dropped at once. The result is the
plain algorithm's, not an approximation, at a small share of its time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.geometry.boxes import iou_matrix
from bikeped.types import Float32Array, IntArray

_BLOCK = 192


def non_max_suppression(
    box: Float32Array,
    score: Float32Array,
    group: npt.NDArray[Any],
    iou: float,
    most: int,
) -> IntArray:
    """Indices of the boxes kept, strongest first, equal scores in their own order; `most` at most.

    `box` [n, 4] finite, in x1, y1, x2, y2; `score` [n]; `group` [n], boxes of different groups
    never suppress one another. A weaker box goes where its overlap with a kept one exceeds `iou`.
    """
    order = np.argsort(-score, kind="stable")
    kept: list[IntArray] = []
    count = 0
    while len(order) and count < most:
        block, order = order[:_BLOCK], order[_BLOCK:]
        survivors = block[_settle(box[block], group[block], iou)]
        kept.append(survivors)
        count += len(survivors)
        if len(order):
            hit = iou_matrix(box[survivors], box[order]) > iou
            hit &= group[survivors][:, None] == group[order][None, :]
            order = order[~hit.any(axis=0)]
    if not kept:
        return np.zeros(0, np.int64)
    return np.concatenate(kept)[:most].astype(np.int64)


def vote_boxes(
    box: Float32Array,
    score: Float32Array,
    group: npt.NDArray[Any],
    keep: IntArray,
    overlap: float,
) -> Float32Array:
    """The boxes [k, 4] of those in `keep` [k], each steadied by what else was boxed there.

    A box becomes the mean, weighted by score, of the boxes of its group that overlap it by
    `overlap` or more, itself among them (Gidaris and Komodakis 2015, "Object detection via a
    multi-region and semantic segmentation-aware CNN model", section 5: bounding box voting). The
    cell with the best score is not the one with the best edges; where a dozen agree, their mean
    trembles less from frame to frame. With `overlap` 1 every box stays as it is.
    """
    if overlap >= 1:
        return box[keep]
    near = iou_matrix(box[keep], box) >= overlap
    near &= group[keep][:, None] == group[None, :]
    near[np.arange(len(keep)), keep] = True  # also a box without area
    weight = near * np.maximum(score, np.finfo(np.float32).tiny)[None, :]
    merged: Float32Array = (weight @ box) / weight.sum(axis=1, keepdims=True)
    return merged


def _settle(box: Float32Array, group: npt.NDArray[Any], iou: float) -> npt.NDArray[np.bool_]:
    """Which boxes of one block, strongest first, the greedy algorithm keeps."""
    over = (iou_matrix(box, box) > iou) & (group[:, None] == group[None, :])
    beats = np.triu(over, 1).astype(np.float32)  # [stronger, weaker]
    keep = np.ones(len(box), np.bool_)
    while True:
        again = keep.astype(np.float32) @ beats == 0
        if np.array_equal(again, keep):
            return keep
        keep = again
