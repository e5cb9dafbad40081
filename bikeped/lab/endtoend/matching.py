"""Matching of detections to drawn objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bikeped.detection.nms import Boxes, iou_matrix
from bikeped.lab.rendering import DrawnObject
from bikeped.types import Detections, IntArray

#: Least overlap (intersection over union) of a detection with its object.
#: Below COCO's 0.5: a pedestrian at 20 m is four pixels wide; half a pixel costs a fifth of IoU.
MIN_IOU = 0.3
#: Objects with a smaller visible share are not counted as missed.
MIN_VISIBLE = 0.25


@dataclass(frozen=True)
class DetectionMatch:
    """`object` [d]: index of the object that each detection is, or -1; `found` [o] the reverse."""

    object: IntArray
    found: IntArray


def match_detections(detections: Detections, objects: Sequence[DrawnObject]) -> DetectionMatch:
    """Greedy by overlap; a detection of the right kind comes before any of a wrong one."""
    of_detection = np.full(len(detections), -1)
    of_object = np.full(len(objects), -1)
    if len(detections) and objects:
        overlap = iou_matrix(
            detections.box_px.astype(np.float64), np.asarray([o.box_px for o in objects], float)
        )
        same = detections.kind[:, None] == np.asarray([int(o.label) for o in objects])[None, :]
        for mask in (same, ~same):
            for d, o in _best_first(np.where(mask, overlap, 0.0)):
                if of_detection[d] < 0 and of_object[o] < 0:
                    of_detection[d], of_object[o] = o, d
    return DetectionMatch(of_detection, of_object)


def _best_first(overlap: Boxes) -> list[tuple[int, int]]:
    d, o = np.nonzero(overlap >= MIN_IOU)
    order = np.argsort(-overlap[d, o], kind="stable")
    return list(zip(d[order].tolist(), o[order].tolist(), strict=True))
