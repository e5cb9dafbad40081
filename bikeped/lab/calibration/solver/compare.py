"""Several lens models on the very same corners, and which of them to trust.

The paper compares the four projections by their RMS reprojection error and holds the deployed
(equidistant) one confirmed because it lies within 2 % of the best. The same 2 % decide here, but on
the cross-validated error, and between radial terms as well: the simplest lens within 2 % of the
best is recommended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bikeped.errors import CalibrationError
from bikeped.geometry.lens import Projection, unit_radius
from bikeped.lab.calibration.board_view import Refused
from bikeped.lab.calibration.solver.initial_guess import FISHEYE
from bikeped.lab.calibration.solver.lens_fit import Fit, fit
from bikeped.lab.calibration.solver.lens_model import (
    PLAIN,
    Model,
    State,
    angles,
    camera_points,
    gain,
)
from bikeped.lab.calibration.solver.observations import Prepared
from bikeped.lab.calibration.solver.outliers import LeftOut
from bikeped.lab.calibration.solver.single_thread import one_thread

#: Errors within this share of the best count as equal (the paper's criterion).
EQUAL_SHARE = 0.02
#: A focal length known no better than this is not known.
_WORST_FOCAL_SHARE = 0.02


@dataclass(frozen=True)
class Calibrated:
    """What the fits of one set of boards say."""

    prepared: Prepared
    fits: dict[str, Fit]  #: by name, as in the JSON
    folds: int  #: of the cross-validation; as many as pictures: each by itself

    @property
    def refused(self) -> tuple[Refused, ...]:
        return self.prepared.refused

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        return self.prepared.left_out

    @property
    def one_parameter(self) -> dict[str, Fit]:
        """The plain projections that were fitted, best first by RMS (the paper's criterion)."""
        plain = [f for f in self.fits.values() if not f.model.terms and not f.model.board]
        return {f.name: f for f in sorted(plain, key=lambda f: f.rms_px)}


@dataclass(frozen=True)
class Recommendation:
    """The model to use, and why, in one sentence."""

    name: str
    why: str


def models_to_compare(chosen: Model) -> list[Model]:
    """All projections without and with two radial terms; four, and the board's shape, on the
    equidistant and the chosen one.

    With four terms all projections are the same lens to a thousandth of a pixel (measured), so that
    one would stand for all.
    """
    models = [Model(p, terms) for terms in (0, 2) for p in FISHEYE]
    projections: list[Projection] = ["equidistant", chosen.projection]
    models += [Model(p, 4) for p in projections]
    models += [Model(p, terms, board=True) for p in projections for terms in (2, 4)]
    return list(dict.fromkeys([*models, chosen]))


@one_thread
def calibrate(
    prepared: Prepared,
    models: Sequence[Model],
    folds: int,
    progress: Callable[[int], None] = lambda done: None,
) -> Calibrated:
    """Fits every model; `progress` gets the number done. `folds` 0: each picture by itself.

    CalibrationError where the boards leave the focal length open.
    """
    fits: dict[str, Fit] = {}
    for number, model in enumerate(models):
        start = start_for(model, prepared.start, prepared)
        fits[model.name] = fit(prepared.sightings, model, start, folds)
        progress(number + 1)
    views = len(prepared.sightings)
    calibrated = Calibrated(prepared, fits, min(folds or views, views))
    open_share = min(f.uncertainty["f"] / f.focal_px for f in fits.values())
    if not open_share < _WORST_FOCAL_SHARE:
        raise CalibrationError(
            f"IMAGES: the boards leave the focal length open (to {open_share:.0%}); tilt the board "
            "by 20 to 40 degrees in several directions and bring it out to the rim"
        )
    return calibrated


def start_for(model: Model, state: State, prepared: Prepared) -> State:
    """The same poses, and the lens of another model that comes nearest to this one's radii."""
    sightings = prepared.sightings
    theta = angles(camera_points(state, sightings.flat))[sightings.seen]
    radius = state.lens[2] * unit_radius(state.projection, theta) * gain(theta, state.lens[PLAIN:])
    base = unit_radius(model.projection, theta)
    columns = np.stack([base * theta ** (2 * n) for n in range(model.terms + 1)], axis=1)
    size = np.abs(columns).max(0)
    found, *_ = np.linalg.lstsq(columns / size, radius, rcond=None)
    found = found / size
    if not found[0] > 0:
        found = np.array([float(base @ radius / (base @ base)), *np.zeros(model.terms)])
    lens = np.array([*state.lens[:2], found[0], *(found[1:] / found[0])])
    return replace(state, projection=model.projection, lens=lens)


def recommend(calibrated: Calibrated) -> Recommendation:
    """The simplest lens whose cross-validated error is within 2 % of the best.

    Fewer radial terms are simpler; of equally many the equidistant lens, which the paper deploys,
    comes first. The board's shape does not count: it is no part of the lens.
    """
    errors = {n: f.cross_validated_px for n, f in calibrated.fits.items()}
    known = [f for f in calibrated.fits.values() if f.held_out_px is not None]
    if not known:
        name = next(iter(calibrated.fits))
        return Recommendation(name, f"{name} is the only model that was asked for.")

    def error(f: Fit) -> float:
        return errors[f.name] or 0.0

    best = min(known, key=error)
    equal = [f for f in known if error(f) <= error(best) * (1 + EQUAL_SHARE)]
    order: tuple[Projection, ...] = FISHEYE
    chosen = min(
        equal,
        key=lambda f: (f.model.terms, order.index(f.model.projection), error(f)),
    )
    text = f"{chosen.name} predicts pictures that did not help to fit it to {error(chosen):.3f} px"
    if chosen is best:
        simpler = [f for f in known if f.model.terms < chosen.model.terms]
        if simpler:
            next_best = min(simpler, key=error)
            text += (
                f", the least of all; with fewer radial terms the best ({next_best.name}) has "
                f"{error(next_best):.3f} px"
            )
        else:
            text += ", the least of all"
    else:
        text += (
            f", which is within {EQUAL_SHARE:.0%} of the best ({best.name}, {error(best):.3f} px), "
            "and no simpler lens is"
        )
    return Recommendation(chosen.name, text + ".")


def paper_criterion(calibrated: Calibrated) -> str:
    """One sentence: the plain projections by RMS, as the paper compares them; empty without all."""
    plain = list(calibrated.one_parameter.values())
    if len(plain) < len(FISHEYE):
        return ""
    best = plain[0]
    equidistant = calibrated.one_parameter["equidistant"]
    ranking = ", ".join(f"{f.name} {f.rms_px:.3f}" for f in plain)
    share = equidistant.rms_px / best.rms_px - 1
    if best is equidistant:
        verdict = "the equidistant model is the best"
    elif share <= EQUAL_SHARE:
        verdict = f"the equidistant model is within {EQUAL_SHARE:.0%} of the best"
    else:
        verdict = f"the equidistant model is {share:.0%} worse than {best.name}"
    return f"Without radial terms, RMS px: {ranking}; by the paper's criterion {verdict}."
