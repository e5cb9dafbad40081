"""Marks in the form of the page and of `points.json`, and the camera fit to them.

The page exports the file that `bikeped align FRAME --points` reads.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from bikeped.config.schema import CameraConfig
from bikeped.errors import BikepedError, GeometryError
from bikeped.geometry.alignment import (
    PARAMETER_NAMES,
    Alignment,
    AlignmentFit,
    Mark,
    MeasurementAccuracy,
    Spacing,
    ground_distance_m,
    pixel_at_distance,
)
from bikeped.geometry.alignment_fit import fit_alignment
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing

_Pixel = Annotated[float, Meta(ge=-1e5, le=1e5)]
_Metres = Annotated[float, Meta(ge=-1000, le=1000)]
_Side = Annotated[int, Meta(ge=2, le=100_000)]
_Name = Annotated[str, Meta(min_length=1, max_length=20)]
_MAX_BYTES = 1_000_000

#: By how much a parameter is changed to show what that does at 10 m.
STEPS = {"height_m": 0.1, "pitch_deg": 1.0, "heading_deg": 1.0}
STEPS |= dict.fromkeys(("radius_px", "cx", "cy"), 10.0)


class FrameSize(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Size in pixels of the picture that marks are set in."""

    width: _Side
    height: _Side


class Values(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera's values, as in the camera section; radius and centre in crop pixels."""

    height_m: float
    pitch_deg: float
    radius_px: float
    cx: float
    cy: float
    heading_deg: float = 0.0


class Point(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A mark: frame pixel (the middle of the first pixel is 0, 0) and measured metres."""

    name: _Name
    u: _Pixel
    v: _Pixel
    distance_m: _Metres | None = None
    right_m: _Metres | None = None
    forward_m: _Metres | None = None


class Between(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The measured distance between two marks, by name."""

    first: _Name
    second: _Name
    distance_m: _Metres


class Points(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Marks, distances and options of a fit."""

    frame: FrameSize
    marks: Annotated[list[Point], Meta(max_length=40)]
    between: Annotated[list[Between], Meta(max_length=80)] = []
    #: Start values, and those that are not fitted; None: as configured.
    values: Values | None = None
    free: Annotated[tuple[str, ...], Meta(max_length=6)] = ("height_m", "pitch_deg")
    #: Standard errors: of a mark in frame pixels, of a measured distance.
    mark_px: Annotated[float, Meta(ge=0.05, le=100)] = 1.5
    tape_m: Annotated[float, Meta(ge=0.001, le=10)] = 0.02


def load_points(path: Path) -> Points:
    """Reads a points file; BikepedError names file, key and remedy."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise BikepedError(f"{path}: larger than 1 MB; is it an export of the align page?")
        return msgspec.json.decode(path.read_bytes(), type=Points)
    except OSError as error:
        raise BikepedError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise BikepedError(f"{path}: {error}; export the marks from the align page anew") from error


def with_values(camera: GroundCamera, values: Values | None) -> GroundCamera:
    """`camera` with these values; GeometryError when one is out of the configuration's range."""
    if values is None:
        return camera
    given = msgspec.structs.asdict(values)
    try:
        msgspec.convert(given, CameraConfig)
    except msgspec.ValidationError as error:
        what, _, where = str(error).partition(" - at `$.")
        raise GeometryError(f"{where.rstrip('`')}: {what[:1].lower()}{what[1:]}") from error
    return Alignment(**given).camera(camera)


def fit_points(
    camera: GroundCamera, framing: Framing, points: Points
) -> tuple[AlignmentFit, Framing]:
    """Fits the points; `framing` is the camera's, whose frames they may be scaled copies of."""
    frame = framing.for_frame(points.frame.width, points.frame.height)
    index: dict[str, int] = {}
    marks: list[Mark] = []
    spacings = []
    for point in points.marks:
        if index.setdefault(point.name, len(marks)) < len(marks):
            raise GeometryError(f"marks: {point.name} occurs twice; give each mark its own name")
        u, v = frame.frame_to_crop((point.u, point.v)).tolist()
        marks.append(Mark(point.name, u, v, point.distance_m, point.forward_m, point.right_m))
    for pair in points.between:
        for name in (pair.first, pair.second):
            if name not in index:
                raise GeometryError(f"between: there is no mark {name}; take the distance out")
        spacings.append(Spacing(index[pair.first], index[pair.second], pair.distance_m))
    accuracy = MeasurementAccuracy(points.tape_m, points.mark_px * frame.scale)
    start = with_values(camera, points.values)
    return fit_alignment(start, marks, spacings, points.free, accuracy), frame


def fit_json(found: AlignmentFit) -> dict[str, Any]:
    """A fit as JSON data: metres, degrees and crop pixels; errors are one standard deviation."""
    return {
        "values": asdict(found.alignment),
        "error": found.standard_errors,
        "spare_measurements": found.redundancy,
        "at_10m_error_m": found.standard_error_at_10m_m,
        "suspect": found.suspect_mark,
        "agrees": not found.outliers,
        "residuals": [
            {
                "mark": r.mark,
                "what": r.quantity,
                "measured_m": r.measured_m,
                "read_m": r.read_m,
                "off_m": r.error_m,
                "expected_m": r.standard_error_m,
                "strange": r.is_outlier,
            }
            for r in found.residuals
        ],
    }


def readings(camera: GroundCamera, frame: Framing, marks: list[Point]) -> list[dict[str, Any]]:
    """The ground position that the camera reads at each mark, and the frame pixel of the measured
    position. A distance alone is taken along the bearing that the camera reads.
    """
    answers = []
    for point in marks:
        xy, valid = camera.ground([frame.frame_to_crop((point.u, point.v))])
        answer: dict[str, Any] = {"name": point.name, "on_ground": bool(valid[0])}
        answers.append(answer)
        if not valid[0]:
            continue
        x, y = xy[0].tolist()
        answer |= {"distance_m": math.hypot(x, y), "forward_m": x, "right_m": y}
        answer["measured_at"] = None
        if (at := _measured(point, x, y)) is not None:
            uv, seen = camera.project([at])
            if seen[0]:
                answer["measured_at"] = frame.crop_to_frame(uv[0]).round(1).tolist()
    return answers


def at_ten_metres(now: GroundCamera, before: GroundCamera, frame: Framing) -> dict[str, Any] | None:
    """What the pixel that read 10 m `before` reads `now`; None when 10 m is not in view.

    `steps`: change of the reading, metres, when one value grows by its step (`STEPS`).
    """
    pixel = pixel_at_distance(before)
    if pixel is None:
        return None
    steps: dict[str, float | None] = dict.fromkeys(PARAMETER_NAMES)
    here = pixel_at_distance(now)
    if here is not None:
        alignment = Alignment.of(now)
        for name, step in STEPS.items():
            moved = replace(alignment, **{name: getattr(alignment, name) + step})
            reads = ground_distance_m(moved.camera(now), here)
            steps[name] = None if reads is None else reads - 10.0
    return {
        "pixel": np.round(frame.crop_to_frame(pixel), 1).tolist(),
        "was_m": 10.0,
        "reads_m": ground_distance_m(now, pixel),
        "by": STEPS,
        "steps": steps,
    }


def _measured(point: Point, x: float, y: float) -> tuple[float, float] | None:
    """Measured position (forward, right), metres, of a mark that the camera reads at (x, y)."""
    distance, right, forward = point.distance_m, point.right_m, point.forward_m
    if forward is not None:
        return forward, y if right is None else right
    if distance is None or distance <= 0:
        return None
    if right is None:
        share = distance / max(math.hypot(x, y), 1e-9)
        return x * share, y * share
    if abs(right) > distance:
        return None
    return math.copysign(math.sqrt(distance**2 - right**2), x), right
