"""The result of a calibration: field of view, `camera_calibration.json`, JSON, cautions."""

from __future__ import annotations

import datetime
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bikeped import __version__
from bikeped.config.lens_check import checksum
from bikeped.errors import CalibrationError, GeometryError
from bikeped.files import write_whole
from bikeped.geometry.framing import Framing
from bikeped.geometry.lens import PROJECTIONS
from bikeped.lab.calibration.capture.coverage import Coverage
from bikeped.lab.calibration.solver.lens_fit import LensFit, rms_by_image
from bikeped.lab.calibration.solver.model_comparison import ModelComparison, Recommendation
from bikeped.lab.calibration.solver.observations import PreparedObservations
from bikeped.types import FloatArray, ImageArray

#: The rim is searched along so many directions.
_SECTORS = 180
#: Dark is below this share of the 90th percentile of the grey levels.
_DARK_SHARE = 0.5
#: The rim must be visible in so many directions, and dark outside it for so many pixels.
_FEWEST_SECTORS = 12
_DARK_PX = 4
#: The field of view ends where a pixel spans this many times the angle that it spans in the middle.
_LEAST_SLOPE = 0.1
#: ... or where the radius, extrapolated beyond the corners, is known no better than this share.
_MOST_SIGMA_SHARE = 1 / 300
ENDS_SLOW = "the angle where the fitted radius stops growing"
ENDS_VAGUE = "the angle where the boards no longer say what the radius is"
_SAMPLES = 4000
#: Fewer boards than this do not cover a lens; the paper used 42.
_FEW_BOARDS = 10
#: Corners should reach this share of the field of view.
_REACH_SHARE = 0.85
CONVENTION = (
    "r(theta) = focal_length * g(theta) * (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), "
    "g = theta (equidistant), 2 sin(theta/2) (equisolid), 2 tan(theta/2) (stereographic), "
    "sin(theta) (orthographic); pixel (0, 0) is the middle of the top left pixel; "
    "radius_px = focal_length * g(fov_deg/2), without radial terms; errors per point, "
    "sqrt(mean(dx^2 + dy^2))"
)


@dataclass(frozen=True)
class FieldOfView:
    """Half the field of view, and what limits it."""

    half_rad: float
    circle_px: float  #: radius of the image circle, radial terms included
    ends_at: str  #: the image circle, the image's corner, or the model

    @property
    def fov_deg(self) -> float:
        return math.degrees(2 * self.half_rad)


def field_of_view(
    fit: LensFit, circle_px: float | None, window_px: tuple[float, float, float, float]
) -> FieldOfView:
    """How far the fitted lens may be used.

    Out to the image circle where the images show it (`circle_px`), else to the farthest pixel of
    `window_px` (u0, v0, u1, v1), but never to where the model's radius hardly grows any more, nor
    to where the radius, extrapolated beyond the boards, is too uncertain.
    """
    u0, v0, u1, v1 = window_px
    far = math.hypot(max(fit.cx - u0, u1 - fit.cx), max(fit.cy - v0, v1 - fit.cy))
    radius, ends_at = far, "the corner of the picture"
    if circle_px is not None and circle_px < far:
        radius, ends_at = circle_px, "the image circle"
    limit = PROJECTIONS[fit.model.projection].limit_rad
    theta: FloatArray = np.linspace(0.0, limit, _SAMPLES, dtype=np.float64)
    grown = fit.state.radius_px(theta)
    slow = np.diff(grown, append=np.inf) < _LEAST_SLOPE * fit.focal_px * theta[1]
    vague = fit.radius_sigma_px(theta) > _MOST_SIGMA_SHARE * grown
    vague &= theta > fit.measured_to_rad
    ends = np.flatnonzero(slow | vague)
    reach = int(ends[0]) if len(ends) else _SAMPLES - 1
    if grown[reach] <= radius:
        ends_at = ENDS_VAGUE if vague[reach] else ENDS_SLOW
        radius, half = float(grown[reach]), float(theta[reach])
    else:
        half = float(np.interp(radius, grown[: reach + 1], theta[: reach + 1]))
    return FieldOfView(half, radius, ends_at)


def circle_radius_px(bright: ImageArray, centre_px: FloatArray) -> float | None:
    """Radius of the image circle about `centre_px`; None where the images do not show its rim.

    `bright` [h, w]: each pixel's brightest value over the images, dark only outside the circle.
    Each direction is followed outwards to where it stays dark. Directions in which the image ends
    first do not count. The rim is the upper quartile of the others, because a dark object at the
    rim ends some directions early.
    """
    height, width = bright.shape
    level = float(np.percentile(bright, 90)) * _DARK_SHARE
    reach = int(np.hypot(width, height))
    step = np.arange(reach)
    rims = []
    for angle in np.arange(_SECTORS) * 2 * np.pi / _SECTORS:
        u = np.rint(centre_px[0] + step * np.cos(angle)).astype(np.int64)
        v = np.rint(centre_px[1] + step * np.sin(angle)).astype(np.int64)
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        lit = bright[v[inside], u[inside]] > level
        if not lit.any():
            continue
        last = int(np.flatnonzero(lit)[-1])
        if last + _DARK_PX < int(inside.sum()):
            rims.append(last + 0.5)
    if len(rims) < _FEWEST_SECTORS:
        return None
    return float(np.percentile(rims, 75))


def calibration_data(
    prepared: PreparedObservations,
    fit: LensFit,
    field: FieldOfView,
    framing: Framing | None,
    now: datetime.datetime | None = None,
) -> dict[str, Any]:
    """The file's keys. `framing`: of sensor frames; None: the images are used as they are.

    CalibrationError where the fit is no lens over its field.
    """
    # Rounded first, so that the file's own numbers agree to the last bit.
    fov_deg = math.floor(field.fov_deg * 1e4) / 1e4
    half = math.radians(fov_deg) / 2
    try:
        fit.lens(half)
    except GeometryError as error:
        raise CalibrationError(
            f"{fit.name}: no lens over {fov_deg:.1f} degrees ({error}); fit fewer radial terms"
        ) from error
    observations = fit.observations
    unit = float(PROJECTIONS[fit.model.projection].radius(np.asarray(half)))
    values = {
        "model": fit.model.projection,
        "cx": fit.cx,
        "cy": fit.cy,
        "focal_length": fit.focal_px,
        "fov_deg": fov_deg,
        "radius_px": fit.focal_px * unit,
        **dict(zip(("k1", "k2", "k3", "k4"), fit.state.terms, strict=True)),
        "rms_error_px": fit.rms_px,
        "rms_per_coordinate_px": fit.rms_per_coordinate_px,
        "cross_validated_px": fit.cross_validated_px,
        "num_frames": len(observations),
        "num_points": int(observations.visible.sum()),
        "frame_width": observations.width if framing is None else framing.sensor_w,
        "frame_height": observations.height if framing is None else framing.sensor_h,
        "pad_size": None if framing is None else framing.pad_size,
        "crop_size": None if framing is None else framing.crop_size,
        "convention": CONVENTION,
        "board_shape_fitted": fit.model.board,
        "circle_radius_px": field.circle_px,
        "fov_ends_at": field.ends_at,
        "measured_to_deg": math.degrees(fit.measured_to_rad),
        "uncertainty": finite_or_null(fit.uncertainty),
        "pattern": f"{observations.pattern.columns}x{observations.pattern.rows}",
        "date": (now or datetime.datetime.now(datetime.timezone.utc)).isoformat(timespec="seconds"),
        "software_version": __version__,
        "pictures_hash": prepared.images_hash,
    }
    return {**values, "checksum": checksum(values), "complete": True}


def finite_or_null(uncertainty: dict[str, float]) -> dict[str, float | None]:
    """For JSON, which has no infinity: null where the images leave a parameter open."""
    return {name: sigma if math.isfinite(sigma) else None for name, sigma in uncertainty.items()}


def write_calibration(path: Path, data: dict[str, Any]) -> Path | None:
    """Writes the file; an existing one is kept as `NAME.bak`, whose path is returned."""
    kept = None
    if path.is_file():
        kept = path.with_name(path.name + ".bak")
        write_whole(kept, path.read_bytes())
    write_whole(path, json.dumps(data, indent=2, allow_nan=False) + "\n")
    return kept


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
    k, held = fit.state.terms[: fit.model.terms], fit.cross_validated_px
    by_image = rms_by_image(fit.residuals_px, fit.observations)
    return {
        "rms_px": fit.rms_px,
        "rms_per_coordinate_px": fit.rms_per_coordinate_px,
        "cross_validated_px": fit.cross_validated_px,
        "cross_validated_per_coordinate_px": None if held is None else held / math.sqrt(2),
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
        "stages": [asdict(stage) for stage in fit.stages],
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
