"""Bundle adjustment on the projection itself: Levenberg-Marquardt, then soft-L1.

The paper's two stages. The first minimises the squared distance between projected and observed
corners; the second a soft-L1 loss of the distance, which grows like the distance instead of its
square, so a wrong corner pulls no harder than a slightly wrong one. Each stage has its own
criterion, and a stage whose result is worse by it than its start is not kept.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import numpy as np

from bikeped.lab.calibration.solver.board_shape import gauge_basis, prior_weights
from bikeped.lab.calibration.solver.lens_model import (
    PLAIN,
    CalibrationState,
    CornerObservations,
    LensModel,
    corner_angles,
    residuals,
)
from bikeped.lab.calibration.solver.normal_equations import (
    Jacobian,
    NormalEquations,
    apply_step,
    jacobian,
    normal_equations,
    single_threaded,
)
from bikeped.types import BoolArray, FloatArray

#: Median distance of plain noise, in standard deviations of one coordinate.
MEDIAN_OF_NOISE = 1.17741
#: The loss turns from squared to linear here, in standard deviations of one coordinate.
SOFT_L1_TURN = 3.0
_FLOOR_PX = 1e-4
_MOST_STEPS, _MOST_DAMPINGS = 60, 12
_FIRST_DAMPING, _NEAR_DAMPING = 1e-4, 1e-8
_SAME_COST = 1e-9


@dataclass(frozen=True)
class AdjustmentStage:
    """How one stage of the adjustment went, for the report."""

    name: str
    steps: int
    cost_before: float  #: by the stage's own criterion, pixels squared
    cost_after: float
    gradient: float  #: the largest, in pixels (units of one standard deviation at noise of 1 px)
    stopped: str  #: why
    kept: bool


@dataclass(frozen=True)
class AdjustmentResult:
    """The state at the optimum, the stages that led there, and the residuals."""

    model: LensModel
    state: CalibrationState
    stages: tuple[AdjustmentStage, ...]
    residuals_px: FloatArray  #: [V, C, 2], zero where not visible
    sigma_px: float  #: noise of one coordinate, from the median distance


def noise_px(error: FloatArray, visible: BoolArray) -> float:
    """Standard deviation of one coordinate of `error` [V, C, 2], by the median of the distances."""
    distance = np.hypot(error[..., 0], error[..., 1])[visible]
    return max(float(np.median(distance)) / MEDIAN_OF_NOISE, _FLOOR_PX)


@single_threaded
def adjust(
    observations: CornerObservations,
    model: LensModel,
    start: CalibrationState,
    *,
    robust: bool = True,
) -> AdjustmentResult:
    """Both stages from `start`, its lens cut or padded with zeros to the model's radial terms.

    `robust` False leaves the second stage out.
    """
    lens = np.zeros(PLAIN + model.terms)
    known = min(len(lens), len(start.lens))
    lens[:known] = start.lens[:known]
    state = replace(start, projection=model.projection, lens=lens)
    if not model.board:
        state = replace(state, shape=np.zeros_like(state.shape))
    state, stage = _run_stage(observations, model, state, None, "levenberg-marquardt")
    stages = [stage]
    error = residuals(state, observations)
    if robust:
        for _ in range(4):  # until the scale, which falls with every wrong corner, settles
            scale = noise_px(error, observations.visible) * SOFT_L1_TURN
            state, stage = _run_stage(observations, model, state, scale, "soft-l1")
            stages.append(stage)
            error = residuals(state, observations)
            if noise_px(error, observations.visible) * SOFT_L1_TURN > 0.9 * scale:
                break
    sigma_px = noise_px(error, observations.visible)
    return AdjustmentResult(model, state, tuple(stages), error, sigma_px)


def refit_robust(observations: CornerObservations, fitted: AdjustmentResult) -> CalibrationState:
    """The last stage again on other images, for cross-validation.

    At the fit's own scale: the criterion must not change with the fold.
    """
    turn_px = fitted.sigma_px * SOFT_L1_TURN
    return _run_stage(observations, fitted.model, fitted.state, turn_px, "soft-l1")[0]


def _run_stage(
    observations: CornerObservations,
    model: LensModel,
    start: CalibrationState,
    turn_px: float | None,
    name: str,
) -> tuple[CalibrationState, AdjustmentStage]:
    """One stage, and its result only if that is better and its radius grows with the angle."""
    found, stage = minimise(observations, model, start, turn_px, name)
    monotonic = _radius_is_monotonic(found, observations)
    if monotonic and np.isfinite(stage.cost_after) and stage.cost_after <= stage.cost_before:
        return found, stage
    why = stage.stopped if monotonic else "the radius would shrink with the angle"
    return start, replace(stage, kept=False, stopped=why)


def _radius_is_monotonic(state: CalibrationState, observations: CornerObservations) -> bool:
    if not (np.isfinite(state.lens).all() and state.lens[2] > 0):
        return False
    if len(state.lens) <= PLAIN:
        return True
    observed = corner_angles(state, observations)[observations.visible]
    theta: FloatArray = np.linspace(0.0, float(np.quantile(observed, 0.98)), 200, dtype=np.float64)
    growing = np.all(np.diff(state.radius_px(theta)) > 0)
    return bool(growing) or state.projection == "orthographic"


def minimise(
    observations: CornerObservations,
    model: LensModel,
    start: CalibrationState,
    turn_px: float | None,
    name: str,
) -> tuple[CalibrationState, AdjustmentStage]:
    """Levenberg-Marquardt on the squared (`turn_px` None) or the soft-L1 loss.

    The latter turns linear at `turn_px`; it is minimised by reweighted least-squares steps.
    """
    flat = observations.flat
    prior = ShapePrior.of(observations, start) if model.board else None
    basis = None if prior is None else prior.basis

    def cost_of(error: FloatArray, state: CalibrationState) -> float:
        return loss(error, turn_px) + (0.0 if prior is None else prior.cost(state))

    state = start
    error = residuals(state, observations)
    before = cost = cost_of(error, state)
    damping = _FIRST_DAMPING if turn_px is None else _NEAR_DAMPING
    steps, stopped, slope = 0, "the most steps were taken", np.inf
    while steps < _MOST_STEPS:
        jac, weighted_px = whitened(jacobian(state, flat, bent=model.board), error, turn_px)
        normal = normal_equations(jac, weighted_px, observations.visible.astype(np.float64), basis)
        if prior is not None:
            normal = prior.added(normal, state)
        slope = normal.slope_size
        steps += 1
        gained = -1.0
        for _ in range(_MOST_DAMPINGS):
            trial = None
            with contextlib.suppress(np.linalg.LinAlgError):
                trial = apply_step(state, normal.step(damping), basis)
            if trial is not None and np.isfinite(trial.lens).all() and trial.lens[2] > 0:
                trial_error = residuals(trial, observations)
                trial_cost = cost_of(trial_error, trial)
                gained = cost - trial_cost
                if gained >= 0:
                    state, error, cost = trial, trial_error, trial_cost
                    break
            damping = max(damping * 10, 1e-8)
        if not gained >= 0:
            stopped = "no step makes it better"
            break
        damping = max(damping / 10, 1e-12)
        if gained <= _SAME_COST * cost + 1e-18:
            stopped = "a step made it better by less than a part in 10^9"
            break
    return state, AdjustmentStage(name, steps, before, cost, float(slope), stopped, True)


@dataclass(frozen=True)
class ShapePrior:
    """The prior that keeps the board's shape from fitting noise: see `board_shape`."""

    basis: FloatArray
    weight: FloatArray  #: [3C] pixels squared per square squared
    block: FloatArray

    @staticmethod
    def of(observations: CornerObservations, state: CalibrationState) -> ShapePrior:
        basis = gauge_basis(observations.flat)
        sigma = noise_px(residuals(state, observations), observations.visible)
        weight = prior_weights(len(observations.flat)) * sigma**2
        return ShapePrior(basis, weight, basis.T @ (weight[:, None] * basis))

    def cost(self, state: CalibrationState) -> float:
        return float((self.weight * state.shape.reshape(-1) ** 2).sum())

    def added(self, normal: NormalEquations, state: CalibrationState) -> NormalEquations:
        """The equations with the prior added."""
        m = len(state.lens)
        shared, slope = normal.shared.copy(), normal.shared_slope.copy()
        shared[m:, m:] += self.block
        slope[m:] += self.basis.T @ (self.weight * state.shape.reshape(-1))
        return replace(normal, shared=shared, shared_slope=slope)


def whitened(
    jac: Jacobian, error: FloatArray, turn_px: float | None
) -> tuple[Jacobian, FloatArray]:
    """Jacobian and residuals of an ordinary least-squares step for the soft-L1 loss.

    With w = 1 / sqrt(1 + d^2/c^2) the loss has the gradient w J'e and, to the order of Gauss and
    Newton, the curvature J' w (1 - (1 - w^2) ee'/d^2) J: w across the residual, w^3 along it, so
    never negative (Triggs and others, Bundle adjustment, section 4.3).
    """
    if turn_px is None:
        return jac, error
    square = (error * error).sum(-1)
    weight = 1 / np.sqrt(1 + square / turn_px**2)
    root = np.sqrt(weight)
    away = error / np.sqrt(np.maximum(square, 1e-300))[..., None]
    along = (1 - weight)[..., None, None] * away[..., :, None] * away[..., None, :]
    turn = (np.eye(2) - along) * root[..., None, None]
    turned = Jacobian(jac.uv_px, turn @ jac.lens, turn @ jac.pose, turn @ jac.shape)
    return turned, error / root[..., None]


def loss(error: FloatArray, turn_px: float | None) -> float:
    """Sum over corners of the squared distance, or of c^2 * 2 (sqrt(1 + d^2/c^2) - 1)."""
    square = (error * error).sum(-1)
    if turn_px is None:
        return float(square.sum())
    scaled = square / turn_px**2
    return float(2 * turn_px**2 * (scaled / (1 + np.sqrt(1 + scaled))).sum())
