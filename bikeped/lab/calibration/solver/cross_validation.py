"""Cross-validation: how well the lens predicts images that were not used to fit it.

The images are split into folds. Lens and board shape are fitted on all folds but one; on the
held-out fold only the poses are fitted, and its residuals count. This reveals overfitting.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bikeped.lab.calibration.solver.bundle_adjustment import (
    SOFT_L1_TURN,
    AdjustmentResult,
    ShapePrior,
    refit_robust,
    whitened,
)
from bikeped.lab.calibration.solver.jacobian import Jacobian, jacobian
from bikeped.lab.calibration.solver.lens_model import (
    CalibrationState,
    CornerObservations,
    residuals,
    rotations,
)
from bikeped.lab.calibration.solver.normal_equations import (
    apply_step,
    normal_equations,
    single_threaded,
)
from bikeped.types import BoolArray, FloatArray, IntArray

#: Fewer images than this are refitted for every fold; with more, one linear step is as good.
_REFIT_BELOW = 10


@dataclass(frozen=True)
class LinearizedFit:
    """The last stage's equations at a fit, which give the fit without some images in one step.

    With many images a fit moves little when a few are removed, and one undamped Gauss-Newton step
    from the optimum gets there (to 1 % of the held-out error, tested).
    """

    fitted: AdjustmentResult
    jac: Jacobian
    weighted_px: FloatArray
    visible: FloatArray
    prior: ShapePrior | None

    @staticmethod
    def of(observations: CornerObservations, fitted: AdjustmentResult) -> LinearizedFit:
        jac, weighted_px = whitened(
            jacobian(fitted.state, observations.flat, bent=fitted.model.board),
            fitted.residuals_px,
            fitted.sigma_px * SOFT_L1_TURN,
        )
        prior = ShapePrior.of(observations, fitted.state) if fitted.model.board else None
        visible = observations.visible.astype(np.float64)
        return LinearizedFit(fitted, jac, weighted_px, visible, prior)

    def without(self, out: BoolArray) -> CalibrationState:
        """Lens and shape fitted to the images that are not `out` [V], and these images' poses."""
        keep, state = ~out, self.fitted.state
        jac = Jacobian(*(part[keep] for part in self.jac.parts))
        basis = None if self.prior is None else self.prior.basis
        normal = normal_equations(jac, self.weighted_px[keep], self.visible[keep], basis)
        if self.prior is not None:
            normal = self.prior.added(normal, state)
        return apply_step(state.rows(keep), normal.step(0.0), basis)


def assign_folds(images: int, folds: int) -> IntArray:
    """[images] the fold of each, in turn, so that neighbours in time are split.

    `folds` 0: each image is a fold.
    """
    return np.arange(images) % min(folds or images, images)


@single_threaded
def held_out_residuals(
    fitted: AdjustmentResult, observations: CornerObservations, folds: int
) -> FloatArray:
    """[V, C, 2] residuals of each image under the lens that the other folds give, pixels."""
    fold = assign_folds(len(observations), folds)
    linear = LinearizedFit.of(observations, fitted) if len(observations) >= _REFIT_BELOW else None
    lens = np.empty((len(observations), 1, len(fitted.state.lens)))
    shape = np.empty((len(observations), *fitted.state.shape.shape))
    for number in range(fold.max() + 1):
        out = fold == number
        if linear is not None:
            train = linear.without(out)
        else:
            near = replace(fitted, state=fitted.state.rows(~out))
            train = refit_robust(observations.rows(~out), near)
        lens[out], shape[out] = train.lens, train.shape
    state = replace(fitted.state, lens=lens, shape=shape)
    return residuals(fit_poses(state, observations), observations)


def fit_poses(
    start: CalibrationState, observations: CornerObservations, steps: int = 20
) -> CalibrationState:
    """The best poses under the lens and shape of `start`, each image by itself."""
    state = start
    error = residuals(state, observations)
    cost: FloatArray = np.asarray((error * error).sum((1, 2)))
    damping: FloatArray = np.full(len(cost), 1e-8)
    index = np.arange(6)
    for _ in range(steps):
        jac = (
            jacobian(state, observations.flat, bent=False).pose
            * observations.visible[..., None, None]
        )
        tall = jac.reshape(len(cost), -1, 6)
        normal = tall.transpose(0, 2, 1) @ tall
        slope = (tall.transpose(0, 2, 1) @ error.reshape(len(cost), -1, 1))[..., 0]
        normal[:, index, index] *= 1 + damping[:, None]
        step: FloatArray = np.asarray(-np.linalg.solve(normal, slope[..., None])[..., 0])
        trial = replace(
            state,
            rotation=rotations(step[:, :3]) @ state.rotation,
            translation=state.translation + step[:, 3:],
        )
        trial_error = residuals(trial, observations)
        trial_cost = (trial_error * trial_error).sum((1, 2))
        better = trial_cost <= cost
        rests = np.abs(cost - trial_cost) <= 1e-9 * cost + 1e-18
        state = replace(
            state,
            rotation=np.where(better[:, None, None], trial.rotation, state.rotation),
            translation=np.where(better[:, None], trial.translation, state.translation),
        )
        error = np.where(better[:, None, None], trial_error, error)
        cost = np.asarray(np.where(better, trial_cost, cost))
        damping = np.asarray(np.where(better, damping / 10, damping * 10))
        if rests.all():
            break
    return state
