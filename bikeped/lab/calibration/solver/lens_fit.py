"""One lens model fitted to a set of boards, with its errors, uncertainty and cross-validation.

For the cross-validation the images are split into folds. Lens and board shape are fitted on all
folds but one; on the held-out fold only the poses are fitted, and its residuals count: how well the
lens predicts images that were not used to fit it. This reveals overfitting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bikeped.geometry.lens import PROJECTIONS, Lens
from bikeped.lab.calibration.solver.bundle_adjustment import (
    SOFT_L1_TURN,
    AdjustmentResult,
    ShapePrior,
    adjust,
    refit_robust,
    whitened,
)
from bikeped.lab.calibration.solver.lens_model import (
    PLAIN,
    CalibrationState,
    CornerObservations,
    LensModel,
    corner_angles,
    radial_factor,
    residuals,
    rotations,
)
from bikeped.lab.calibration.solver.normal_equations import (
    Jacobian,
    apply_step,
    jacobian,
    normal_equations,
    single_threaded,
)
from bikeped.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class LensFit(AdjustmentResult):
    """An adjustment with its cross-validation and uncertainty; arrays [V, C, ...]."""

    observations: CornerObservations
    #: Residuals of each image when it was held out; None: not cross-validated.
    held_out_px: FloatArray | None
    covariance: FloatArray  #: of the lens's parameters, in the model's order

    @property
    def name(self) -> str:
        return self.model.name

    @property
    def rms_px(self) -> float:
        """Per point: sqrt(mean(dx^2 + dy^2))."""
        return rms_per_point(self.residuals_px, self.observations)

    @property
    def rms_per_coordinate_px(self) -> float:
        """sqrt(mean over all coordinates), smaller by sqrt(2)."""
        return self.rms_px / float(np.sqrt(2))

    @property
    def cross_validated_px(self) -> float | None:
        """Per point, over images that were held out."""
        if self.held_out_px is None:
            return None
        return rms_per_point(self.held_out_px, self.observations)

    @property
    def ranking_px(self) -> float:
        """The error by which models are ranked: cross-validated where known, else RMS per point."""
        return self.cross_validated_px or self.rms_px

    @property
    def cx(self) -> float:
        return float(self.state.lens[0])

    @property
    def cy(self) -> float:
        return float(self.state.lens[1])

    @property
    def focal_px(self) -> float:
        return float(self.state.lens[2])

    @property
    def uncertainty(self) -> dict[str, float]:
        """One standard deviation of each lens parameter, from the corners' noise only.

        It does not cover a wrong model: see the cross-validated error.
        """
        sigma = np.sqrt(np.maximum(np.diagonal(self.covariance), 0.0))
        return {n: float(s) for n, s in zip(self.model.parameters, sigma, strict=True)}

    def radius_sigma_px(self, theta: FloatArray) -> FloatArray:
        """One standard deviation of r(theta), from the covariance of f and the radial terms."""
        base = PROJECTIONS[self.state.projection].radius(theta)
        slopes = [base * radial_factor(theta, self.state.lens[PLAIN:])]
        slopes += [self.focal_px * base * theta ** (2 * n + 2) for n in range(self.model.terms)]
        rows = np.stack(slopes, axis=-1)
        inner = self.covariance[2:, 2:]
        return np.asarray(np.sqrt(np.maximum(((rows @ inner) * rows).sum(-1), 0.0)))

    @property
    def angles_rad(self) -> FloatArray:
        """[V, C] each corner's angle from the optical axis."""
        return corner_angles(self.state, self.observations)

    @property
    def measured_to_rad(self) -> float:
        """The largest angle of an observed corner."""
        return float(self.angles_rad[self.observations.visible].max())

    def lens(self, max_theta_rad: float) -> Lens:
        """The project's lens, valid to an angle; GeometryError where it cannot be."""
        return Lens(self.state.projection, self.focal_px, max_theta_rad, self.state.terms)


@single_threaded
def fit_lens(
    observations: CornerObservations,
    model: LensModel,
    start: CalibrationState,
    folds: int | None = None,
) -> LensFit:
    """Adjusts the model from `start`, with its covariance, and cross-validates it over `folds`.

    `folds` 0: each image is a fold; None: no cross-validation.
    """
    adjusted = adjust(observations, model, start)
    held_out = held_out_residuals(adjusted, observations, folds) if folds is not None else None
    covariance = _covariance(adjusted, observations)
    return LensFit(
        **vars(adjusted), observations=observations, held_out_px=held_out, covariance=covariance
    )


def _covariance(adjusted: AdjustmentResult, observations: CornerObservations) -> FloatArray:
    """Covariance of the lens's parameters: the normal matrix with poses and shape eliminated,
    inverted, times the variance of the residuals."""
    state, bent = adjusted.state, adjusted.model.board
    prior = ShapePrior.of(observations, state) if bent else None
    basis, visible = None if prior is None else prior.basis, observations.visible.astype(np.float64)
    jac = jacobian(state, observations.flat, bent=bent)
    normal = normal_equations(jac, adjusted.residuals_px, visible, basis)
    free = 2 * observations.visible.sum() - 6 * len(observations) - len(state.lens)
    if prior is not None:
        normal = prior.added(normal, state)
        free -= prior.basis.shape[1]
    variance = float((adjusted.residuals_px**2).sum()) / max(int(free), 1)
    return np.asarray(normal.reduced_inverse(len(state.lens)) * variance)


def rms_per_point(error: FloatArray, observations: CornerObservations) -> float:
    """sqrt(mean(dx^2 + dy^2)) over the visible corners, pixels."""
    return float(np.sqrt((error[observations.visible] ** 2).sum(-1).mean()))


def rms_by_image(error: FloatArray, observations: CornerObservations) -> FloatArray:
    """[V] the same for each image."""
    count = observations.visible.sum(1)
    return np.asarray(np.sqrt((error**2).sum((1, 2)) / np.maximum(count, 1)))


#: Fewer images than this are refitted for every fold; with more, one linear step is as good.
_REFIT_BELOW = 10
_POSE_STEPS = 20


def _linear_refit(
    observations: CornerObservations, fitted: AdjustmentResult
) -> Callable[[BoolArray], CalibrationState]:
    """Lens and shape fitted to the images `keep` [V] only, and their poses, in one linear step.

    With many images a fit moves little when a few are removed, and one undamped Gauss-Newton step
    from the optimum gets there (to 1 % of the held-out error, tested).
    """
    state, bent = fitted.state, fitted.model.board
    whole = jacobian(state, observations.flat, bent=bent)
    whole, weighted_px = whitened(whole, fitted.residuals_px, fitted.sigma_px * SOFT_L1_TURN)
    visible = observations.visible.astype(np.float64)
    prior = ShapePrior.of(observations, state) if bent else None
    basis = None if prior is None else prior.basis

    def refit(keep: BoolArray) -> CalibrationState:
        jac = Jacobian(*(part[keep] for part in vars(whole).values()))
        normal = normal_equations(jac, weighted_px[keep], visible[keep], basis)
        if prior is not None:
            normal = prior.added(normal, state)
        return apply_step(state.rows(keep), normal.step(0.0), basis)

    return refit


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
    linear = _linear_refit(observations, fitted) if len(observations) >= _REFIT_BELOW else None
    lens = np.empty((len(observations), 1, len(fitted.state.lens)))
    shape = np.empty((len(observations), *fitted.state.shape.shape))
    for number in range(fold.max() + 1):
        out = fold == number
        if linear is not None:
            train = linear(~out)
        else:
            near = replace(fitted, state=fitted.state.rows(~out))
            train = refit_robust(observations.rows(~out), near)
        lens[out], shape[out] = train.lens, train.shape
    state = replace(fitted.state, lens=lens, shape=shape)
    return residuals(fit_poses(state, observations), observations)


def fit_poses(start: CalibrationState, observations: CornerObservations) -> CalibrationState:
    """The best poses under the lens and shape of `start`, each image by itself."""
    state = start
    error = residuals(state, observations)
    cost: FloatArray = np.asarray((error * error).sum((1, 2)))
    damping: FloatArray = np.full(len(cost), 1e-8)
    index = np.arange(6)
    for _ in range(_POSE_STEPS):
        pose = jacobian(state, observations.flat, bent=False).pose
        tall = (pose * observations.visible[..., None, None]).reshape(len(cost), -1, 6)
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
