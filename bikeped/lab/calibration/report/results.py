"""What a calibration says, as data: the JSON of `bikeped calibrate`, and words of caution."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from bikeped.lab.calibration.report.calibration_file import ENDS_SLOW, ENDS_VAGUE, Field, known
from bikeped.lab.calibration.solver.compare import Calibrated, Recommendation
from bikeped.lab.calibration.solver.lens_fit import Fit, rms_by_picture

#: Fewer boards than this leave a lens to chance; the paper used 42.
_FEW_BOARDS = 10
#: Corners should reach this share of the field of view.
_REACH_SHARE = 0.85


def result_data(
    calibrated: Calibrated, chosen: Fit, recommendation: Recommendation, cautions: list[str]
) -> dict[str, Any]:
    """The keys that `interfaces` fixes, and more beside them. Errors in pixels."""
    prepared = calibrated.prepared
    sightings = prepared.sightings
    plain = calibrated.one_parameter
    return {
        "boards_total": prepared.boards_total,
        "boards_used": len(sightings),
        "refused": [{"file": Path(r.name).name, "why": r.why} for r in calibrated.refused],
        "corners": int(sightings.seen.sum()),
        "corners_of_a_board": sightings.pattern.count,
        "corners_by_picture": {
            Path(name).name: int(count)
            for name, count in zip(sightings.names, sightings.seen.sum(1), strict=True)
        },
        "corners_left_out": [
            {"file": Path(c.name).name, "corner": c.corner, "off_px": round(c.off_px, 3)}
            for c in calibrated.left_out
        ],
        "best_one_parameter_model": next(iter(plain)) if len(plain) > 1 else None,
        "recommended": recommendation.name,
        "recommended_why": recommendation.why,
        "chosen": chosen.name,
        "folds": calibrated.folds,
        "cautions": cautions,
        "pictures_hash": prepared.pictures_hash,
        "fits": {name: fit_data(fit) for name, fit in calibrated.fits.items()},
    }


def fit_data(fit: Fit) -> dict[str, Any]:
    """One model: errors, parameters with their uncertainty, how the adjustment went."""
    k = fit.state.terms[: fit.model.terms]
    by_picture = rms_by_picture(fit.residuals_px, fit.sightings)
    return {
        "rms_px": fit.rms_px,
        "rms_per_coordinate_px": fit.rms_per_coordinate_px,
        "cross_validated_px": fit.cross_validated_px,
        "cross_validated_per_coordinate_px": None
        if fit.cross_validated_px is None
        else fit.cross_validated_px / math.sqrt(2),
        "cx": fit.cx,
        "cy": fit.cy,
        "f": fit.focal_px,
        **{f"k{n + 1}": value for n, value in enumerate(k)},
        "uncertainty": known(fit.uncertainty),
        "measured_to_deg": math.degrees(fit.measured_to_rad),
        "rms_by_picture_px": {
            Path(name).name: float(error)
            for name, error in zip(fit.sightings.names, by_picture, strict=True)
        },
        "stages": [
            {
                "name": s.name,
                "steps": s.steps,
                "cost_before": s.cost_before,
                "cost_after": s.cost_after,
                "gradient": s.slope,
                "stopped": s.stopped,
                "kept": s.kept,
            }
            for s in fit.stages
        ],
    }


def cautions_of(calibrated: Calibrated, fit: Fit, field: Field) -> list[str]:
    """What a person should know before trusting the fit; empty when all is well."""
    out = []
    sightings = fit.sightings
    if len(sightings) < _FEW_BOARDS:
        out.append(
            f"only {len(sightings)} boards: photograph 15 or more, tilted, all over the picture"
        )
    reach, half = math.degrees(fit.measured_to_rad), math.degrees(field.half_rad)
    if reach < _REACH_SHARE * half:
        out.append(
            f"corners reach {reach:.0f} of {half:.0f} degrees from the axis; beyond that the lens "
            "is extrapolated: photograph boards nearer to the rim"
        )
    if field.ends_at in (ENDS_SLOW, ENDS_VAGUE):
        out.append(f"the field of view ends at {half:.0f} degrees from the axis, {field.ends_at}")
    if calibrated.left_out:
        files = len({c.name for c in calibrated.left_out})
        out.append(
            f"{len(calibrated.left_out)} corners in {files} pictures are off by more than noise "
            "explains and were left out"
        )
    error = fit.cross_validated_px
    if error is not None and error > 1.5 * fit.rms_px:
        out.append(
            f"held-out pictures are {error / fit.rms_px:.1f} times as far off as fitted ones: too "
            "few pictures for this model"
        )
    return out
