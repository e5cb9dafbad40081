"""The normal equations of the adjustment, in blocks, and single-threaded linear algebra.

A pose affects only its own image: the normal matrix is one dense block for what all images share
(lens, board shape), one 6 x 6 block an image, and the strips between them. Eliminating the
poses (the Schur complement) leaves a matrix as small as the lens has parameters.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from threadpoolctl import ThreadpoolController

from bikeped.lab.calibration.solver.jacobian import Jacobian
from bikeped.lab.calibration.solver.lens_model import CalibrationState, rotations
from bikeped.types import FloatArray

F = TypeVar("F", bound=Callable[..., Any])
_thread_pools = functools.cache(ThreadpoolController)


def single_threaded(function: F) -> F:
    """Runs the function with its linear algebra limited to one thread.

    The matrices are small: a second thread costs more than it saves, some twenty times over where
    other processes use the processor as well.
    """

    @functools.wraps(function)
    def limited(*args: Any, **named: Any) -> Any:
        with _thread_pools().limit(limits=1, user_api="blas"):
            return function(*args, **named)

    return limited  # type: ignore[return-value]


@dataclass(frozen=True)
class AdjustmentStep:
    """A change of all parameters: `shared` [3 + terms + shape], `pose` [V, 6]."""

    shared: FloatArray
    pose: FloatArray


@dataclass(frozen=True)
class NormalEquations:
    """Blocks of J'WJ and J'We: shared [p, p], [p]; poses [V, 6, 6], [V, 6]; strips [V, 6, p]."""

    shared: FloatArray
    shared_slope: FloatArray
    pose: FloatArray
    pose_slope: FloatArray
    strip: FloatArray

    def step(self, damping: float) -> AdjustmentStep:
        """The Levenberg-Marquardt step; numpy.linalg.LinAlgError where there is none."""
        pose, shared = self.pose.copy(), self.shared.copy()
        index = np.arange(6)
        pose[:, index, index] *= 1 + damping
        index = np.arange(len(shared))
        shared[index, index] *= 1 + damping
        solved = np.linalg.solve(
            pose, np.concatenate([self.strip, self.pose_slope[..., None]], axis=-1)
        )
        flat_strip = self.strip.reshape(-1, len(shared))
        reduced = shared - flat_strip.T @ solved[..., :-1].reshape(flat_strip.shape)
        slope = self.shared_slope - flat_strip.T @ solved[..., -1].reshape(-1)
        # Radial terms and a centre in pixels differ by orders of magnitude: scale them.
        size = np.sqrt(np.maximum(np.diagonal(reduced), 1e-300))
        change = -np.linalg.solve(reduced / np.outer(size, size), slope / size) / size
        return AdjustmentStep(change, -(solved[..., -1] + solved[..., :-1] @ change))

    def reduced_inverse(self, size: int) -> FloatArray:
        """[size, size] the first part of the shared block's inverse, the poses eliminated: the
        covariance for unit noise; infinite variances where the images leave it open."""
        solved = np.linalg.solve(self.pose, self.strip)
        flat_strip = self.strip.reshape(-1, len(self.shared))
        reduced = self.shared - flat_strip.T @ solved.reshape(flat_strip.shape)
        scale = np.sqrt(np.maximum(np.diagonal(reduced), 1e-300))
        with contextlib.suppress(np.linalg.LinAlgError):
            part = np.linalg.solve(reduced / np.outer(scale, scale), np.eye(len(scale), size))
            part = part[:size] / np.outer(scale[:size], scale[:size])
            if (np.diagonal(part) > 0).all():
                return np.asarray(part)
        return np.full((size, size), np.inf)

    @property
    def slope_size(self) -> float:
        """The largest gradient, each in units of its parameter's curvature: 0 at a minimum."""
        shared = np.abs(self.shared_slope) / np.sqrt(np.maximum(np.diagonal(self.shared), 1e-300))
        curvature = np.diagonal(self.pose, axis1=1, axis2=2)
        pose = np.abs(self.pose_slope) / np.sqrt(np.maximum(curvature, 1e-300))
        return float(max(shared.max(), pose.max()))


def normal_equations(
    jac: Jacobian, error: FloatArray, weight: FloatArray, shape_basis: FloatArray | None = None
) -> NormalEquations:
    """Blocks for residuals `error` [V, C, 2] weighted by `weight` [V, C].

    `shape_basis` [3C, q]: the free offsets of the board's shape; None: a flat board.
    """
    views, corners = weight.shape
    own = np.concatenate([jac.pose, jac.lens], axis=-1).reshape(views, 2 * corners, -1)
    twice = np.repeat(weight, 2, axis=1)
    heavy = (own * twice[..., None]).transpose(0, 2, 1)
    block = heavy @ own
    slope = (heavy @ error.reshape(views, -1, 1))[..., 0]
    pose, strip = block[:, :6, :6], block[:, :6, 6:]
    shared, shared_slope = block[:, 6:, 6:].sum(0), slope[:, 6:].sum(0)
    if shape_basis is not None:
        bent = jac.shape * weight[..., None, None]  # [V, C, 2, 3]
        across = jac.pose.transpose(0, 1, 3, 2) @ bent  # [V, C, 6, 3]
        wide = across.transpose(0, 2, 1, 3).reshape(views, 6, -1) @ shape_basis
        lens_cross = (jac.lens.transpose(0, 1, 3, 2) @ bent).sum(0)  # [C, m, 3]
        lens_wide = lens_cross.transpose(1, 0, 2).reshape(shared.shape[0], -1) @ shape_basis
        local = (jac.shape.transpose(0, 1, 3, 2) @ bent).sum(0)  # [C, 3, 3]
        folded = np.einsum("cab,cbq->caq", local, shape_basis.reshape(corners, 3, -1))
        shape_block = shape_basis.T @ folded.reshape(3 * corners, -1)
        shape_slope = shape_basis.T @ (bent * error[..., None]).sum((0, 2)).reshape(-1)
        strip = np.concatenate([strip, wide], axis=-1)
        shared = np.block([[shared, lens_wide], [lens_wide.T, shape_block]])
        shared_slope = np.concatenate([shared_slope, shape_slope])
    return NormalEquations(shared, shared_slope, pose, slope[:, :6], strip)


def apply_step(
    state: CalibrationState, step: AdjustmentStep, shape_basis: FloatArray | None = None
) -> CalibrationState:
    """The state after a step."""
    lens = state.lens + step.shared[: len(state.lens)]
    shape = state.shape
    if shape_basis is not None:
        shape = shape + (shape_basis @ step.shared[len(state.lens) :]).reshape(-1, 3)
    return replace(
        state,
        lens=lens,
        rotation=rotations(step.pose[:, :3]) @ state.rotation,
        translation=state.translation + step.pose[:, 3:],
        shape=shape,
    )
