"""Cross-validation: how well the lens predicts pictures that did not help to fit it.

The pictures are dealt into folds. Lens and board shape are fitted on all folds but one; on the one
held out only the poses are fitted, with lens and shape as they are; what is left there is counted.
A model that bends to the noise of its own pictures is found out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bikeped.lab.calibration.solver.bundle_adjustment import Adjusted, Linear, readjust
from bikeped.lab.calibration.solver.jacobian import jacobian
from bikeped.lab.calibration.solver.lens_model import Sightings, State, residuals, rotations
from bikeped.lab.calibration.solver.single_thread import one_thread
from bikeped.types import FloatArray, IntArray

#: Fewer pictures than this are fitted anew for every fold; with more, one step is as good.
_FIT_ANEW = 10


def folds_of(pictures: int, folds: int) -> IntArray:
    """[pictures] the fold of each: dealt in turn, so that neighbours in time are split.

    `folds` 0: each picture by itself.
    """
    return np.arange(pictures) % min(folds or pictures, pictures)


@one_thread
def held_out_residuals(fitted: Adjusted, sightings: Sightings, folds: int) -> FloatArray:
    """[V, C, 2] residuals of each picture under the lens that the other folds give, pixels."""
    fold = folds_of(len(sightings), folds)
    linear = Linear.of(sightings, fitted) if len(sightings) >= _FIT_ANEW else None
    lens = np.empty((len(sightings), 1, len(fitted.state.lens)))
    shape = np.empty((len(sightings), *fitted.state.shape.shape))
    for number in range(fold.max() + 1):
        out = fold == number
        if linear is not None:
            train = linear.without(out)
        else:
            near = replace(fitted, state=fitted.state.rows(~out))
            train = readjust(sightings.rows(~out), near)
        lens[out], shape[out] = train.lens, train.shape
    state = replace(fitted.state, lens=lens, shape=shape)
    return residuals(fit_poses(state, sightings), sightings)


def fit_poses(start: State, sightings: Sightings, steps: int = 20) -> State:
    """The poses that fit best under the lens and shape of `start`, each picture by itself."""
    state = start
    error = residuals(state, sightings)
    cost: FloatArray = np.asarray((error * error).sum((1, 2)))
    damping: FloatArray = np.full(len(cost), 1e-8)
    index = np.arange(6)
    for _ in range(steps):
        jac = jacobian(state, sightings.flat, bent=False).pose * sightings.seen[..., None, None]
        tall = jac.reshape(len(cost), -1, 6)
        normal = tall.transpose(0, 2, 1) @ tall
        slope = (tall.transpose(0, 2, 1) @ error.reshape(len(cost), -1, 1))[..., 0]
        normal[:, index, index] *= 1 + damping[:, None]
        step: FloatArray = np.asarray(-np.linalg.solve(normal, slope[..., None])[..., 0])
        trial = replace(
            state, turn=rotations(step[:, :3]) @ state.turn, move=state.move + step[:, 3:]
        )
        trial_error = residuals(trial, sightings)
        trial_cost = (trial_error * trial_error).sum((1, 2))
        better = trial_cost <= cost
        rests = np.abs(cost - trial_cost) <= 1e-9 * cost + 1e-18
        state = replace(
            state,
            turn=np.where(better[:, None, None], trial.turn, state.turn),
            move=np.where(better[:, None], trial.move, state.move),
        )
        error = np.where(better[:, None, None], trial_error, error)
        cost = np.asarray(np.where(better, trial_cost, cost))
        damping = np.asarray(np.where(better, damping / 10, damping * 10))
        if rests.all():
            break
    return state
