"""Greedy non-maximum suppression, exact, over arrays; and box voting.

The textbook loop keeps the strongest box, drops the weaker ones of its class that overlap it, and
repeats. Here a block of boxes is processed at a time: within the block the loop's result is the
fixed point of `keep` (row i is final after i rounds, usually a handful suffices); then all boxes
that the block's survivors overlap are dropped at once. The result is identical to the loop's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.geometry.boxes import iou_matrix
from bikeped.types import Float32Array, IntArray

_BLOCK = 192


def non_max_suppression(
    box: Float32Array, score: Float32Array, group: npt.NDArray[Any], iou: float, max_boxes: int
) -> IntArray:
    """Indices of the boxes kept, strongest first, ties in input order; at most `max_boxes`.

    `box` [n, 4] finite, in x1, y1, x2, y2; `score` [n]; `group` [n], boxes of different groups
    never suppress one another. A weaker box is dropped where its IoU with a kept one exceeds `iou`.
    """
    order = np.argsort(-score, kind="stable")
    kept: list[IntArray] = []
    count = 0
    while len(order) and count < max_boxes:
        block, order = order[:_BLOCK], order[_BLOCK:]
        survivors = block[_keep_in_block(box[block], group[block], iou)]
        kept.append(survivors)
        count += len(survivors)
        if len(order):
            suppressed = iou_matrix(box[survivors], box[order]) > iou
            suppressed &= group[survivors][:, None] == group[order][None, :]
            order = order[~suppressed.any(axis=0)]
    if not kept:
        return np.zeros(0, np.int64)
    return np.concatenate(kept)[:max_boxes].astype(np.int64)


def vote_boxes(
    box: Float32Array, score: Float32Array, group: npt.NDArray[Any], keep: IntArray, overlap: float
) -> Float32Array:
    """Box voting: the boxes [k, 4] of `keep` [k], averaged with the boxes that overlap them.

    A box becomes the score-weighted mean of the boxes of its group that overlap it by `overlap` or
    more, itself included (Gidaris and Komodakis 2015, "Object detection via a multi-region and
    semantic segmentation-aware CNN model", section 5), which reduces its jitter from frame to
    frame: the cell with the best score has not always the best edges. `overlap` 1 changes nothing.
    """
    if overlap >= 1:
        return box[keep]
    near = iou_matrix(box[keep], box) >= overlap
    near &= group[keep][:, None] == group[None, :]
    near[np.arange(len(keep)), keep] = True  # also without area
    weight = near * np.maximum(score, np.finfo(np.float32).tiny)[None, :]
    voted: Float32Array = (weight @ box) / weight.sum(axis=1, keepdims=True)
    return voted


def _keep_in_block(box: Float32Array, group: npt.NDArray[Any], iou: float) -> npt.NDArray[np.bool_]:
    """Which boxes of one block, strongest first, the greedy algorithm keeps."""
    over = (iou_matrix(box, box) > iou) & (group[:, None] == group[None, :])
    beats = np.triu(over, 1).astype(np.float32)  # [stronger, weaker]
    keep = np.ones(len(box), np.bool_)
    while True:
        again = keep.astype(np.float32) @ beats == 0
        if np.array_equal(again, keep):
            return keep
        keep = again
