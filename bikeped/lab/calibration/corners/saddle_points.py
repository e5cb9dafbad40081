"""Saddle points of the brightness, from which grids of a partly hidden board are grown.

Where four squares meet, the smoothed brightness has a saddle point. Its curvature gives the
directions of the two edges, through any lens, and which squares are light. Neighbours on a board
share an edge: light lies on the same side of it all the way from one to the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import KDTree

from bikeped.lab.calibration.corners.local_grid import nearest_level
from bikeped.types import BoolArray, Float32Array, FloatArray, ImageArray, IntArray

_SMOOTH_PX = 1.5
_IMAGE_BLUR_PX = 0.7  # of a sharp image; for the contrast only
_LEAST_CONTRAST = 12.0  # grey levels
_MOST = 2500  # of the strongest: a cluttered image has thousands
_PEAK_PX = 5  # side of the window in which a saddle is the strongest
_OFF_PX = 1.5  # from the strongest pixel to the saddle itself
_ROUND_PX = 3.0  # where the four squares about a saddle point are sampled, ...
_ROUND_SHARE = 0.3  # ... and of the contrast, what light and dark ones must differ by
_NEIGHBOURS = 32  # examined around each
_ALIGNED = np.cos(np.radians(22.0))  # a link and the edges at both ends
_ALONG = np.array([0.25, 0.4, 0.6, 0.75])  # where an edge is sampled
_ACROSS = 0.15  # to either side of it, as a share of its length
_EDGE_SHARE = 0.25  # of the contrast that an edge must keep everywhere


@dataclass(frozen=True)
class SaddlePoints:
    """Crossings `uv_px` [n, 2], `contrast` [n] grey levels, `edge` [n, 2 (type), 2] unit vectors.

    Smoothing makes right angles of slanting crossings, so edges are off by half of the difference.
    Looking along an edge of type 0, to either end, light lies to the left in the image
    (u right, v down); of type 1, to the right.
    """

    uv_px: FloatArray
    contrast: FloatArray
    edge: FloatArray

    def __len__(self) -> int:
        return len(self.uv_px)


def find_saddle_points(grey: ImageArray) -> SaddlePoints:
    """The strongest saddle points of an image [height, width]: corners, and similar structures."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _SMOOTH_PX)
    one, slope, bend = (np.array(k, np.float32) for k in ([1], [-0.5, 0, 0.5], [1, -2, 1]))
    part = [
        cv2.sepFilter2D(smooth, cv2.CV_32F, x, y)
        for x, y in ((slope, one), (one, slope), (bend, one), (slope, slope), (one, bend))
    ]
    depth = np.asarray(part[3] * part[3] - part[2] * part[4])
    peak = depth >= cv2.dilate(depth, np.ones((_PEAK_PX, _PEAK_PX), np.uint8))
    # A crossing of contrast C, smoothed by s, has the mixed derivative C / (pi s^2).
    unit = np.pi * (_SMOOTH_PX**2 + _IMAGE_BLUR_PX**2)
    peak &= depth > (_LEAST_CONTRAST / unit) ** 2
    row, column = np.nonzero(peak)
    gu, gv, uu, uv, vv = (np.asarray(p[row, column], np.float64) for p in part)
    deep = depth[row, column].astype(np.float64)
    # The saddle itself, by one step of Newton: on a mere edge that lies far off.
    off = np.stack([vv * gu - uv * gv, uu * gv - uv * gu], axis=-1) / deep[:, None]
    at = np.stack([column, row], axis=-1) + off
    size = np.array([grey.shape[1] - 1, grey.shape[0] - 1])
    near = (np.abs(off) < _OFF_PX).all(1) & (at >= 0).all(1) & (at <= size).all(1)
    which = np.flatnonzero(near)
    light = np.arctan2(2 * uv, uu - vv) / 2  # the way to where it rises fastest
    contrast = np.sqrt(deep) * unit
    which = which[
        _four_squares(np.asarray(smooth, np.float32), at[which], light[which], contrast[which])
    ]
    which = which[np.argsort(-deep[which], kind="stable")[:_MOST]]
    edge = _edges(uu[which], uv[which], vv[which])
    return SaddlePoints(at[which], contrast[which], edge)


def _four_squares(
    smooth: Float32Array, at: FloatArray, light: FloatArray, contrast: FloatArray
) -> BoolArray:
    """[n] where both light squares are lighter than both dark ones: no mere corner of a square."""
    angle = light[:, None] + np.arange(4) * np.pi / 2
    around = at[:, None] + _ROUND_PX * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    level = nearest_level(smooth, around)
    least = level[:, [0, 2]].min(1) - level[:, [1, 3]].max(1)
    return np.asarray(least > _ROUND_SHARE * contrast)


def _edges(uu: FloatArray, uv: FloatArray, vv: FloatArray) -> FloatArray:
    """[n, 2, 2] the two ways along which a saddle is flat."""
    middle = (uu + vv) / 2
    spread = np.hypot((uu - vv) / 2, uv)
    light = np.arctan2(2 * uv, uu - vv) / 2  # where it rises fastest, to both sides
    open_by = np.arctan2(np.sqrt(spread + middle), np.sqrt(np.maximum(spread - middle, 0)))
    angle = np.stack([light + open_by, light - open_by], axis=-1)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def link_neighbours(grey: ImageArray, points: SaddlePoints) -> IntArray:
    """[n, 2 (type), 2 (along the edge, against it)] each saddle's neighbour; -1 where none.

    The nearest along the edge whose own edge runs on and turns its colours, with the edge visible
    all the way; only where both find each other.
    """
    out: IntArray = np.full((len(points), 2, 2), -1, np.int64)
    if len(points) < 2:
        return out
    count = min(_NEIGHBOURS + 1, len(points))
    far, other = KDTree(points.uv_px).query(points.uv_px, count)
    source = np.repeat(np.arange(len(points)), count)
    target, length = np.asarray(other).ravel(), np.asarray(far).ravel()
    apart = (target != source) & (length > 2.0)
    source, target, length = source[apart], target[apart], length[apart]
    way = (points.uv_px[target] - points.uv_px[source]) / length[:, None]
    for kind in (0, 1):
        start = (points.edge[source, kind] * way).sum(1)
        end = (points.edge[target, 1 - kind] * way).sum(1)
        fits = np.flatnonzero((np.abs(start) > _ALIGNED) & (np.abs(end) > _ALIGNED))
        a, b = source[fits], target[fits]
        fits = fits[_visible(grey, points, a, b, light_left=kind == 0)]
        # The nearest last, so that it is the one that stays.
        fits = fits[np.argsort(-length[fits], kind="stable")]
        out[source[fits], kind, (start[fits] < 0).astype(np.intp)] = target[fits]
    return _mutual(out)


def _visible(
    grey: ImageArray, points: SaddlePoints, a: IntArray, b: IntArray, *, light_left: bool
) -> IntArray:
    """Which of the links from `a` to `b` follow an edge that is light on one side throughout."""
    step = points.uv_px[b] - points.uv_px[a]
    left = np.stack([step[:, 1], -step[:, 0]], axis=-1) * (_ACROSS if light_left else -_ACROSS)
    on = points.uv_px[a][:, None] + _ALONG[:, None] * step[:, None]
    level = [nearest_level(grey, on + side * left[:, None]) for side in (1, -1)]
    contrast = np.minimum(points.contrast[a], points.contrast[b])
    return np.flatnonzero((level[0] - level[1] > _EDGE_SHARE * contrast[:, None]).all(1))


def _mutual(found: IntArray) -> IntArray:
    """Only links that are found from both ends, along edges of opposite types."""
    out = found.copy()
    for kind in (0, 1):
        other = found[:, kind]
        back = found[other, 1 - kind]  # [n, 2, 2]; nonsense where other is -1
        known = (back == np.arange(len(found))[:, None, None]).any(2)
        out[:, kind][~known | (other < 0)] = -1
    return out
