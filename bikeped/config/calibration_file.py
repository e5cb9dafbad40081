"""`camera_calibration.json`: the lens as it was measured."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from bikeped.errors import CalibrationError

Finite = Annotated[float, Meta(ge=-1e6, le=1e6)]
Side = Annotated[int, Meta(ge=1, le=100_000)]


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """Intrinsics of one camera; lengths in pixels of the crop. Unknown keys are kept out."""

    model: str
    cx: Finite
    cy: Finite
    focal_length: Annotated[float, Meta(gt=0, le=1e6)]
    fov_deg: Annotated[float, Meta(gt=0, le=360)]
    radius_px: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    k1: Finite = 0.0
    k2: Finite = 0.0
    k3: Finite = 0.0
    k4: Finite = 0.0
    rms_error_px: Finite | None = None
    num_frames: int | None = None
    num_points: int | None = None
    frame_width: Side | None = None
    frame_height: Side | None = None
    pad_size: Side | None = None
    crop_size: Side | None = None


def load_calibration(path: Path) -> tuple[Calibration, str]:
    """The calibration and the SHA-256 of its file; CalibrationError names file, key and remedy."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CalibrationError(
            f"{path}: cannot be read ({error.strerror}); correct camera.calibration, or set it "
            "to null and give camera.radius_px and camera.fov_deg"
        ) from error
    try:
        calibration = msgspec.json.decode(data, type=Calibration)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"{path}: {error}; compare it with the camera_calibration.json that comes with bikeped"
        ) from error
    return calibration, hashlib.sha256(data).hexdigest()
