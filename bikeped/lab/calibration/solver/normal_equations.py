"""Derivatives of the pixels by every parameter, in closed form, and the normal equations in blocks.

With the camera point p = R X + t, s = hypot(px, py), theta = atan2(s, pz), n = |p| and the unit
radius h(theta) = g(theta) (1 + k1 theta^2 + ...), a pixel is (cx, cy) + f h (px, py) / s. Its
derivative along the radius is f h' dtheta, across it f h / s. Nothing divides by pz, so boards
beside and behind the lens plane need no special case.

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

from bikeped.geometry.lens import PROJECTIONS
from bikeped.lab.calibration.solver.lens_model import (
    PLAIN,
    CalibrationState,
    radial_factor,
    rotations,
)
from bikeped.types import FloatArray


@dataclass(frozen=True)
class Jacobian:
    """Pixels `uv_px` [V, C, 2], and their derivatives.

    `lens` [V, C, 2, 3 + terms]; `pose` [V, C, 2, 6]: a small rotation of the board about the
    camera's axes (radians, after its own rotation), then the translation; `shape` [V, C, 2, 3]: the
    corner's own offset on the board.
    """

    uv_px: FloatArray
    lens: FloatArray
    pose: FloatArray
    shape: FloatArray


def jacobian(state: CalibrationState, flat: FloatArray, *, bent: bool = True) -> Jacobian:
    """The derivatives at `state` for a board that is `flat` [C, 3] plus the state's shape.

    `bent` False leaves the derivatives by the shape out: `shape` [V, C, 2, 0].
    """
    turned = (flat + state.shape) @ state.rotation.transpose(0, 2, 1)
    point = turned + state.translation[:, None]
    # On the axis itself the direction across is free: an offset of 1e-9 chooses one.
    length = np.linalg.norm(point, axis=-1)
    flat_side = np.hypot(point[..., 0], point[..., 1])
    nudge = np.where(flat_side < 1e-9 * length, 1e-9 * length, 0.0)
    x, y, z = point[..., 0] + nudge, point[..., 1], point[..., 2]
    side = np.hypot(x, y)
    square = side * side + z * z
    theta = np.arctan2(side, z)

    k = state.lens[..., PLAIN:]
    base = PROJECTIONS[state.projection].radius(theta)
    grown = radial_factor(theta, k)
    unit = base * grown
    slope = PROJECTIONS[state.projection].slope(theta) * grown + base * _radial_slope(theta, k)
    focal = state.lens[..., 2]
    ux, uy = x / side, y / side

    lens = np.zeros((*theta.shape, 2, state.lens.shape[-1]))
    lens[..., 0, 0] = lens[..., 1, 1] = 1.0
    lens[..., 0, 2], lens[..., 1, 2] = unit * ux, unit * uy
    power = focal * base
    for column in range(PLAIN, lens.shape[-1]):
        power = power * theta * theta
        lens[..., 0, column], lens[..., 1, column] = power * ux, power * uy

    along = focal * slope * z / square  # d radius / d side
    across = focal * unit / side
    inward = -focal * slope * side / square  # d radius / d z
    to_point = np.empty((*theta.shape, 2, 3))
    to_point[..., 0, 0] = along * ux * ux + across * uy * uy
    to_point[..., 0, 1] = (along - across) * ux * uy
    to_point[..., 1, 0] = to_point[..., 0, 1]
    to_point[..., 1, 1] = along * uy * uy + across * ux * ux
    to_point[..., 0, 2] = inward * ux
    to_point[..., 1, 2] = inward * uy

    # a . (w x q) = w . (q x a), for the turned corner q and each row a.
    pose = np.concatenate([np.cross(turned[..., None, :], to_point), to_point], axis=-1)
    shape = to_point @ state.rotation[:, None] if bent else to_point[..., :0]
    radius = focal * unit
    centre = state.lens[..., :2]
    uv = np.stack([centre[..., 0] + radius * ux, centre[..., 1] + radius * uy], axis=-1)
    return Jacobian(uv, lens, pose, shape)


def _radial_slope(theta: FloatArray, k: FloatArray) -> FloatArray:
    """Derivative of `radial_factor` by theta."""
    square = theta * theta
    total = np.zeros_like(theta)
    for number in range(k.shape[-1], 0, -1):
        total = total * square + 2 * number * k[..., number - 1]
    return np.asarray(total * theta)


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
        np.einsum("vii->vi", pose)[...] *= 1 + damping
        np.einsum("ii->i", shared)[...] *= 1 + damping
        right = np.concatenate([self.strip, self.pose_slope[..., None]], axis=-1)
        solved = np.linalg.solve(pose, right)
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
