"""Area and overlap of boxes, arrays of x1, y1, x2, y2 in the last axis. Pure."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Boxes = npt.NDArray[np.floating[Any]]


def box_area(box: Boxes) -> Boxes:
    """Areas [...] of boxes [..., 4]; negative sides are not checked for."""
    return np.asarray((box[..., 2] - box[..., 0]) * (box[..., 3] - box[..., 1]))


def intersection_area(a: Boxes, b: Boxes) -> Boxes:
    """Areas [...] that boxes `a` and `b` ([..., 4] each, broadcast) share; 0 where they touch."""
    width = np.minimum(a[..., 2], b[..., 2]) - np.maximum(a[..., 0], b[..., 0])
    height = np.minimum(a[..., 3], b[..., 3]) - np.maximum(a[..., 1], b[..., 1])
    return np.asarray(np.maximum(width, 0) * np.maximum(height, 0))


def iou_matrix(a: Boxes, b: Boxes) -> Boxes:
    """Intersection over union [n, m] of boxes `a` [n, 4] and `b` [m, 4]; 0 without any area."""
    shared = intersection_area(a[:, None], b[None])
    union = box_area(a)[:, None] + box_area(b)[None] - shared
    return np.asarray(shared / np.maximum(union, np.finfo(np.float32).tiny))
