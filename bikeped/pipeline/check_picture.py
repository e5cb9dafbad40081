"""Pictures with known answers: a JPEG file, and beside it a JSON file of the boxes in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
import simplejpeg

from bikeped.capture.jpeg import JpegDecoder
from bikeped.errors import BikepedError, CaptureError
from bikeped.files import write_whole
from bikeped.models import CHECK_PICTURE_FILE
from bikeped.telemetry.schema import KindLabel
from bikeped.types import Detections, Frame, ImageArray, Kind, Region

MOST_KNOWN = 4
_GREY = 114


class KnownBox(msgspec.Struct, frozen=True):
    """One known answer; `box_px` in pixels of the picture: u1, v1, u2, v2."""

    kind: KindLabel
    box_px: tuple[float, float, float, float]


class _Sidecar(msgspec.Struct, frozen=True):
    model_sha256: str | None
    known: list[KnownBox]


@dataclass(frozen=True)
class CheckPicture:
    """A frame and what a working model finds in it, in its pixels."""

    frame: Frame
    rgb: ImageArray
    known: Detections


def known_answers(found: Detections, threshold: float) -> Detections:
    """The most confident detections, at most `MOST_KNOWN`, well above the model's `threshold`."""
    confident = min(3 * threshold, (1 + threshold) / 2)
    return found.take(np.nonzero(found.confidence >= confident)[0][:MOST_KNOWN])


def write_check_picture(
    path: Path, rgb: ImageArray, known: Detections, model_sha256: str | None
) -> None:
    """Writes `rgb` [h, w, 3] to `path` (.jpg), and `known` beside it; BikepedError if it cannot."""
    boxes = [
        KnownBox(Kind(kind).label, tuple(round(side, 1) for side in box))  # type: ignore[arg-type]
        for kind, box in zip(known.kind.tolist(), known.box_px.tolist(), strict=True)
    ]
    jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=92, colorspace="RGB")
    try:
        write_whole(path, jpeg)
        sidecar = msgspec.json.format(msgspec.json.encode(_Sidecar(model_sha256, boxes)), indent=1)
        write_whole(path.with_suffix(".json"), sidecar + b"\n")
    except OSError as error:
        raise BikepedError(
            f"{path}: cannot be written ({error.strerror}); choose another folder"
        ) from error


def read_check_picture(path: Path) -> tuple[CheckPicture, str | None]:
    """The picture, and the SHA-256 of the model that found its boxes.

    BikepedError, with a remedy, where the files are not what `write_check_picture` wrote.
    """
    try:
        rgb = JpegDecoder(1).decode(path.read_bytes())
        sidecar = msgspec.json.decode(path.with_suffix(".json").read_bytes(), type=_Sidecar)
        known = Detections(
            np.array([Kind[box.kind.upper()] for box in sidecar.known], np.int8),
            np.ones(len(sidecar.known), np.float32),
            np.array([box.box_px for box in sidecar.known], np.float32).reshape(-1, 4),
        )
        if not len(known) or not np.isfinite(known.box_px).all():
            raise CaptureError("no known boxes")
    except (OSError, CaptureError, msgspec.MsgspecError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise BikepedError(
            f"{path}: is no check picture with its boxes beside it ({reason}); make it again with "
            "bikeped align --check-picture"
        ) from error
    height, width = rgb.shape[:2]
    return CheckPicture(Frame(0, 0.0, width, height, rgb=rgb), rgb, known), sidecar.model_sha256


def drawn_check_picture(
    frame_wh: tuple[int, int], decode_wh: tuple[int, int], region: Region | None
) -> CheckPicture:
    """The bundled model's drawn road users in the middle of what it gets of a grey frame.

    `frame_wh`: of the camera's frames; `decode_wh` and `region`: as the detector has them, so that
    the drawing keeps the size that the model was found to know it in.
    """
    drawn, _ = read_check_picture(CHECK_PICTURE_FILE)
    width, height = decode_wh
    u1, v1, u2, v2 = (0, 0, width, height) if region is None else region.pixels(width, height)
    share = min(1.0, (u2 - u1) / drawn.frame.width, (v2 - v1) / drawn.frame.height)
    patch = cv2.resize(drawn.rgb, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    left, top = (u1 + u2 - patch.shape[1]) // 2, (v1 + v2 - patch.shape[0]) // 2
    rgb = np.full((height, width, 3), _GREY, np.uint8)
    rgb[top : top + patch.shape[0], left : left + patch.shape[1]] = patch
    scale = np.array([frame_wh[0] / width, frame_wh[1] / height] * 2)
    box = (drawn.known.box_px * share + np.array([left, top] * 2)) * scale
    known = Detections(drawn.known.kind, drawn.known.confidence, box.astype(np.float32))
    return CheckPicture(Frame(0, 0.0, *frame_wh, rgb=rgb), rgb, known)
