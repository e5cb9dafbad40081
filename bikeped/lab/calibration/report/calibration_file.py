"""`camera_calibration.json`: the fitted lens, as every part of bikeped reads it."""

from __future__ import annotations

import datetime
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from bikeped import __version__
from bikeped.errors import CalibrationError, GeometryError
from bikeped.files import write_whole
from bikeped.geometry import Framing
from bikeped.geometry.lens import unit_radius
from bikeped.lab.calibration.report.field_of_view import FieldOfView
from bikeped.lab.calibration.solver.lens_fit import LensFit
from bikeped.lab.calibration.solver.observations import PreparedObservations

CONVENTION = (
    "r(theta) = focal_length * g(theta) * (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), "
    "g = theta (equidistant), 2 sin(theta/2) (equisolid), 2 tan(theta/2) (stereographic), "
    "sin(theta) (orthographic); pixel (0, 0) is the middle of the top left pixel; "
    "radius_px = focal_length * g(fov_deg/2), without radial terms; errors per point, "
    "sqrt(mean(dx^2 + dy^2))"
)


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
