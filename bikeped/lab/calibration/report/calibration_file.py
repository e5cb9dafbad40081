"""`camera_calibration.json`: the fitted lens as every other part of bikeped reads it."""

from __future__ import annotations

import datetime
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bikeped import __version__
from bikeped.errors import CalibrationError, GeometryError
from bikeped.files import write_whole
from bikeped.geometry import Framing
from bikeped.geometry.lens import LIMITS, unit_radius
from bikeped.lab.calibration.solver.compare import Calibrated
from bikeped.lab.calibration.solver.lens_fit import Fit
from bikeped.types import FloatArray

CONVENTION = (
    "r(theta) = focal_length * g(theta) * (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), "
    "g = theta (equidistant), 2 sin(theta/2) (equisolid), 2 tan(theta/2) (stereographic), "
    "sin(theta) (orthographic); pixel (0, 0) is the middle of the top left pixel; "
    "radius_px = focal_length * g(fov_deg/2), without radial terms; errors per point, "
    "sqrt(mean(dx^2 + dy^2))"
)
#: The field of view ends where a pixel spans this many times the angle that it spans in the middle.
_LEAST_SLOPE = 0.1
#: ... or where the radius, extrapolated beyond the corners, is known no better than this share.
_MOST_SIGMA_SHARE = 1 / 300
ENDS_SLOW = "the angle where the fitted radius stops growing"
ENDS_VAGUE = "the angle where the boards no longer say what the radius is"
_SAMPLES = 4000


@dataclass(frozen=True)
class Field:
    """Where the lens's field of view ends: half of it, and what set the end."""

    half_rad: float
    circle_px: float  #: radius of the image circle, radial terms included
    ends_at: str  #: what set the end: the image circle, the picture's corner, or the model

    @property
    def fov_deg(self) -> float:
        return math.degrees(2 * self.half_rad)


def field_of_view(
    fit: Fit, circle_px: float | None, window_px: tuple[float, float, float, float]
) -> Field:
    """How far the fitted lens may be used.

    Out to the image circle where the pictures show it (`circle_px`), else to the farthest pixel of
    `window_px` (u0, v0, u1, v1), but never to where the model's radius hardly grows any more, nor
    to where the boards, which may not reach so far, no longer say what the radius is.
    """
    u0, v0, u1, v1 = window_px
    far = math.hypot(max(fit.cx - u0, u1 - fit.cx), max(fit.cy - v0, v1 - fit.cy))
    radius, ends_at = far, "the corner of the picture"
    if circle_px is not None and circle_px < far:
        radius, ends_at = circle_px, "the image circle"
    limit = LIMITS[fit.model.projection]
    theta: FloatArray = np.linspace(0.0, limit, _SAMPLES, dtype=np.float64)
    grown = fit.radius(theta)
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
    return Field(half, radius, ends_at)


def calibration_data(
    calibrated: Calibrated,
    fit: Fit,
    field: Field,
    framing: Framing | None,
    now: datetime.datetime | None = None,
) -> dict[str, Any]:
    """The file's keys. `framing`: of sensor frames; None: the pictures are taken as they are.

    CalibrationError when the fit is no lens over its field.
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
    sightings, prepared = fit.sightings, calibrated.prepared
    unit = float(unit_radius(fit.model.projection, np.asarray(half)))
    k1, k2, k3, k4 = fit.state.terms
    return {
        "model": fit.model.projection,
        "cx": fit.cx,
        "cy": fit.cy,
        "focal_length": fit.focal_px,
        "fov_deg": fov_deg,
        "radius_px": fit.focal_px * unit,
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "k4": k4,
        "rms_error_px": fit.rms_px,
        "rms_per_coordinate_px": fit.rms_per_coordinate_px,
        "cross_validated_px": fit.cross_validated_px,
        "num_frames": len(sightings),
        "num_points": int(sightings.seen.sum()),
        "frame_width": sightings.width if framing is None else framing.sensor_w,
        "frame_height": sightings.height if framing is None else framing.sensor_h,
        "pad_size": None if framing is None else framing.pad_size,
        "crop_size": None if framing is None else framing.crop_size,
        "convention": CONVENTION,
        "board_shape_fitted": fit.model.board,
        "circle_radius_px": field.circle_px,
        "fov_ends_at": field.ends_at,
        "measured_to_deg": math.degrees(fit.measured_to_rad),
        "uncertainty": known(fit.uncertainty),
        "pattern": f"{sightings.pattern.columns}x{sightings.pattern.rows}",
        "date": (now or datetime.datetime.now(datetime.timezone.utc)).isoformat(timespec="seconds"),
        "software_version": __version__,
        "pictures_hash": prepared.pictures_hash,
    }


def known(uncertainty: dict[str, float]) -> dict[str, float | None]:
    """For JSON, which knows no infinity: null where the pictures leave a parameter open."""
    return {name: sigma if math.isfinite(sigma) else None for name, sigma in uncertainty.items()}


def write_calibration(path: Path, data: dict[str, Any]) -> Path | None:
    """Writes the file whole; what was there is kept as `NAME.bak`, whose path is returned."""
    kept = None
    if path.is_file():
        kept = path.with_name(path.name + ".bak")
        write_whole(kept, path.read_bytes())
    write_whole(path, json.dumps(data, indent=2, allow_nan=False) + "\n")
    return kept
