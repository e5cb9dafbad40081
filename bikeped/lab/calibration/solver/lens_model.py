"""What is fitted: a lens, one pose a picture, and perhaps the board's shape; as arrays.

All pictures lie in one grid [views, corners]: a corner that a picture does not show has `seen`
False and weighs nothing. That costs a little arithmetic on partial boards and lets numpy do the
whole set at once. Camera axes are OpenCV's: x right, y down, z along the optical axis, so that a
board beside or behind the lens plane has z <= 0; the angle is atan2(hypot(x, y), z) and never
divides by z. Lengths are in squares of the board.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bikeped.geometry.lens import Projection, unit_angle, unit_radius
from bikeped.lab.calibration.board_view import BoardPattern, BoardView
from bikeped.types import BoolArray, FloatArray, IntArray

#: Shared parameters before the radial terms: cx, cy, f.
PLAIN = 3


@dataclass(frozen=True)
class Model:
    """Which lens is fitted: a projection and how many radial terms (0, or 1 to 4)."""

    projection: Projection
    terms: int = 0
    board: bool = False  #: whether the board's shape is fitted, too

    @property
    def name(self) -> str:
        """As in the JSON of `bikeped calibrate`: `equidistant+k4+board`."""
        radial = f"+k{self.terms}" if self.terms else ""
        return f"{self.projection}{radial}{'+board' if self.board else ''}"

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names of the lens's parameters, in the order in which they are fitted."""
        return ("cx", "cy", "f", *(f"k{n}" for n in range(1, self.terms + 1)))


@dataclass(frozen=True)
class Sightings:
    """Where which corner was seen: `uv_px` [V, C, 2] (0 where unseen), `seen` [V, C]."""

    pattern: BoardPattern
    names: tuple[str, ...]
    width: int
    height: int
    uv_px: FloatArray
    seen: BoolArray

    @staticmethod
    def of(pattern: BoardPattern, views: Sequence[BoardView]) -> Sightings:
        """Pictures of one size, as `Found` holds them."""
        uv = np.zeros((len(views), pattern.count, 2))
        seen = np.zeros((len(views), pattern.count), np.bool_)
        for row, view in enumerate(views):
            uv[row, view.ids] = view.uv_px
            seen[row, view.ids] = True
        first = views[0]
        names = tuple(view.name for view in views)
        return Sightings(pattern, names, first.width, first.height, uv, seen)

    def __len__(self) -> int:
        return len(self.names)

    def views(self) -> list[BoardView]:
        """Back to one view a picture."""
        return [
            BoardView(name, np.flatnonzero(seen), uv[seen], self.width, self.height)
            for name, uv, seen in zip(self.names, self.uv_px, self.seen, strict=True)
        ]

    def rows(self, keep: BoolArray | IntArray) -> Sightings:
        """Some of the pictures."""
        index = np.arange(len(self))[keep]
        names = tuple(self.names[i] for i in index)
        return replace(self, names=names, uv_px=self.uv_px[index], seen=self.seen[index])

    def without(self, left_out: BoolArray) -> Sightings:
        """Without some corners [V, C]."""
        return replace(self, seen=self.seen & ~left_out)

    def renumbered(self, source: IntArray) -> Sightings:
        """Corner `source[v, c]` takes the number c in picture v."""
        return replace(
            self,
            uv_px=np.take_along_axis(self.uv_px, source[..., None], axis=1),
            seen=np.take_along_axis(self.seen, source, axis=1),
        )

    @functools.cached_property
    def square_px(self) -> FloatArray:
        """[V] the median side of each picture's squares; 0 where no two neighbours were seen."""
        pattern = self.pattern
        uv = self.uv_px.reshape(len(self), pattern.rows, pattern.columns, 2)
        seen = self.seen.reshape(uv.shape[:3])
        across = np.linalg.norm(np.diff(uv, axis=2), axis=-1).reshape(len(self), -1)
        down = np.linalg.norm(np.diff(uv, axis=1), axis=-1).reshape(len(self), -1)
        both = [
            (seen[:, :, 1:] & seen[:, :, :-1]).reshape(len(self), -1),
            (seen[:, 1:] & seen[:, :-1]).reshape(len(self), -1),
        ]
        steps = np.concatenate([across, down], axis=1)
        known = np.concatenate(both, axis=1)
        return np.asarray(
            [
                np.median(row[keep]) if keep.any() else 0.0
                for row, keep in zip(steps, known, strict=True)
            ],
            dtype=np.float64,
        )

    @functools.cached_property
    def flat(self) -> FloatArray:
        """[C, 3] the flat board in squares."""
        return self.pattern.corners_m() / self.pattern.square_m


@dataclass(frozen=True)
class State:
    """One guess at everything: `lens` [3 + terms] (cx, cy, f, k1 ...), `turn` [V, 3, 3] and
    `move` [V, 3] from board to camera, `shape` [C, 3]: offsets from the flat board, in squares.

    For cross-validation every picture may have a lens and a shape of its own: `lens`
    [V, 1, 3 + terms] and `shape` [V, C, 3].
    """

    projection: Projection
    lens: FloatArray
    turn: FloatArray
    move: FloatArray
    shape: FloatArray

    def rows(self, keep: BoolArray | IntArray) -> State:
        """The poses of some of the pictures."""
        return replace(self, turn=self.turn[keep], move=self.move[keep])

    @property
    def terms(self) -> tuple[float, float, float, float]:
        """k1..k4, zero where not fitted."""
        k = [0.0] * 4
        k[: len(self.lens) - PLAIN] = [float(x) for x in self.lens[PLAIN:]]
        return k[0], k[1], k[2], k[3]


def board_points(state: State, flat: FloatArray) -> FloatArray:
    """[C, 3] (or [V, C, 3]) the board's corners in its own frame."""
    return flat + state.shape


def camera_points(state: State, flat: FloatArray) -> FloatArray:
    """[V, C, 3] the corners in camera axes, in squares."""
    return np.asarray(
        board_points(state, flat) @ state.turn.transpose(0, 2, 1) + state.move[:, None]
    )


def angles(points: FloatArray) -> FloatArray:
    """Angle from the optical axis of camera points [..., 3]."""
    return np.asarray(np.arctan2(np.hypot(points[..., 0], points[..., 1]), points[..., 2]))


def gain(theta: FloatArray, k: FloatArray) -> FloatArray:
    """1 + k1 theta^2 + k2 theta^4 + ...: `Lens`'s convention. `k` [..., terms]."""
    square = theta * theta
    total = np.zeros_like(theta)
    for term in range(k.shape[-1] - 1, -1, -1):
        total = (total + k[..., term]) * square
    return 1 + total


def project(state: State, points: FloatArray) -> FloatArray:
    """Pixels [..., 2] of camera points [..., 3]."""
    side = np.hypot(points[..., 0], points[..., 1])
    theta = np.arctan2(side, points[..., 2])
    lens = state.lens
    radius = lens[..., 2] * unit_radius(state.projection, theta) * gain(theta, lens[..., PLAIN:])
    scale = radius / np.where(side > 0, side, 1.0)
    return np.asarray(points[..., :2] * scale[..., None] + lens[..., :2])


def residuals(state: State, sightings: Sightings) -> FloatArray:
    """[V, C, 2] projected minus seen, pixels; zero where unseen."""
    error = project(state, camera_points(state, sightings.flat)) - sightings.uv_px
    return np.asarray(np.where(sightings.seen[..., None], error, 0.0))


def bearings(
    projection: Projection, focal_px: float, centre_px: FloatArray, uv_px: FloatArray
) -> FloatArray:
    """Unit rays [..., 3] in camera axes of pixels [..., 2], for a lens without radial terms."""
    offset = uv_px - centre_px
    radius = np.hypot(offset[..., 0], offset[..., 1])
    theta = np.minimum(unit_angle(projection, radius / focal_px), np.pi)
    side = np.sin(theta) / np.where(radius > 0, radius, 1.0)
    return np.concatenate([offset * side[..., None], np.cos(theta)[..., None]], axis=-1)


def rotations(vector: FloatArray) -> FloatArray:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] (Rodrigues)."""
    angle = np.sqrt((vector * vector).sum(-1))[..., None, None]
    k = cross_matrices(vector)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1 - angle**2 / 6, np.sin(safe) / safe)
    second = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def rotation_vectors(turn: FloatArray) -> FloatArray:
    """Rotation vectors [..., 3] of rotation matrices [..., 3, 3]; good to half a turn."""
    skew = np.stack(
        [
            turn[..., 2, 1] - turn[..., 1, 2],
            turn[..., 0, 2] - turn[..., 2, 0],
            turn[..., 1, 0] - turn[..., 0, 1],
        ],
        axis=-1,
    )
    twice_sine = np.linalg.norm(skew, axis=-1)
    angle = np.arctan2(twice_sine, np.trace(turn, axis1=-2, axis2=-1) - 1)
    # Near half a turn the skew part vanishes; the axis is then the symmetric part's largest column.
    symmetric = (turn + np.swapaxes(turn, -1, -2)) / 2 + np.eye(3)
    column = np.argmax(np.diagonal(symmetric, axis1=-2, axis2=-1), axis=-1)
    axis = np.take_along_axis(symmetric, column[..., None, None], axis=-1)[..., 0]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-12)
    axis = axis * np.where((axis * skew).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    near_half = (twice_sine < 1e-4) & (angle > 1)
    plain = (
        skew * np.where(twice_sine > 1e-12, angle / np.maximum(twice_sine, 1e-12), 0.5)[..., None]
    )
    return np.asarray(np.where(near_half[..., None], axis * angle[..., None], plain))


def cross_matrices(vector: FloatArray) -> FloatArray:
    """[..., 3, 3] matrices of the cross product with vectors [..., 3]."""
    out = np.zeros((*vector.shape, 3))
    out[..., 2, 1] = vector[..., 0]
    out[..., 0, 2] = vector[..., 1]
    out[..., 1, 0] = vector[..., 2]
    return np.asarray(out - np.swapaxes(out, -1, -2))
