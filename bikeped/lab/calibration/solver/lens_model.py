"""What is fitted, as arrays: a lens, one pose an image, and the board's shape where wanted.

All images lie in one array [V views, C corners]: a corner that an image does not show has `visible`
False and no weight. Camera axes are OpenCV's: x right, y down, z along the optical axis, so a board
beside or behind the lens plane has z <= 0; the angle is atan2(hypot(x, y), z) and never divides by
z. Lengths are in squares of the board.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bikeped.geometry.lens import PROJECTIONS, Projection
from bikeped.lab.calibration.board_view import BoardPattern, BoardView
from bikeped.types import BoolArray, FloatArray, IntArray

#: Number of lens parameters before the radial terms: cx, cy, f.
PLAIN = 3


@dataclass(frozen=True)
class LensModel:
    """The lens to fit: a projection and how many radial terms (0 to 4)."""

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
class CornerObservations:
    """Positions of all corners: `uv_px` [V, C, 2], `visible` [V, C]; 0 where not visible."""

    pattern: BoardPattern
    names: tuple[str, ...]
    width: int
    height: int
    uv_px: FloatArray
    visible: BoolArray

    @staticmethod
    def of(pattern: BoardPattern, views: Sequence[BoardView]) -> CornerObservations:
        uv = np.zeros((len(views), pattern.count, 2))
        visible = np.zeros((len(views), pattern.count), np.bool_)
        for row, view in enumerate(views):
            uv[row, view.ids] = view.uv_px
            visible[row, view.ids] = True
        first = views[0]
        names = tuple(view.name for view in views)
        return CornerObservations(pattern, names, first.width, first.height, uv, visible)

    def __len__(self) -> int:
        return len(self.names)

    def views(self) -> list[BoardView]:
        return [
            BoardView(name, np.flatnonzero(visible), uv[visible], self.width, self.height)
            for name, uv, visible in zip(self.names, self.uv_px, self.visible, strict=True)
        ]

    def rows(self, keep: BoolArray | IntArray) -> CornerObservations:
        names = tuple(str(name) for name in np.array(self.names)[keep])
        return replace(self, names=names, uv_px=self.uv_px[keep], visible=self.visible[keep])

    def without(self, wrong: BoolArray) -> CornerObservations:
        return replace(self, visible=self.visible & ~wrong)

    def renumbered(self, source: IntArray) -> CornerObservations:
        """Corner `source[v, c]` gets id c in image v."""
        return replace(
            self,
            uv_px=np.take_along_axis(self.uv_px, source[..., None], axis=1),
            visible=np.take_along_axis(self.visible, source, axis=1),
        )

    @functools.cached_property
    def square_px(self) -> FloatArray:
        """[V] the median side of each image's squares; 0 where no two neighbours are visible."""
        shape = (len(self), self.pattern.rows, self.pattern.columns)
        uv, visible = self.uv_px.reshape(*shape, 2), self.visible.reshape(shape)
        sides, known = [], []
        for axis in (2, 1):
            sides.append(np.linalg.norm(np.diff(uv, axis=axis), axis=-1).reshape(len(self), -1))
            both = np.diff(visible.astype(np.int8), axis=axis) == 0
            first = np.take(visible, np.arange(shape[axis] - 1), axis=axis)
            known.append((both & first).reshape(len(self), -1))
        side = np.where(np.concatenate(known, 1), np.concatenate(sides, 1), np.nan)
        out = np.zeros(len(self))
        some = ~np.isnan(side).all(1)
        out[some] = np.nanmedian(side[some], axis=1)
        return out

    @functools.cached_property
    def flat(self) -> FloatArray:
        """[C, 3] the flat board in squares."""
        return self.pattern.corners_m() / self.pattern.square_m


@dataclass(frozen=True)
class CalibrationState:
    """All parameters: `lens` [3 + terms] (cx, cy, f, k1 ...), `rotation` [V, 3, 3] and
    `translation` [V, 3] from board to camera, `shape` [C, 3] offsets from the flat board.

    Lengths in squares. For cross-validation every image may have a lens and a shape of its own:
    `lens` [V, 1, 3 + terms] and `shape` [V, C, 3].
    """

    projection: Projection
    lens: FloatArray
    rotation: FloatArray
    translation: FloatArray
    shape: FloatArray

    def rows(self, keep: BoolArray | IntArray) -> CalibrationState:
        return replace(self, rotation=self.rotation[keep], translation=self.translation[keep])

    def radius_px(self, theta: FloatArray) -> FloatArray:
        """r(theta), also where no `geometry.Lens` is valid."""
        factor = radial_factor(theta, self.lens[..., PLAIN:])
        return np.asarray(self.lens[..., 2] * PROJECTIONS[self.projection].radius(theta) * factor)

    @property
    def terms(self) -> tuple[float, float, float, float]:
        """k1..k4, zero where not fitted."""
        k = [0.0] * 4
        k[: len(self.lens) - PLAIN] = [float(x) for x in self.lens[PLAIN:]]
        return k[0], k[1], k[2], k[3]


def camera_points(state: CalibrationState, flat: FloatArray) -> FloatArray:
    """[V, C, 3] the corners of a board that is `flat` [C, 3] in camera axes, in squares."""
    board = flat + state.shape
    return np.asarray(board @ state.rotation.transpose(0, 2, 1) + state.translation[:, None])


def angles(points: FloatArray) -> FloatArray:
    """Angle from the optical axis of camera points [..., 3]."""
    return np.asarray(np.arctan2(np.hypot(points[..., 0], points[..., 1]), points[..., 2]))


def corner_angles(state: CalibrationState, observations: CornerObservations) -> FloatArray:
    """[V, C] each corner's angle from the optical axis, radians."""
    return angles(camera_points(state, observations.flat))


def radial_factor(theta: FloatArray, k: FloatArray) -> FloatArray:
    """1 + k1 theta^2 + k2 theta^4 + ..., as in `geometry.Lens`. `k` [..., terms]."""
    square = theta * theta
    total = np.zeros_like(theta)
    for term in range(k.shape[-1] - 1, -1, -1):
        total = (total + k[..., term]) * square
    return 1 + total


def project(state: CalibrationState, points: FloatArray) -> FloatArray:
    """Pixels [..., 2] of camera points [..., 3]."""
    side = np.hypot(points[..., 0], points[..., 1])
    radius = state.radius_px(np.arctan2(side, points[..., 2]))
    scale = radius / np.where(side > 0, side, 1.0)
    return np.asarray(points[..., :2] * scale[..., None] + state.lens[..., :2])


def residuals(state: CalibrationState, observations: CornerObservations) -> FloatArray:
    """[V, C, 2] projected minus observed, pixels; zero where not visible."""
    error = project(state, camera_points(state, observations.flat)) - observations.uv_px
    return np.asarray(np.where(observations.visible[..., None], error, 0.0))


def bearings(
    projection: Projection, focal_px: float, centre_px: FloatArray, uv_px: FloatArray
) -> FloatArray:
    """Unit rays [..., 3] in camera axes of pixels [..., 2], for a lens without radial terms."""
    offset = uv_px - centre_px
    radius = np.hypot(offset[..., 0], offset[..., 1])
    theta = np.minimum(PROJECTIONS[projection].theta(radius / focal_px), np.pi)
    side = np.sin(theta) / np.where(radius > 0, radius, 1.0)
    return np.concatenate([offset * side[..., None], np.cos(theta)[..., None]], axis=-1)


def rotations(vector: FloatArray) -> FloatArray:
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] (Rodrigues)."""
    angle = np.sqrt((vector * vector).sum(-1))[..., None, None]
    k = np.zeros((*vector.shape, 3))  # matrices of the cross product with the vectors
    k[..., 2, 1], k[..., 0, 2], k[..., 1, 0] = np.moveaxis(vector, -1, 0)
    k = k - np.swapaxes(k, -1, -2)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1 - angle**2 / 6, np.sin(safe) / safe)
    second = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    return np.asarray(np.eye(3) + first * k + second * (k @ k))
