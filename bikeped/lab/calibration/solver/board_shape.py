"""The board as it is, not as it was meant: offsets of its corners, shared by all pictures.

Printed boards bend by about 1 % of a square, and paper stretches; on real sets this is the largest
part of what the lens model cannot explain. Offsets that a pose or the square's size could stand for
are taken out (the gauge): out of the plane the mean and both tilts, in the plane both shifts, the
turn and the scale. The rest carries a weak prior, so that corners that few pictures show stay put.

A board of, say, 8 x 6 corners looks the same turned by half a turn, so pictures may count its
corners from either end. The flat board cannot tell; the bent one can: `alignment` renumbers.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.solver.jacobian import jacobian
from bikeped.lab.calibration.solver.lens_model import Sightings, State
from bikeped.types import BoolArray, FloatArray, IntArray

#: Prior standard deviations in squares, out of the plane and in it: bends reach some percent of a
#: square, printing is ten times better.
PRIOR_OUT, PRIOR_IN = 0.05, 0.01
_STARTS, _ROUNDS = 6, 8


def gauge_basis(flat: FloatArray) -> FloatArray:
    """[3C, 3C - 7] orthonormal offsets of a `flat` [C, 3] board that no pose or scale makes.

    Rows are corner by corner x, y, z. In squares.
    """
    return _basis(flat.tobytes())


@functools.lru_cache(maxsize=8)  # every fit of a set asks for the same one
def _basis(flat_bytes: bytes) -> FloatArray:
    flat = np.frombuffer(flat_bytes).reshape(-1, 3)
    count = len(flat)
    x, y = flat[:, 0], flat[:, 1]
    free = np.zeros((7, count, 3))
    free[0, :, 0] = 1
    free[1, :, 1] = 1
    free[2, :, 0], free[2, :, 1] = -y, x
    free[3, :, 0], free[3, :, 1] = x, y
    free[4, :, 2] = 1
    free[5, :, 2] = x
    free[6, :, 2] = y
    taken, _ = np.linalg.qr(free.reshape(7, -1).T)
    # The other columns of a complete orthonormal basis.
    full, _ = np.linalg.qr(np.concatenate([taken, np.eye(3 * count)], axis=1))
    basis = np.ascontiguousarray(full[:, 7 : 3 * count])
    basis.flags.writeable = False
    return basis


def prior_weights(count: int) -> FloatArray:
    """[3C] one over the prior's variance of each offset."""
    return np.tile([PRIOR_IN**-2, PRIOR_IN**-2, PRIOR_OUT**-2], count)


def turns_of(pattern: BoardPattern) -> IntArray:
    """[n, C] the ways to count the corners that a turn of the board about its middle allows.

    Two for a board, four for a square one: row k holds, for each number, which corner of the first
    way takes it. Mirrored ways are no turn.
    """
    ids = np.arange(pattern.count).reshape(pattern.rows, pattern.columns)
    steps = range(4) if pattern.rows == pattern.columns else (0, 2)
    return np.stack([np.rot90(ids, step).ravel() for step in steps])


def mirrored(pattern: BoardPattern) -> IntArray:
    """[C] the numbering seen in a mirror: columns counted backwards."""
    ids = np.arange(pattern.count).reshape(pattern.rows, pattern.columns)
    return ids[:, ::-1].ravel()


def way_turns(flat: FloatArray, ways: IntArray) -> FloatArray:
    """[n, 3, 3] the turns of the board that go with `turns_of`: flat[way[c]] = turn flat[c]."""
    out = np.zeros((len(ways), 3, 3))
    out[:, 2, 2] = 1
    for number, way in enumerate(ways):
        left, _, right = np.linalg.svd(flat[way][:, :2].T @ flat[:, :2])
        out[number, :2, :2] = left @ right
    return out


def alignment(state: State, sightings: Sightings, sigma_px: float) -> tuple[IntArray, State]:
    """Which way each picture counts the corners: [V, C] for `Sightings.renumbered`, and the state
    with the poses that go with it.

    A picture counted as in a mirror is turned first: its board faces the other way than most. Then
    shape and ways are found in turn: the shape that the pictures agree on, and for every picture
    the way that fits this shape best; begun from several pictures, the best kept.
    """
    pattern = sightings.pattern
    ways = turns_of(pattern)
    away = (state.turn[:, :, 2] * state.move).sum(-1) < 0
    odd = away if away.mean() <= 0.5 else ~away
    handed = np.where(odd[:, None], mirrored(pattern), ways[0])
    state = replace(
        state,
        turn=np.where(odd[:, None, None], state.turn * np.array([-1.0, 1.0, -1.0]), state.turn),
    )
    turns = way_turns(sightings.flat, ways)
    told = _Told.of(state, sightings.renumbered(handed), sigma_px, ways, turns)
    best, best_gain = np.zeros(len(sightings), np.int64), -np.inf
    for first in range(min(len(sightings), _STARTS)):
        chosen = np.zeros(len(sightings), np.int64)
        shape = told.shape(chosen, np.arange(len(chosen)) == first)
        for _ in range(_ROUNDS):
            again = np.argmax(told.gains(shape), axis=0)
            shape = told.shape(again)
            if (again == chosen).all():
                break
            chosen = again
        gain = float(told.gains(shape)[chosen, np.arange(len(chosen))].sum())
        if gain > best_gain + 1e-6 * abs(best_gain) or not np.isfinite(best_gain):
            best, best_gain = chosen, gain
    if len(ways) == 2 and best.mean() > 0.5:  # counted as most pictures are
        best = 1 - best
    return np.take_along_axis(handed, ways[best], axis=1), replace(
        state, turn=state.turn @ turns[best]
    )


@dataclass(frozen=True)
class _Told:
    """What each picture alone says of the shape, linear about the flat board, its pose left free.

    For every way n of counting: `local` [n, V, C, 3, 3] less `factor` [n, V, 6, 3C] squared is the
    normal matrix, `right` [n, V, 3C] the right hand side.
    """

    local: FloatArray
    factor: FloatArray
    right: FloatArray
    prior: FloatArray

    @staticmethod
    def of(
        state: State, sightings: Sightings, sigma_px: float, ways: IntArray, turns: FloatArray
    ) -> _Told:
        jac = jacobian(replace(state, shape=np.zeros_like(state.shape)), sightings.flat)
        root = sightings.seen[..., None] / sigma_px
        error = (sightings.uv_px - jac.uv_px) * root
        bent, pose = jac.shape * root[..., None], jac.pose * root[..., None]
        views, count = sightings.seen.shape
        local = bent.transpose(0, 1, 3, 2) @ bent
        right = (bent * error[..., None]).sum(2)  # [V, C, 3]
        strip = (pose.transpose(0, 1, 3, 2) @ bent).transpose(0, 2, 1, 3)  # [V, 6, C, 3]
        tall = pose.reshape(views, -1, 6)
        block = tall.transpose(0, 2, 1) @ tall
        slope = tall.transpose(0, 2, 1) @ error.reshape(views, -1, 1)
        inverse = np.linalg.inv(np.linalg.cholesky(block))
        factor = (inverse @ strip.reshape(views, 6, -1)).reshape(views, 6, count, 3)
        right = right - ((inverse @ slope).transpose(0, 2, 1) @ factor.reshape(views, 6, -1))[
            :, 0
        ].reshape(views, count, 3)
        shape = (len(ways), views)
        return _Told(
            np.stack([t.T @ local[:, w] @ t for w, t in zip(ways, turns, strict=True)]),
            np.stack([factor[:, :, w] @ t for w, t in zip(ways, turns, strict=True)]).reshape(
                *shape, 6, -1
            ),
            np.stack([right[:, w] @ t for w, t in zip(ways, turns, strict=True)]).reshape(
                *shape, -1
            ),
            prior_weights(count),
        )

    def shape(self, chosen: IntArray, only: BoolArray | None = None) -> FloatArray:
        """[3C] the shape that the pictures (or `only` some) agree on, counted as `chosen` [V]."""
        rows = np.arange(len(chosen)) if only is None else np.flatnonzero(only)
        local = self.local[chosen[rows], rows].sum(0)
        factor = self.factor[chosen[rows], rows].reshape(-1, self.right.shape[-1])
        normal = np.diag(self.prior) - factor.T @ factor
        count = len(local)
        blocks = normal.reshape(count, 3, count, 3)
        blocks[np.arange(count), :, np.arange(count)] += local
        return np.asarray(np.linalg.solve(normal, self.right[chosen[rows], rows].sum(0)))

    def gains(self, shape: FloatArray) -> FloatArray:
        """[n, V] by how much the shape lowers each picture's cost under each way of counting."""
        corners = shape.reshape(-1, 3)
        bent = np.einsum("nvcij,ci,cj->nv", self.local, corners, corners)
        moved = ((self.factor @ shape) ** 2).sum(-1)
        return np.asarray(2 * self.right @ shape - bent + moved)
