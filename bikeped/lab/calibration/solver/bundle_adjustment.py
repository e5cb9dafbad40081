"""Bundle adjustment on the projection itself: Levenberg-Marquardt, then soft-L1.

The paper's two stages. The first minimises the squared distance between projected and seen
corners; the second a soft-L1 loss of the distance, which grows like the distance instead of its
square, so that a wrong corner pulls no harder than a slightly wrong one. Each has its own
criterion, and a stage whose result is worse by it than its start is not kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bikeped.geometry.lens import unit_radius
from bikeped.lab.calibration.solver.board_shape import gauge_basis, prior_weights
from bikeped.lab.calibration.solver.jacobian import Jacobian, jacobian
from bikeped.lab.calibration.solver.lens_model import (
    PLAIN,
    Model,
    Sightings,
    State,
    angles,
    camera_points,
    gain,
    residuals,
)
from bikeped.lab.calibration.solver.normal_equations import Normal, moved, normal_equations
from bikeped.lab.calibration.solver.single_thread import one_thread
from bikeped.types import BoolArray, FloatArray

#: The distance's median of plain noise is this many standard deviations of one coordinate.
MEDIAN_OF_NOISE = 1.17741
#: The loss turns from squared to linear here, in standard deviations of one coordinate.
SOFT_L1_TURN = 3.0
_FLOOR_PX = 1e-4
_MOST_STEPS, _MOST_DAMPINGS = 60, 12
_FIRST_DAMPING, _NEAR_DAMPING = 1e-4, 1e-8
_SAME_COST = 1e-9


@dataclass(frozen=True)
class Stage:
    """How one stage went: for the report, and for whoever doubts it."""

    name: str
    steps: int
    cost_before: float  #: by the stage's own criterion, pixels squared
    cost_after: float
    slope: float  #: largest gradient, in pixels (units of one standard deviation at noise of 1 px)
    stopped: str  #: why
    kept: bool


@dataclass(frozen=True)
class Adjusted:
    """A state at its best, how it got there, and what it leaves."""

    model: Model
    state: State
    stages: tuple[Stage, ...]
    residuals_px: FloatArray  #: [V, C, 2], zero where unseen
    sigma_px: float  #: noise of one coordinate, from the median distance


def noise_px(error: FloatArray, seen: BoolArray) -> float:
    """Standard deviation of one coordinate of `error` [V, C, 2], by the median of the distances."""
    distance = np.hypot(error[..., 0], error[..., 1])[seen]
    return max(float(np.median(distance)) / MEDIAN_OF_NOISE, _FLOOR_PX)


@one_thread
def adjust(sightings: Sightings, model: Model, start: State, *, robust: bool = True) -> Adjusted:
    """Both stages from `start` (whose lens is cut or filled up with zeros to the model's terms).

    `robust` False leaves the second stage out.
    """
    lens = np.zeros(PLAIN + model.terms)
    known = min(len(lens), len(start.lens))
    lens[:known] = start.lens[:known]
    state = replace(start, projection=model.projection, lens=lens)
    if not model.board:
        state = replace(state, shape=np.zeros_like(state.shape))
    stages = []
    state, stage = _kept(sightings, model, state, None, "levenberg-marquardt")
    stages.append(stage)
    error = residuals(state, sightings)
    if robust:
        for _ in range(4):  # until the scale, which each pass lowers where corners are wrong, rests
            scale = noise_px(error, sightings.seen) * SOFT_L1_TURN
            state, stage = _kept(sightings, model, state, scale, "soft-l1")
            stages.append(stage)
            error = residuals(state, sightings)
            if noise_px(error, sightings.seen) * SOFT_L1_TURN > 0.9 * scale:
                break
    return Adjusted(model, state, tuple(stages), error, noise_px(error, sightings.seen))


def readjust(sightings: Sightings, fitted: Adjusted) -> State:
    """The last stage again, from a fit to other (or more) pictures: for cross-validation.

    At the fit's own scale: the criterion must not change with the fold.
    """
    turn_px = fitted.sigma_px * SOFT_L1_TURN
    return _kept(sightings, fitted.model, fitted.state, turn_px, "soft-l1")[0]


@dataclass(frozen=True)
class Linear:
    """The last stage's equations at a fit: what it would be without some pictures, by one step.

    A lens that many pictures made moves little when a few are taken away, and one undamped step of
    Gauss and Newton from the optimum gets there (to 1 % of the held-out error, tested).
    """

    fitted: Adjusted
    jac: Jacobian
    pulled: FloatArray
    seen: FloatArray
    prior: _Prior | None

    @staticmethod
    def of(sightings: Sightings, fitted: Adjusted) -> Linear:
        jac, pulled = whitened(
            jacobian(fitted.state, sightings.flat, bent=fitted.model.board),
            fitted.residuals_px,
            fitted.sigma_px * SOFT_L1_TURN,
        )
        prior = _Prior.of(sightings, fitted.state) if fitted.model.board else None
        return Linear(fitted, jac, pulled, sightings.seen.astype(np.float64), prior)

    def without(self, out: BoolArray) -> State:
        """Lens and shape as the pictures that are not `out` [V] have them; poses of those."""
        keep, state = ~out, self.fitted.state
        jac = Jacobian(*(part[keep] for part in self.jac.parts))
        basis = None if self.prior is None else self.prior.basis
        normal = normal_equations(jac, self.pulled[keep], self.seen[keep], basis)
        if self.prior is not None:
            normal = self.prior.added(normal, state)
        return moved(state.rows(keep), normal.step(0.0), basis)


def _kept(
    sightings: Sightings, model: Model, start: State, turn_px: float | None, name: str
) -> tuple[State, Stage]:
    """One stage, and its result only if that is better and still a lens."""
    found, stage = minimise(sightings, model, start, turn_px, name)
    grows = lens_grows(found, sightings)
    better = stage.cost_after <= stage.cost_before and np.isfinite(stage.cost_after) and grows
    if better:
        return found, stage
    why = stage.stopped if grows else "the radius would shrink with the angle"
    return start, replace(stage, kept=False, stopped=why)


def lens_grows(state: State, sightings: Sightings) -> bool:
    """Whether the lens's radius grows with the angle wherever corners were seen."""
    if not (np.isfinite(state.lens).all() and state.lens[2] > 0):
        return False
    if not len(state.lens) > PLAIN:
        return True
    seen = angles(camera_points(state, sightings.flat))[sightings.seen]
    theta: FloatArray = np.linspace(0.0, float(np.quantile(seen, 0.98)), 200, dtype=np.float64)
    radius = unit_radius(state.projection, theta) * gain(theta, state.lens[PLAIN:])
    return bool(np.all(np.diff(radius) > 0)) or state.projection == "orthographic"


def minimise(
    sightings: Sightings, model: Model, start: State, turn_px: float | None, name: str
) -> tuple[State, Stage]:
    """Levenberg-Marquardt on the squared (`turn_px` None) or the soft-L1 loss, turning linear at
    `turn_px`; the latter by weights, so that every step is an ordinary one."""
    flat = sightings.flat
    prior = _Prior.of(sightings, start) if model.board else None
    basis = None if prior is None else prior.basis

    def cost_of(error: FloatArray, state: State) -> float:
        return loss(error, turn_px) + (0.0 if prior is None else prior.cost(state))

    state = start
    error = residuals(state, sightings)
    before = cost = cost_of(error, state)
    damping = _FIRST_DAMPING if turn_px is None else _NEAR_DAMPING
    steps, stopped, slope = 0, "the most steps were taken", np.inf
    while steps < _MOST_STEPS:
        jac, pulled = whitened(jacobian(state, flat, bent=model.board), error, turn_px)
        normal = normal_equations(jac, pulled, sightings.seen.astype(np.float64), basis)
        if prior is not None:
            normal = prior.added(normal, state)
        slope = normal.slope_size
        steps += 1
        gained = -1.0
        for _ in range(_MOST_DAMPINGS):
            trial = _trial(state, normal, damping, basis)
            if trial is not None:
                trial_error = residuals(trial, sightings)
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
    return state, Stage(name, steps, before, cost, float(slope), stopped, True)


@dataclass(frozen=True)
class _Prior:
    """What keeps the board's shape from standing for noise: see `board_shape`."""

    basis: FloatArray
    weight: FloatArray  #: [3C] pixels squared per square squared
    block: FloatArray

    @staticmethod
    def of(sightings: Sightings, state: State) -> _Prior:
        basis = gauge_basis(sightings.flat)
        sigma = noise_px(residuals(state, sightings), sightings.seen)
        weight = prior_weights(len(sightings.flat)) * sigma**2
        return _Prior(basis, weight, basis.T @ (weight[:, None] * basis))

    def cost(self, state: State) -> float:
        return float((self.weight * state.shape.reshape(-1) ** 2).sum())

    def added(self, normal: Normal, state: State) -> Normal:
        """The equations with the prior's in them."""
        m = len(state.lens)
        shared, slope = normal.shared.copy(), normal.shared_slope.copy()
        shared[m:, m:] += self.block
        slope[m:] += self.basis.T @ (self.weight * state.shape.reshape(-1))
        return replace(normal, shared=shared, shared_slope=slope)


def _trial(state: State, normal: Normal, damping: float, basis: FloatArray | None) -> State | None:
    """The state one damped step on; None where there is no such lens."""
    try:
        step = normal.step(damping)
    except np.linalg.LinAlgError:
        return None
    trial = moved(state, step, basis)
    return trial if np.isfinite(trial.lens).all() and trial.lens[2] > 0 else None


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
    turn = (
        np.eye(2) - (1 - weight)[..., None, None] * away[..., :, None] * away[..., None, :]
    ) * root[..., None, None]
    return (
        Jacobian(jac.uv_px, turn @ jac.lens, turn @ jac.pose, turn @ jac.shape),
        error / root[..., None],
    )


def loss(error: FloatArray, turn_px: float | None) -> float:
    """Sum over corners of the squared distance, or of c^2 * 2 (sqrt(1 + d^2/c^2) - 1)."""
    square = (error * error).sum(-1)
    if turn_px is None:
        return float(square.sum())
    scaled = square / turn_px**2
    return float(2 * turn_px**2 * (scaled / (1 + np.sqrt(1 + scaled))).sum())
