"""The result of a calibration: the JSON of `bikeped calibrate`, and cautions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bikeped.geometry import Framing
from bikeped.lab.calibration.capture.coverage import Coverage
from bikeped.lab.calibration.report.calibration_file import finite_or_null
from bikeped.lab.calibration.report.field_of_view import ENDS_SLOW, ENDS_VAGUE, FieldOfView
from bikeped.lab.calibration.solver.lens_fit import LensFit, rms_by_image
from bikeped.lab.calibration.solver.model_comparison import ModelComparison, Recommendation
from bikeped.lab.calibration.solver.observations import PreparedObservations

#: Fewer boards than this do not cover a lens; the paper used 42.
_FEW_BOARDS = 10
#: Corners should reach this share of the field of view.
_REACH_SHARE = 0.85


@dataclass(frozen=True)
class CalibrationResult:
    """All fits, the one that is written, and what to know about it."""

    comparison: ModelComparison
    chosen: LensFit
    recommendation: Recommendation
    field: FieldOfView
    coverage: Coverage
    cautions: Sequence[str]
    framing: Framing | None = None  #: of sensor frames; None: the images are used as they are


def result_data(result: CalibrationResult) -> dict[str, Any]:
    """The JSON of `bikeped calibrate`; its keys are fixed. Errors in pixels."""
    comparison, recommendation = result.comparison, result.recommendation
    prepared = comparison.prepared
    observations = prepared.observations
    plain = comparison.one_parameter
    return {
        "boards_total": prepared.images,
        "boards_used": len(observations),
        "refused": [{"file": Path(r.file).name, "why": r.reason} for r in prepared.refused],
        "corners": int(observations.visible.sum()),
        "corners_of_a_board": observations.pattern.count,
        "corners_by_picture": {
            Path(name).name: int(count)
            for name, count in zip(observations.names, observations.visible.sum(1), strict=True)
        },
        "corners_left_out": [
            {"file": Path(c.file).name, "corner": c.corner, "off_px": round(c.off_px, 3)}
            for c in prepared.outliers
        ],
        "best_one_parameter_model": next(iter(plain)) if len(plain) > 1 else None,
        "recommended": recommendation.name,
        "recommended_why": recommendation.reason,
        "chosen": result.chosen.name,
        "folds": comparison.folds,
        "cautions": list(result.cautions),
        "pictures_hash": prepared.images_hash,
        "fits": {name: _fit_data(fit) for name, fit in comparison.fits.items()},
        "coverage": {"share": result.coverage.share, "next": result.coverage.advice()},
    }


def _fit_data(fit: LensFit) -> dict[str, Any]:
    """One model: errors, parameters with their uncertainty, the stages of the adjustment."""
    k = fit.state.terms[: fit.model.terms]
    by_image = rms_by_image(fit.residuals_px, fit.observations)
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
        "uncertainty": finite_or_null(fit.uncertainty),
        "measured_to_deg": math.degrees(fit.measured_to_rad),
        "rms_by_picture_px": {
            Path(name).name: float(error)
            for name, error in zip(fit.observations.names, by_image, strict=True)
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


#: Errors in px; the columns of `model_row`.
MODEL_COLUMNS = ("model", "cross-validated", "RMS per point", "per coordinate", "f", "cx", "cy")


def model_row(fit: LensFit) -> tuple[str, ...]:
    """One model's line in the tables for people."""
    held, sigma = fit.cross_validated_px, fit.uncertainty
    return (
        fit.name,
        "—" if held is None else f"{held:.4f}",
        f"{fit.rms_px:.4f}",
        f"{fit.rms_per_coordinate_px:.4f}",
        f"{fit.focal_px:.3f} ± {sigma['f']:.3f}",
        f"{fit.cx:.2f} ± {sigma['cx']:.2f}",
        f"{fit.cy:.2f} ± {sigma['cy']:.2f}",
    )


def calibration_cautions(
    prepared: PreparedObservations, fit: LensFit, field: FieldOfView
) -> list[str]:
    """Warnings about the fit, one sentence each; empty where there is none."""
    out = []
    observations = fit.observations
    if len(observations) < _FEW_BOARDS:
        out.append(
            f"only {len(observations)} boards: photograph 15 or more, tilted, all over the picture"
        )
    reach, half = math.degrees(fit.measured_to_rad), math.degrees(field.half_rad)
    if reach < _REACH_SHARE * half:
        out.append(
            f"corners reach {reach:.0f} of {half:.0f} degrees from the axis; beyond that the lens "
            "is extrapolated: photograph boards nearer to the rim"
        )
    if field.ends_at in (ENDS_SLOW, ENDS_VAGUE):
        out.append(f"the field of view ends at {half:.0f} degrees from the axis, {field.ends_at}")
    if prepared.outliers:
        files = len({c.file for c in prepared.outliers})
        out.append(
            f"{len(prepared.outliers)} corners in {files} pictures are off by more than noise "
            "explains and were left out"
        )
    error = fit.cross_validated_px
    if error is not None and error > 1.5 * fit.rms_px:
        out.append(
            f"held-out pictures are {error / fit.rms_px:.1f} times as far off as fitted ones: too "
            "few pictures for this model"
        )
    return out
