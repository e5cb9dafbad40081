"""The board's real shape: offsets of its corners from a flat, even board, shared by all images.

Printed boards bend by about 1 % of a square, and paper stretches; on real sets this is the largest
error that the lens model cannot explain. Offsets equal to a change of pose or scale are removed
(the gauge): out of the plane the mean and both tilts, in the plane both shifts, the rotation and
the scale. The rest has a weak prior, which holds corners that few images show.

A board of, say, 8 x 6 corners looks the same turned by half a turn, so images may number its
corners from either end. Only the bend tells them apart: `align_numbering` renumbers.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from bikeped.lab.calibration.solver.lens_model import CalibrationState, CornerObservations
from bikeped.lab.calibration.solver.normal_equations import jacobian
from bikeped.types import FloatArray, IntArray

#: Prior standard deviations in squares, out of the plane and in it: bends reach some percent of a
#: square, printing is ten times better.
PRIOR_OUT, PRIOR_IN = 0.05, 0.01
_STARTS, _ROUNDS = 6, 8


def gauge_basis(flat: FloatArray) -> FloatArray:
    """[3C, 3C - 7] orthonormal offsets of a `flat` [C, 3] board, without pose and scale changes.

    Rows are corner by corner x, y, z. In squares.
    """
    return _basis(flat.tobytes())


@functools.lru_cache(maxsize=8)  # every fit of a set uses the same one
def _basis(flat_bytes: bytes) -> FloatArray:
    flat = np.frombuffer(flat_bytes).reshape(-1, 3)
    x, y, none = flat.T[0], flat.T[1], np.zeros(len(flat))
    one = none + 1
    in_plane = [(one, none, none), (none, one, none), (-y, x, none), (x, y, none)]
    free = np.array([*in_plane, *((none, none, height) for height in (one, x, y))])
    taken, _ = np.linalg.qr(free.transpose(0, 2, 1).reshape(7, -1).T)
    # The other columns of a complete orthonormal basis.
    full, _ = np.linalg.qr(np.concatenate([taken, np.eye(flat.size)], axis=1))
    basis = np.ascontiguousarray(full[:, 7 : flat.size])
    basis.flags.writeable = False
    return basis


def prior_weights(count: int) -> FloatArray:
    """[3C] one over the prior's variance of each offset."""
    return np.tile([PRIOR_IN**-2, PRIOR_IN**-2, PRIOR_OUT**-2], count)


def symmetry_rotations(flat: FloatArray, numberings: IntArray) -> FloatArray:
    """[n, 3, 3] rotations of the board for `numberings` [n, C]: flat[numbering[c]] = R flat[c]."""
    out = np.zeros((len(numberings), 3, 3))
    out[:, 2, 2] = 1
    for number, numbering in enumerate(numberings):
        left, _, right = np.linalg.svd(flat[numbering][:, :2].T @ flat[:, :2])
        out[number, :2, :2] = left @ right
    return out


def align_numbering(
    state: CalibrationState, observations: CornerObservations, sigma_px: float
) -> tuple[IntArray, CalibrationState]:
    """[V, C] the common numbering for `CornerObservations.renumbered`, and the state for it.

    Images with a mirrored numbering are turned first: their board faces the other way than most.
    Then shape and numberings are found alternately: the shape that the images agree on, and for
    every image the numbering that fits it best; from several starting images, the best is kept.
    """
    pattern, count = observations.pattern, len(observations)
    # [n, C] numberings under the board's rotational symmetries, two for a board and four for a
    # square one: for each id, which corner of the first numbering gets it. None is mirrored.
    ids = np.arange(pattern.count).reshape(pattern.rows, pattern.columns)
    steps = range(4) if pattern.rows == pattern.columns else (0, 2)
    numberings = np.stack([np.rot90(ids, step).ravel() for step in steps])
    away = (state.rotation[:, :, 2] * state.translation).sum(-1) < 0
    odd = away if away.mean() <= 0.5 else ~away
    handed = np.where(odd[:, None], ids[:, ::-1].ravel(), numberings[0])
    mirrored = state.rotation * np.array([-1.0, 1.0, -1.0])
    state = replace(state, rotation=np.where(odd[:, None, None], mirrored, state.rotation))
    rotations = symmetry_rotations(observations.flat, numberings)
    evidence = _ShapeEvidence.of(
        state, observations.renumbered(handed), sigma_px, numberings, rotations
    )
    every = np.arange(count)
    best, best_gain = np.zeros(count, np.int64), -np.inf
    for first in range(min(count, _STARTS)):
        chosen = np.zeros(count, np.int64)
        shape = evidence.shape(chosen, every[first : first + 1])
        for _ in range(_ROUNDS):
            again = np.argmax(evidence.gains(shape), axis=0)
            shape = evidence.shape(again, every)
            if (again == chosen).all():
                break
            chosen = again
        gain = float(evidence.gains(shape)[chosen, every].sum())
        if gain > best_gain + 1e-6 * abs(best_gain) or not np.isfinite(best_gain):
            best, best_gain = chosen, gain
    if len(numberings) == 2 and best.mean() > 0.5:  # numbered as most images are
        best = 1 - best
    numbering = np.take_along_axis(handed, numberings[best], axis=1)
    return numbering, replace(state, rotation=state.rotation @ rotations[best])


@dataclass(frozen=True)
class _ShapeEvidence:
    """Each image's equations for the shape, linear about the flat board, its pose eliminated.

    For every numbering n: `local` [n, V, C, 3, 3] less `factor` [n, V, 6, 3C] squared is the
    normal matrix, `right` [n, V, 3C] the right hand side.
    """

    local: FloatArray
    factor: FloatArray
    right: FloatArray

    @staticmethod
    def of(
        state: CalibrationState,
        observations: CornerObservations,
        sigma_px: float,
        numberings: IntArray,
        rotations: FloatArray,
    ) -> _ShapeEvidence:
        jac = jacobian(replace(state, shape=np.zeros_like(state.shape)), observations.flat)
        root = observations.visible[..., None] / sigma_px
        error = (observations.uv_px - jac.uv_px) * root
        bent, pose = jac.shape * root[..., None], jac.pose * root[..., None]
        views, count = observations.visible.shape
        local = bent.transpose(0, 1, 3, 2) @ bent
        right = (bent * error[..., None]).sum(2)  # [V, C, 3]
        strip = (pose.transpose(0, 1, 3, 2) @ bent).transpose(0, 2, 1, 3)  # [V, 6, C, 3]
        tall = pose.reshape(views, -1, 6)
        block = tall.transpose(0, 2, 1) @ tall
        slope = tall.transpose(0, 2, 1) @ error.reshape(views, -1, 1)
        inverse = np.linalg.inv(np.linalg.cholesky(block))
        flat_factor = inverse @ strip.reshape(views, 6, -1)
        factor = flat_factor.reshape(views, 6, count, 3)
        known = (inverse @ slope).transpose(0, 2, 1) @ flat_factor
        right = right - known[:, 0].reshape(views, count, 3)
        ways = list(zip(numberings, rotations, strict=True))
        size = (len(ways), views)
        return _ShapeEvidence(
            np.stack([r.T @ local[:, n] @ r for n, r in ways]),
            np.stack([factor[:, :, n] @ r for n, r in ways]).reshape(*size, 6, -1),
            np.stack([right[:, n] @ r for n, r in ways]).reshape(*size, -1),
        )

    def shape(self, chosen: IntArray, rows: IntArray) -> FloatArray:
        """[3C] the shape on which the images `rows` agree, numbered as `chosen` [V]."""
        local = self.local[chosen[rows], rows].sum(0)
        factor = self.factor[chosen[rows], rows].reshape(-1, self.right.shape[-1])
        count = len(local)
        normal = np.diag(prior_weights(count)) - factor.T @ factor
        blocks = normal.reshape(count, 3, count, 3)
        blocks[np.arange(count), :, np.arange(count)] += local
        return np.asarray(np.linalg.solve(normal, self.right[chosen[rows], rows].sum(0)))

    def gains(self, shape: FloatArray) -> FloatArray:
        """[n, V] how much the shape lowers each image's cost under each numbering."""
        corners = shape.reshape(-1, 3)
        bent = np.einsum("nvcij,ci,cj->nv", self.local, corners, corners)
        eliminated = ((self.factor @ shape) ** 2).sum(-1)
        return np.asarray(2 * self.right @ shape - bent + eliminated)
