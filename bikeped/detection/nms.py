"""Greedy non-maximum suppression by OpenCV, and box voting."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bikeped.geometry.boxes import iou_matrix
from bikeped.types import Float32Array, IntArray

_ANY_SCORE = -1.0


def non_max_suppression(
    box: Float32Array, score: Float32Array, group: npt.NDArray[Any], iou: float, max_boxes: int
) -> IntArray:
    """Indices of the boxes kept, strongest first, ties in input order; at most `max_boxes`.

    `box` [n, 4] finite, with area, in x1, y1, x2, y2; `score` [n]; `group` [n], boxes of different
    groups never suppress one another. A weaker box is dropped where its IoU with a kept one
    exceeds `iou`.
    """
    xywh = np.hstack([box[:, :2], box[:, 2:].astype(np.float64) - box[:, :2]]).tolist()
    groups = group.astype(int).tolist()
    # The strongest few usually leave enough boxes; the rest of a crowd need not be compared then.
    for strongest in (4 * max_boxes, 0):  # 0: all
        kept = cv2.dnn.NMSBoxesBatched(
            xywh, score.tolist(), groups, _ANY_SCORE, iou, top_k=strongest
        )
        if len(kept) >= max_boxes or strongest >= len(xywh):
            break
    return np.asarray(kept, np.int64)[:max_boxes]


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
