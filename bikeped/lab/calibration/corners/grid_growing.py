"""Grids of corners grown from saddle points, neighbour by neighbour, around what hides the rest.

Where four squares meet, the smoothed brightness has a saddle point. Its curvature gives the
directions of the two edges, through any lens, and which squares are light. Neighbours on a board
share an edge: light lies on the same side of it all the way from one to the other. A grid counts
its own columns and rows; `corner_ids` finds out which ones of the board they are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from bikeped.lab.calibration.corners.local_grid import (
    LocalMap,
    crossing_score,
    local_map,
    nearest_level,
    neighbour_residual,
)
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
_FEWEST = 6  # corners that a grid begins with
_GRIDS = 3  # of a picture, the largest
_CLEAR = 0.3  # `crossing_score` of a corner
_OFF = 0.2  # squares from where the neighbours expect a corner
_SNAP = 0.25  # the same for a new one, which they can only continue to
_PARALLEL = np.cos(np.radians(25.0))  # its edges and theirs
_NEAR = 3  # columns and rows to either side that predict where a new corner lies ...
_KNOWN_BY = 5  # ... by at least so many corners
_ROUNDS = 40
_STEPS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])


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


@dataclass(frozen=True)
class CornerGrid:
    """Corners `cell` [n, 2] (column, row; whole numbers, from anywhere) at `uv_px` [n, 2].

    Columns and rows are not mirrored: rows run down where columns run to the right. `dark` says
    whether the square up-left of cell (0, 0) is a dark one.
    """

    cell: IntArray
    uv_px: FloatArray
    dark: bool

    def __len__(self) -> int:
        return len(self.cell)

    def sign(self, cell: IntArray) -> FloatArray:
        """[n] the sign of `crossing_score` at cells [n, 2] of this grid's colours: 1 or -1."""
        even = cell.sum(1) % 2 == 0
        return np.where(even == self.dark, 1.0, -1.0)

    def lights(self, cell: IntArray, step: FloatArray) -> FloatArray:
        """[n, k] what the squares at `step` [k, 2] from corners at cells [n, 2] are: 1 light,
        -1 dark."""
        return np.asarray(-self.sign(cell)[:, None] * np.sign(step[:, 0] * step[:, 1]))

    def near(self, cell: IntArray) -> LocalMap:
        """The local map from squares to pixels about any cells [m, 2], also empty ones."""
        return local_map(cell.astype(np.float64), self.cell.astype(np.float64), self.uv_px)


def find_grids(grey: ImageArray) -> list[CornerGrid]:
    """The largest grids in a picture, largest first, none with a corner of another."""
    points = find_saddle_points(grey)
    taken = np.zeros(len(points), np.bool_)
    out = []
    for number, start in enumerate(_components(points, link_neighbours(grey, points))):
        if number == _GRIDS:
            break
        if taken[start.point].any():
            continue
        grown = _grow(grey, points, start)
        if grown is not None:
            taken[grown.point] = True
            out.append(grown.grid(points))
    return sorted(out, key=len, reverse=True)


@dataclass(frozen=True)
class _SaddleGrid:
    """A grid while it grows: cells [n, 2], and which saddle point each holds [n].

    The edge along rows is of type 0 at cell (0, 0), and the types alternate.
    """

    cell: IntArray
    point: IntArray

    def keep(self, which: BoolArray | IntArray) -> _SaddleGrid:
        return _SaddleGrid(self.cell[which], self.point[which])

    def grid(self, points: SaddlePoints) -> CornerGrid:
        # Light to the left of the edge that runs right from (0, 0): above it, so dark up-left.
        return CornerGrid(self.cell, points.uv_px[self.point], True)


def _components(points: SaddlePoints, link: IntArray) -> Iterator[_SaddleGrid]:
    """The sets of linked saddle points, each numbered from a first one, largest first."""
    left = set(np.flatnonzero((link >= 0).sum((1, 2)) >= 2).tolist())
    found = []
    for seed in sorted(left, key=lambda n: (-int((link[n] >= 0).sum()), n)):
        if seed in left:
            part = _component(points, link, seed, left)
            left -= set(part.point.tolist())
            found.append(part)
    found = [part for part in found if len(part.cell) >= _FEWEST]
    yield from sorted(found, key=lambda part: -len(part.cell))


def _component(points: SaddlePoints, link: IntArray, seed: int, free: set[int]) -> _SaddleGrid:
    """Numbers a saddle point's neighbours, theirs, and so on; the first number of each stays."""
    cells = {(0, 0): seed}
    right_of = {seed: (0, 0)}  # each saddle's edge to the right: type, and 1 against the edge
    at = {seed: (0, 0)}
    waiting = deque([seed])
    while waiting:
        one = waiting.popleft()
        kind, against = right_of[one]
        right = points.edge[one, kind] * (1 - 2 * against)
        down_kind = 1 - kind
        down = points.edge[one, down_kind]
        down_against = int(right[0] * down[1] - right[1] * down[0] < 0)
        for step in _STEPS:
            along_row = step[0] != 0
            way_kind = kind if along_row else down_kind
            way = (against if along_row else down_against) ^ int(step.sum() < 0)
            other = int(link[one, way_kind, way])
            place = (at[one][0] + int(step[0]), at[one][1] + int(step[1]))
            if other not in free or other in at or place in cells:
                continue
            cells[place], at[other] = other, place
            # Types alternate; its right points as this one's does.
            way_right = points.edge[other, 1 - kind]
            travel = (points.uv_px[other] - points.uv_px[one]) * step.sum()
            if along_row:
                opposite = travel @ way_right < 0
            else:
                down = points.edge[other, kind]
                down = down if travel @ down > 0 else -down
                opposite = way_right[0] * down[1] - way_right[1] * down[0] < 0
            right_of[other] = 1 - kind, int(opposite)
            waiting.append(other)
    cell = np.array(list(cells), np.int64).reshape(-1, 2)
    return _SaddleGrid(cell, np.array(list(cells.values()), np.int64))


def _grow(grey: ImageArray, points: SaddlePoints, start: _SaddleGrid) -> _SaddleGrid | None:
    """Cleaned, continued as far as the picture shows crossings, and cleaned again."""
    now = _clean(grey, points, start)
    for _ in range(_ROUNDS):
        if now is None:
            return None
        # Two steps only where one leads nowhere: over a finger, to the other side.
        more = _next(grey, points, now, 1) or _next(grey, points, now, 2)
        if more is None:
            break
        before = len(now.cell)
        now = _clean(grey, points, more)
        if now is not None and len(now.cell) <= before:
            break
    return now


def _next(grey: ImageArray, points: SaddlePoints, now: _SaddleGrid, far: int) -> _SaddleGrid | None:
    """With the saddles that lie `far` steps on, where the grid expects them; None without any."""
    held = {(int(c), int(r)) for c, r in now.cell}
    wanted = sorted(
        {(c + int(s[0]) * far, r + int(s[1]) * far) for c, r in held for s in _STEPS} - held
    )
    cell = np.array(wanted, np.int64).reshape(-1, 2)
    close = (np.abs(cell[:, None] - now.cell[None]) <= _NEAR + far - 1).all(2)
    known = close.sum(1) >= _KNOWN_BY
    for axis in (0, 1):  # a single row does not say where the next one lies
        place = np.where(close, now.cell[None, :, axis], 10**6)
        known &= place.min(1) < np.where(close, now.cell[None, :, axis], -(10**6)).max(1)
    cell = cell[known]
    if not len(cell):
        return None
    grid = now.grid(points)
    near = grid.near(cell)
    free = np.setdiff1d(np.arange(len(points)), now.point)
    if not len(free):
        return None
    away = np.linalg.norm(points.uv_px[free][None] - near.at_px[:, None], axis=-1)
    nearest = away.argmin(1)
    point, off = free[nearest], away[np.arange(len(cell)), nearest]
    spacing = near.spacing_px
    good = off < _SNAP * spacing.min(1)
    kind = cell.sum(1) % 2
    for axis in (0, 1):
        way = near.along_px[:, :, axis] / np.maximum(spacing[:, axis, None], 1e-9)
        edge = points.edge[point, kind if axis == 0 else 1 - kind]
        good &= np.abs((edge * way).sum(1)) > _PARALLEL
    there = replace(near, at_px=points.uv_px[point])
    good &= crossing_score(grey, there) * grid.sign(cell) > _CLEAR
    # A saddle can be one corner only: of two cells that want it, the nearer has it.
    order = np.lexsort((off, point))
    order = order[good[order]]
    order = order[np.unique(point[order], return_index=True)[1]]
    if not len(order):
        return None
    cell = np.concatenate([now.cell, cell[order]])
    return _SaddleGrid(cell, np.concatenate([now.point, point[order]]))


def _clean(grey: ImageArray, points: SaddlePoints, now: _SaddleGrid) -> _SaddleGrid | None:
    """Without unclear corners and those off their neighbours' prediction; None if few are left."""
    for _ in range(len(now.cell)):
        if len(now.cell) < _FEWEST or (np.ptp(now.cell, axis=0) < 1).any():
            return None
        grid = now.grid(points)
        near = replace(grid.near(now.cell), at_px=grid.uv_px)
        seen = now.cell.astype(np.float64)
        off, _ = neighbour_residual(seen, grid.uv_px, np.ones(len(seen), np.bool_))
        unclear = crossing_score(grey, near) * grid.sign(now.cell) < _CLEAR
        if unclear.any():
            # They spoil their neighbours' maps, too: remove them at once, then check again.
            now = now.keep(~unclear)
        elif off.max() > _OFF:
            now = now.keep(np.arange(len(off)) != int(off.argmax()))
        else:
            break
    return _largest_part(now)


def _largest_part(now: _SaddleGrid) -> _SaddleGrid | None:
    """The largest connected part of a grid; gaps of one corner connect, too."""
    low = now.cell.min(0)
    at = now.cell - low
    there = np.zeros(at.max(0) + 1, np.bool_)
    there[at[:, 0], at[:, 1]] = True
    wide = there.copy()
    wide[1:-1] |= there[:-2] & there[2:]
    wide[:, 1:-1] |= there[:, :-2] & there[:, 2:]
    part = cv2.connectedComponents(wide.astype(np.uint8), connectivity=4)[1]
    mine = part[at[:, 0], at[:, 1]]
    keep = mine == int(np.bincount(mine).argmax())
    return now.keep(keep) if keep.sum() >= _FEWEST else None
