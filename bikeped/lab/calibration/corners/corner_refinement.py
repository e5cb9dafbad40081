"""Corners to hundredths of a pixel: two blurred crossing edges, fitted to the image's pixels.

cv2.cornerSubPix assumes straight edges and a square window; on drawn boards that fill a fisheye
image its error is 0.038 px where this one's is 0.016. Here each corner's neighbours give the bend
of both edges and the size of a square along them. The window is a share of that square, and
position, directions, blur and brightness are fitted to the pixels, without interpolation:

    I = a0 + a1 u + a2 v + (a3 + a4 u + a5 v) S + a6 S^2
    S = erf(tx / (sqrt2 s)) erf(ty / (sqrt2 s))

with tx, ty the distances in pixels to the two edges and s the blur. The S^2 term models white that
bleeds into black. Weak priors keep small squares from being over-fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import erf

from bikeped.lab.calibration.corners.local_grid import LocalMap, local_map
from bikeped.types import BoolArray, Float32Array, FloatArray, ImageArray, IntArray

_SHARE = 0.3  # of a square, to either side of the corner ...
_SMALL_PX = 6.0  # ... but at least this many pixels, as long as
_SHARE_MOST = 0.6  # the next edge, smoothed, stays out of the window
_SAMPLES = 10  # pixels to either side, at most; of wider windows only the edges' surroundings ...
_ALONG = 14  # ... at this many places to either side
_BLUR_PX = 0.7  # of a sharp image
_STEPS = (3, 5)  # of each pass: the first ends near, the second has its window in the right place
_CONVERGED_PX = 0.002
# Standard deviations of the priors, in units of the window's contrast where they are grey levels.
_NOISE = 0.05
_PRIOR_ANGLE = 0.08
_PRIOR_BLUR = 0.4  # of its logarithm
_PRIOR_SLOPE = 0.05
_PRIOR_BLEED = 0.1
_OUTLIER = np.float32(0.3)  # of half the window's contrast: residuals beyond weigh less
_ROOT = np.sqrt(2.0)


#: [12] inverse variances of the edge parameters and the grey terms.
_PRIOR: FloatArray = np.zeros(12)
_PRIOR[[0, 2]], _PRIOR[4] = _PRIOR_ANGLE**-2, _PRIOR_BLUR**-2
_PRIOR[[6, 7, 9, 10]], _PRIOR[11] = _PRIOR_SLOPE**-2, _PRIOR_BLEED**-2
_PRIOR *= _NOISE**2
_PRIOR[[1, 3, 5, 8]] = 1e-6


@dataclass(frozen=True)
class RefinedCorners:
    """Corners [n, 2], and how well each fits.

    `blur_px` [n] standard deviation of the edges' smoothing; `contrast` [n] grey levels between
    dark and light; `residual` [n] root mean square residual over the contrast; `shift_px` [n]
    distance from the start.
    """

    uv_px: FloatArray
    blur_px: FloatArray
    contrast: FloatArray
    residual: FloatArray
    shift_px: FloatArray


def refine_corners(grey: ImageArray, position: FloatArray, uv_px: FloatArray) -> RefinedCorners:
    """Refines corners `uv_px` [n, 2] at board positions [n, 2] (column, row) on the image.

    They must be within about a pixel and a half, or a fifth of a square, of the truth.
    """
    start, uv = uv_px, uv_px
    blur = _BLUR_PX
    for steps in _STEPS:
        near = replace(local_map(position, position, uv), at_px=uv)
        window = _window(grey, near, uv, blur)
        fitted = _fit(window, blur, steps)
        uv = uv + fitted.uv_px
        blur = float(np.clip(np.median(fitted.blur_px), 0.3, 5.0))
    return replace(fitted, uv_px=uv, shift_px=np.linalg.norm(uv - start, axis=1))


@dataclass(frozen=True)
class _Window:
    """The pixels of each corner's window: offsets, levels, and where the bent edges run."""

    du: Float32Array  # [n, k] pixels from the corner
    dv: Float32Array
    level: Float32Array  # [n, k], 0 in the middle and -1 and 1 at the window's extremes
    scale: FloatArray  # [n] grey levels for one of these
    inside: Float32Array  # [n, k] 1 or 0
    bent: Float32Array  # [n, 2, k] what the bend adds to the distance from either edge, pixels
    across: FloatArray  # [n, 2] direction across either edge, radians
    half_px: FloatArray  # [n] of the whole window
    bend_factors: FloatArray  # [n, 2, 3] the same as factors of du^2, du dv, dv^2


def _window(grey: ImageArray, near: LocalMap, uv: FloatArray, blur_px: float) -> _Window:
    height, width = grey.shape
    spacing = np.maximum(near.spacing_px, 1e-6)
    share = np.clip(_SMALL_PX / spacing, _SHARE, _SHARE_MOST)
    half = np.ceil((np.abs(near.along_px) * share[:, None, :]).sum(2).max(1))
    half = np.clip(half, 2, 4 * _SAMPLES)
    base = np.rint(uv).astype(np.intp)
    if half.max() <= _SAMPLES:
        step = np.arange(-int(half.max()), int(half.max()) + 1)
        columns, rows = (side.ravel()[None] for side in np.meshgrid(step, step))
        columns, rows = base[:, :1] + columns, base[:, 1:] + rows
    else:
        columns, rows = _along_edges(near, share, blur_px)
    exists = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    value = grey[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)].astype(np.float64)
    du = (columns - uv[:, 0, None]).astype(np.float32)
    dv = (rows - uv[:, 1, None]).astype(np.float32)

    # Board steps of each pixel to second order: x = J^-1 (d - B(J^-1 d)).
    inverse = _inverse(near.along_px)
    turn = _quadratic_of(near.bend_px, inverse)
    bend = -inverse @ turn  # [n, 2, 3] squares per pixel^2
    square = np.stack([du * du, du * dv, dv * dv], axis=1)
    bent = bend.astype(np.float32) @ square
    flat = inverse.astype(np.float32) @ np.stack([du, dv], axis=1)
    inside = exists & (np.abs(flat + bent) < share[:, :, None]).all(1)
    per_px = np.maximum(np.linalg.norm(inverse, axis=2), 1e-12)  # squares per pixel across an edge

    low = np.where(inside, value, np.inf).min(1)
    high = np.where(inside, value, -np.inf).max(1)
    few = inside.sum(1) < 12
    low, high = np.where(few, 0.0, low), np.where(few, 255.0, high)
    scale = np.maximum((high - low) / 2, 2.0)
    return _Window(
        du,
        dv,
        ((value - ((high + low) / 2)[:, None]) / scale[:, None]).astype(np.float32),
        scale,
        inside.astype(np.float32),
        bent / per_px[:, :, None].astype(np.float32),
        np.arctan2(inverse[:, :, 1], inverse[:, :, 0]),
        np.maximum(half, 1.0),
        bend / per_px[:, :, None],
    )


def _along_edges(near: LocalMap, share: FloatArray, blur_px: float) -> tuple[IntArray, IntArray]:
    """Columns and rows [n, k] of the pixels about both edges: only these hold information."""
    along = np.linspace(-1, 1, 2 * _ALONG + 1)
    reach = int(np.clip(np.ceil(3 * blur_px + 1.5), 3, 2 * _SAMPLES))
    across = np.arange(-reach, reach + 1) * max(1.0, reach / _SAMPLES)
    both = []
    for axis in (0, 1):
        step = np.zeros((len(share), len(along), 2))
        step[..., axis] = along * share[:, axis, None]
        edge = near.at_steps(step)
        way = near.along_px[:, :, axis] / near.spacing_px[:, axis, None]
        normal = np.stack([-way[:, 1], way[:, 0]], axis=-1)
        pixel = edge[:, :, None] + normal[:, None, None] * across[:, None]
        both.append(np.rint(pixel).astype(np.intp).reshape(len(share), -1, 2))
    pixels = np.concatenate(both, axis=1)
    return pixels[..., 0], pixels[..., 1]


def _inverse(matrix: FloatArray) -> FloatArray:
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    area = a * d - b * c
    area = np.where(np.abs(area) < 1e-9, 1e-9, area)
    return np.stack([d, -b, -c, a], axis=-1).reshape(-1, 2, 2) / area[:, None, None]


def _quadratic_of(bend: FloatArray, linear: FloatArray) -> FloatArray:
    """B(L d) as factors [n, 2, 3] of du^2, du dv, dv^2; L: matrices [n, 2, 2]."""
    a, b, c, d = linear[:, 0, 0], linear[:, 0, 1], linear[:, 1, 0], linear[:, 1, 1]
    rows = [(a * a, 2 * a * b, b * b), (a * c, a * d + b * c, b * d), (c * c, 2 * c * d, d * d)]
    return np.asarray(bend @ np.stack([np.stack(row, -1) for row in rows], axis=1))


def _fit(window: _Window, blur_px: float, steps: int) -> RefinedCorners:
    """Gauss-Newton over all corners at once: directions, offsets, blur, and seven grey terms.

    `uv_px` of the result is from each window's corner. Pixels in single precision: 48 corners of
    500 pixels take a millisecond a step.
    """
    count, pixels = window.du.shape
    edge = np.zeros((count, 5))
    edge[:, [0, 2]], edge[:, 4] = window.across, np.log(blur_px)
    middle = edge.copy()
    half = window.half_px[:, None].astype(np.float32)
    u, v = window.du / half, window.dv / half
    grey: FloatArray = np.zeros((count, 7))
    grey[:, 3] = _contrast_sign(window)
    # Derivatives by the five edge parameters and the seven grey ones: 1 u v S Su Sv S^2.
    columns: Float32Array = np.empty((count, 12, pixels), np.float32)
    basis = columns[:, 5:]
    basis[:, 0], basis[:, 1], basis[:, 2] = 1.0, u, v
    left: Float32Array = np.empty((count, pixels), np.float32)
    for step_number in range(steps + 1):
        _edges(window, edge, columns)
        basis[:, 4], basis[:, 5] = basis[:, 3] * u, basis[:, 3] * v
        basis[:, 6] = basis[:, 3] * basis[:, 3]
        factors = grey.astype(np.float32)
        left = window.level - (factors[:, None] @ basis)[:, 0]
        if step_number == steps:
            break
        # Low weight for an occluding object, a glare or the image circle's rim in the window.
        weight = window.inside / (1 + (left / _OUTLIER) ** 2)
        # d level / d S = a3 + a4 u + a5 v + 2 a6 S
        slope = (factors[:, None, [3, 4, 5]] @ basis[:, :3])[:, 0]
        columns[:, :5] *= (slope + 2 * factors[:, 6, None] * basis[:, 3])[:, None]
        weighted = columns * weight[:, None]
        normal = (weighted @ columns.transpose(0, 2, 1)).astype(np.float64)
        normal[:, np.arange(12), np.arange(12)] += _PRIOR
        right = (weighted @ left[..., None])[..., 0].astype(np.float64)
        right[:, :5] += _PRIOR[:5] * np.where(np.arange(5) % 2 == 0, middle - edge, 0.0)
        right[:, 5:] -= _PRIOR[5:] * grey
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        step[:, [0, 2, 4]] = np.clip(step[:, [0, 2, 4]], -0.3, 0.3)
        step[:, [1, 3]] = np.clip(step[:, [1, 3]], -1.0, 1.0)
        edge, grey = edge + step[:, :5], grey + step[:, 5:]
        edge[:, 4] = np.clip(edge[:, 4], np.log(0.25), np.log(12.0))
        if np.quantile(np.abs(step[:, [1, 3]]), 0.98) < _CONVERGED_PX:
            break
    swing = np.maximum(np.abs(grey[:, 3]), 1e-3)
    pixels_used = np.maximum(window.inside.sum(1), 1)
    residual = np.sqrt((window.inside * left * left).sum(1) / pixels_used) / swing
    shift = _intersection(window, edge)
    contrast = 2 * swing * window.scale
    return RefinedCorners(shift, np.exp(edge[:, 4]), contrast, residual, np.zeros(count))


def _contrast_sign(window: _Window) -> FloatArray:
    """[n] 1 or -1: whether the pixels' sign is that of the crossing, or its opposite."""
    sign = np.ones_like(window.level)
    for axis in (0, 1):
        across = window.across[:, axis, None]
        t = np.cos(across) * window.du + np.sin(across) * window.dv + window.bent[:, axis]
        sign *= np.sign(t)
    return np.where((sign * window.level * window.inside).sum(1) >= 0, 1.0, -1.0)


def _edges(window: _Window, edge: FloatArray, out: Float32Array) -> None:
    """Fills `out` [n, 0 to 4, k] with the derivatives of the crossing's shape S by the five edge
    parameters, and [n, 8, k] with S."""
    cos, sin = np.cos(edge[:, [0, 2]]), np.sin(edge[:, [0, 2]])
    root = (_ROOT * np.exp(edge[:, 4])).astype(np.float32)[:, None]
    distance, turned, profile, peak = [], [], [], []
    for axis in (0, 1):
        c, s = (side[:, axis, None].astype(np.float32) for side in (cos, sin))
        offset = edge[:, 2 * axis + 1, None].astype(np.float32)
        t = (c * window.du + s * window.dv + window.bent[:, axis] - offset) / root
        distance.append(t)
        turned.append((c * window.dv - s * window.du) / root)
        profile.append(erf(t))
        peak.append(np.float32(2 / np.sqrt(np.pi)) * np.exp(-t * t))
    for axis in (0, 1):
        pull = peak[axis] * profile[1 - axis]
        out[:, 2 * axis] = pull * turned[axis]
        out[:, 2 * axis + 1] = -pull / root
        if axis == 0:
            out[:, 4] = -pull * distance[0]
        else:
            out[:, 4] -= pull * distance[1]
    out[:, 8] = profile[0] * profile[1]


def _intersection(window: _Window, edge: FloatArray) -> FloatArray:
    """[n, 2] where the two bent edges cross, pixels from the window's corner."""
    angle = edge[:, [0, 2]]
    inverse = _inverse(np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    at: FloatArray = np.zeros((len(edge), 2))
    for _ in range(4):
        square = np.stack([at[:, 0] ** 2, at[:, 0] * at[:, 1], at[:, 1] ** 2], axis=-1)
        bent = (window.bend_factors @ square[..., None])[..., 0]
        at = (inverse @ (edge[:, [1, 3]] - bent)[..., None])[..., 0]
    return at


def is_edge_crossing(refined: RefinedCorners, spacing_px: FloatArray) -> BoolArray:
    """[n] which corners are crossings of two edges: contrast, small residual, small shift."""
    near = refined.shift_px < np.maximum(1.5, 0.25 * spacing_px)
    return (refined.residual < 0.35) & (refined.contrast > 12) & near
