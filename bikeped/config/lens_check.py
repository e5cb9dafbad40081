"""Whether a calibration file makes sense, by itself and beside the configured camera.

A calibration with one wrong number still maps every pixel to a place on the street, to a wrong
one, and nothing on the pole notices. What a calibration says twice must therefore agree (focal
length, image circle and field of view), and what it says once must be possible for a lens.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from bikeped.config.schema import CameraConfig
from bikeped.errors import ConfigError, GeometryError
from bikeped.geometry.lens import PROJECTIONS, Lens, canonical_projection

_Finite = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Side = Annotated[int, Meta(ge=1, le=100_000)]
_Count = Annotated[int, Meta(ge=1)]

#: The radial terms of a real lens change the image radius by less than this factor either way.
GAIN_MAX = 1.7
#: Focal length, image circle and field of view agree to this share: they are written by one fit.
_AGREE = 0.02
#: Largest distance of the optical centre from the middle, and of the error, in shares of a side.
_CENTRE_SHARE, _ERROR_SHARE = 0.15, 0.01
#: The image circle in shares of the frame's longer side; a crop of a fisheye shows a part of it.
_CIRCLE_SHARES = (0.15, 3.0)


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """Intrinsics of one camera; lengths in pixels of the crop. Unknown keys are kept out."""

    model: str
    cx: _Finite
    cy: _Finite
    focal_length: Annotated[float, Meta(gt=0, le=1e6)]
    fov_deg: Annotated[float, Meta(gt=0, le=300)]
    radius_px: Annotated[float, Meta(gt=0, le=1e6)] | None = None
    k1: _Finite = 0.0
    k2: _Finite = 0.0
    k3: _Finite = 0.0
    k4: _Finite = 0.0
    rms_error_px: Annotated[float, Meta(ge=0, le=1e6)] | None = None
    num_frames: _Count | None = None
    num_points: _Count | None = None
    frame_width: _Side | None = None
    frame_height: _Side | None = None
    pad_size: _Side | None = None
    crop_size: _Side | None = None
    checksum: str | None = None


def checksum(values: Mapping[str, Any]) -> str:
    """What `checksum` of a calibration file must be: a hash over the values that are read.

    `values` are those of the file. A centre with its two numbers exchanged, for one, cannot be
    told from a right one by its size. The first 16 hexadecimal digits of a SHA-256.
    """
    read = msgspec.structs.asdict(msgspec.convert(values, Calibration, strict=False))
    del read["checksum"]
    return hashlib.sha256(msgspec.json.encode(read, order="deterministic")).hexdigest()[:16]


def check_calibration(calibration: Calibration, camera: CameraConfig, file: str) -> None:
    """ConfigError with one line that begins with `file` when the calibration cannot be right."""
    problem = _misfit(calibration, camera) or _nonsense(calibration, camera)
    if problem is not None:
        raise ConfigError(f"{file}: {problem}")


def check_gain(lens: Lens) -> None:
    """GeometryError where the radial terms bend the image more than any lens does."""
    plain = Lens(lens.projection, lens.focal_px, lens.max_theta_rad).max_radius_px
    gain = lens.max_radius_px / plain
    if not 1 / GAIN_MAX < gain < GAIN_MAX:
        raise GeometryError(
            f"k1..k4: change the radius of the image circle by a factor of {gain:.3g}, which no "
            "lens does; correct the radial terms"
        )


def _misfit(calibration: Calibration, camera: CameraConfig) -> str | None:
    """What was configured otherwise than when the calibration was made."""
    for key, measured, configured in (
        ("crop_size", calibration.crop_size, camera.crop_size),
        ("pad_size", calibration.pad_size, camera.pad_size),
        ("width", calibration.frame_width, camera.width),
        ("height", calibration.frame_height, camera.height),
    ):
        if measured is not None and measured != configured:
            return (
                f"does not fit: camera.{key} is {configured}, the calibration was made with "
                f"{measured}; set camera.{key}: {measured} or calibrate again"
            )
    return None


def _nonsense(calibration: Calibration, camera: CameraConfig) -> str | None:
    """What no lens, or no fit of one, can be."""
    width, height = camera.width, camera.height
    if camera.crop_size is not None or camera.pad_size is not None:
        width = height = camera.crop_size or camera.pad_size or width
    again = "calibrate again"
    off_u, off_v = calibration.cx - (width - 1) / 2, calibration.cy - (height - 1) / 2
    centre = f"centre ({calibration.cx:g}, {calibration.cy:g})"
    if not (0 <= calibration.cx <= width and 0 <= calibration.cy <= height):
        crop = f"the crop of {width} px" if width == height else f"{width} x {height} px"
        return f"does not fit: {centre} lies outside {crop}; {again} with this crop"
    if abs(off_u) > _CENTRE_SHARE * width or abs(off_v) > _CENTRE_SHARE * height:
        return f"{centre} is far from the middle of {width} x {height} px; {again}"
    side, rms_px = max(width, height), calibration.rms_error_px
    if rms_px is not None and rms_px > max(2.0, _ERROR_SHARE * side):
        return f"rms_error_px: {rms_px:g} px is no fit of a lens; {again}"
    k = (calibration.k1, calibration.k2, calibration.k3, calibration.k4)
    try:
        name = canonical_projection(calibration.model)
        lens = Lens(name, calibration.focal_length, math.radians(calibration.fov_deg) / 2, k)
        check_gain(lens)
    except GeometryError as error:
        return str(error)
    radius_px = calibration.radius_px
    unit = float(PROJECTIONS[name].radius(lens.max_theta_rad))  # type: ignore[arg-type]
    if radius_px is not None and abs(calibration.focal_length * unit / radius_px - 1) > _AGREE:
        return (
            f"focal_length {calibration.focal_length:g} px and fov_deg {calibration.fov_deg:g} "
            f"make an image circle of {calibration.focal_length * unit:.1f} px for a lens of the "
            f"model {name}, not radius_px {radius_px:g}; {again}"
        )
    low, high = (share * side for share in _CIRCLE_SHARES)
    if not low < lens.max_radius_px < high:
        return (
            f"focal_length {calibration.focal_length:g} px: its image circle of "
            f"{lens.max_radius_px:.4g} px does not fit a picture of {width} x {height}; {again}"
        )
    if calibration.checksum not in (None, checksum(msgspec.structs.asdict(calibration))):
        return (
            "checksum: does not fit the values: the file is damaged or was edited by hand; "
            f"{again}, or remove the key checksum where the edit was meant"
        )
    return None
