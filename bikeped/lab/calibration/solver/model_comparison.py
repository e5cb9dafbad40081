"""Several lens models on the same corners, and which one is recommended.

The paper compares the four projections by their RMS reprojection error and confirms the deployed
(equidistant) one because it lies within 2 % of the best. The same 2 % decide here, but on the
cross-validated error, and between radial terms as well: the simplest lens within 2 % of the best is
recommended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bikeped.errors import CalibrationError
from bikeped.geometry.lens import PROJECTIONS, Projection
from bikeped.lab.calibration.solver.lens_fit import LensFit, fit_lens
from bikeped.lab.calibration.solver.lens_model import CalibrationState, LensModel, corner_angles
from bikeped.lab.calibration.solver.normal_equations import single_threaded
from bikeped.lab.calibration.solver.observations import FISHEYE, PreparedObservations

#: Errors within this share of the best count as equal (the paper's criterion).
EQUAL_SHARE = 0.02
#: A relative uncertainty of the focal length beyond this leaves it open.
_WORST_FOCAL_SHARE = 0.02


@dataclass(frozen=True)
class ModelComparison:
    """The fits of several models to one set of boards."""

    prepared: PreparedObservations
    fits: dict[str, LensFit]  #: by name, as in the JSON
    folds: int  #: of the cross-validation; as many as images: each is a fold

    @property
    def ranked(self) -> list[LensFit]:
        """All fits, the least error first."""
        return sorted(self.fits.values(), key=lambda f: f.ranking_px)

    @property
    def one_parameter(self) -> dict[str, LensFit]:
        """The plain projections that were fitted, best first by RMS (the paper's criterion)."""
        plain = [f for f in self.fits.values() if not f.model.terms and not f.model.board]
        return {f.name: f for f in sorted(plain, key=lambda f: f.rms_px)}


@dataclass(frozen=True)
class Recommendation:
    """The model to use, and why, in one sentence."""

    name: str
    reason: str


def comparison_models(chosen: LensModel) -> list[LensModel]:
    """The models that `--compare` fits.

    All projections without and with two radial terms; four, and the board's shape, on the
    equidistant and the chosen one. With four terms all projections are the same lens to a
    thousandth of a pixel (measured), so one stands for all.
    """
    models = [LensModel(p, terms) for terms in (0, 2) for p in FISHEYE]
    projections: list[Projection] = ["equidistant", chosen.projection]
    models += [LensModel(p, 4) for p in projections]
    models += [LensModel(p, terms, board=True) for p in projections for terms in (2, 4)]
    return list(dict.fromkeys([*models, chosen]))


@single_threaded
def fit_models(
    prepared: PreparedObservations,
    models: Sequence[LensModel],
    folds: int,
    progress: Callable[[int], None] = lambda done: None,
) -> ModelComparison:
    """Fits every model; `progress` gets the number done. `folds` 0: each image is a fold.

    CalibrationError where the boards leave the focal length open.
    """
    fits: dict[str, LensFit] = {}
    for number, model in enumerate(models, 1):
        start = initial_state(model, prepared)
        fits[model.name] = fit_lens(prepared.observations, model, start, folds)
        progress(number)
    open_share = min(f.uncertainty["f"] / f.focal_px for f in fits.values())
    if not open_share < _WORST_FOCAL_SHARE:
        raise CalibrationError(
            f"IMAGES: the boards leave the focal length open (to {open_share:.0%}); tilt the board "
            "by 20 to 40 degrees in several directions and bring it out to the rim"
        )
    views = len(prepared.observations)
    return ModelComparison(prepared, fits, min(folds or views, views))


def initial_state(model: LensModel, prepared: PreparedObservations) -> CalibrationState:
    """The start's poses, and the lens of another model that comes nearest to its radii."""
    state, observations = prepared.start, prepared.observations
    theta = corner_angles(state, observations)[observations.visible]
    radius = state.radius_px(theta)
    base = PROJECTIONS[model.projection].radius(theta)
    columns = np.stack([base * theta ** (2 * n) for n in range(model.terms + 1)], axis=1)
    size = np.abs(columns).max(0)
    found, *_ = np.linalg.lstsq(columns / size, radius, rcond=None)
    found = found / size
    if not found[0] > 0:
        found = np.array([float(base @ radius / (base @ base)), *np.zeros(model.terms)])
    lens = np.array([*state.lens[:2], found[0], *(found[1:] / found[0])])
    return replace(state, projection=model.projection, lens=lens)


def recommend_model(comparison: ModelComparison) -> Recommendation:
    """The simplest lens whose cross-validated error is within 2 % of the best.

    Fewer radial terms are simpler; of equally many the equidistant lens, which the paper deploys,
    comes first. The board's shape does not count: it is no part of the lens.
    """
    known = [f for f in comparison.fits.values() if f.held_out_px is not None]
    if not known:
        name = next(iter(comparison.fits))
        return Recommendation(name, f"{name} is the only model that was asked for.")
    errors = {f.name: f.ranking_px for f in known}
    best = min(known, key=lambda f: errors[f.name])
    equal = [f for f in known if errors[f.name] <= errors[best.name] * (1 + EQUAL_SHARE)]
    chosen = min(
        equal, key=lambda f: (f.model.terms, FISHEYE.index(f.model.projection), errors[f.name])
    )
    simpler = [f for f in known if f.model.terms < chosen.model.terms]
    text = "the least of all"
    if chosen is not best:
        text = (
            f"which is within {EQUAL_SHARE:.0%} of the best ({best.name}, "
            f"{errors[best.name]:.3f} px), and no simpler lens is"
        )
    elif simpler:
        name = min(simpler, key=lambda f: errors[f.name]).name
        text += f"; with fewer radial terms the best ({name}) has {errors[name]:.3f} px"
    error = f"{errors[chosen.name]:.3f} px"
    text = f"{chosen.name} predicts pictures that did not help to fit it to {error}, {text}."
    return Recommendation(chosen.name, text)


def paper_criterion(comparison: ModelComparison) -> str:
    """One sentence: the plain projections by RMS, as the paper compares them; empty without all."""
    plain = list(comparison.one_parameter.values())
    if len(plain) < len(FISHEYE):
        return ""
    best = plain[0]
    equidistant = comparison.one_parameter["equidistant"]
    ranking = ", ".join(f"{f.name} {f.rms_px:.3f}" for f in plain)
    share = equidistant.rms_px / best.rms_px - 1
    if best is equidistant:
        verdict = "the equidistant model is the best"
    elif share <= EQUAL_SHARE:
        verdict = f"the equidistant model is within {EQUAL_SHARE:.0%} of the best"
    else:
        verdict = f"the equidistant model is {share:.0%} worse than {best.name}"
    return f"Without radial terms, RMS px: {ranking}; by the paper's criterion {verdict}."
