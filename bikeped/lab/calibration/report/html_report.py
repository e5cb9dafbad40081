"""The calibration report: one HTML file with all its figures, and each image's residuals."""

from __future__ import annotations

import base64
import datetime
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bikeped import __version__
from bikeped.lab.calibration.capture.images import CalibrationImage
from bikeped.lab.calibration.report.figures import (
    angle_figure,
    board_figure,
    comparison_figure,
    coverage_figure,
    profile_figure,
)
from bikeped.lab.calibration.report.results import MODEL_COLUMNS, CalibrationResult, model_row
from bikeped.lab.calibration.solver.lens_fit import LensFit, rms_by_image
from bikeped.lab.calibration.solver.model_comparison import paper_criterion
from bikeped.templates import render
from bikeped.types import FloatArray, ImageArray

_TEMPLATES = Path(__file__).with_name("templates")


def report_page(result: CalibrationResult, images: Sequence[CalibrationImage]) -> str:
    """The page; `images`: at least those that were used, in any order."""
    comparison, fit, field = result.comparison, result.chosen, result.field
    prepared = comparison.prepared
    several = len(comparison.fits) > 1
    arrow_scale = _arrow_scale(fit)
    return render(
        "report.html",
        _TEMPLATES,
        fit=fit,
        tiles=_tiles(result),
        cautions=result.cautions,
        model_columns=MODEL_COLUMNS,
        models=[model_row(f) for f in comparison.ranked],
        recommendation=result.recommendation.reason,
        criterion=paper_criterion(comparison),
        comparison_png=comparison_figure(comparison, fit.name) if several else "",
        coverage_png=coverage_figure(fit, field, result.coverage.gaps),
        advice=result.coverage.advice(),
        profile_png=profile_figure(fit, field),
        angle_png=angle_figure(fit, field),
        parameters=_parameter_rows(fit),
        board_png=board_figure(fit) if fit.model.board else "",
        arrow_scale=arrow_scale,
        cards=image_cards(result, images, arrow_scale),
        unused=[
            *((Path(r.file).name, r.reason) for r in prepared.refused),
            *(
                (Path(c.file).name, f"corner {c.corner}: {c.off_px:.1f} px off")
                for c in prepared.outliers
            ),
        ],
        stages=[
            (
                s.name,
                s.steps,
                f"{s.cost_before:.4g}",
                f"{s.cost_after:.4g}",
                f"{s.gradient:.1e}",
                s.stopped,
                "yes" if s.kept else "no",
            )
            for s in fit.stages
        ],
        version=__version__,
        now=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        images_hash=prepared.images_hash,
    )


def _tiles(result: CalibrationResult) -> list[tuple[str, str]]:
    """The figures at the top: value and label."""
    fit, sigma = result.chosen, result.chosen.uncertainty
    held, used, field = fit.cross_validated_px, len(fit.observations), result.field
    return [
        ("—" if held is None else f"{held:.3f} px", "cross-validated error, per point"),
        (f"{fit.rms_px:.3f} px", f"RMS per point ({fit.rms_per_coordinate_px:.3f} per coordinate)"),
        (
            f"{used} of {result.comparison.prepared.images}",
            f"boards, {int(fit.observations.visible.sum())} corners",
        ),
        (f"{fit.focal_px:.2f} px", f"focal length, ± {sigma['f']:.2f}"),
        (f"{fit.cx:.2f}, {fit.cy:.2f}", f"centre, px, ± {max(sigma['cx'], sigma['cy']):.2f}"),
        (f"{field.fov_deg:.1f}°", f"field of view; ends at {field.ends_at}"),
    ]


def _arrow_scale(fit: LensFit) -> float:
    """Arrows of typical residuals are some 3 % of the image's width."""
    wanted = 0.03 * fit.observations.width / max(fit.rms_px, 1e-3)
    return float(max(1.0, round(wanted, -math.floor(math.log10(max(wanted, 1.0))))))


def _parameter_rows(fit: LensFit) -> list[tuple[str, str, str]]:
    """Name, value and standard deviation, to two digits of the latter."""
    rows = []
    for name, value in zip(fit.model.parameters, fit.state.lens, strict=True):
        sigma = fit.uncertainty[name]
        unit = " px" if name in ("cx", "cy", "f") else ""
        digits = 6
        if sigma > 0 and math.isfinite(sigma):
            digits = min(max(0, 2 - math.floor(math.log10(sigma))), 10)
        rows.append((name, f"{value:.{digits}f}{unit}", f"{sigma:.{digits}f}{unit}"))
    return rows


_WIDTH_PX, _MARGIN_SHARE, _LEAST_SPAN_PX = 420, 0.22, 60
_QUALITY = 72


@dataclass(frozen=True)
class Card:
    """One image's figure: SVG attributes in pixels of the crop, and the caption."""

    name: str
    caption: str
    view_box: str
    zoom: float  #: screen pixels per pixel
    jpeg: str  #: the part of the image, base64; empty without an overlap
    image_xywh: tuple[float, float, int, int]
    arrows: str  #: path from the projected to the observed corners
    dots: str  #: path of the projected corners


def image_cards(
    result: CalibrationResult, images: Sequence[CalibrationImage], arrow_scale: float
) -> Iterator[Card]:
    """One card an image, the worst first; residuals are drawn `arrow_scale` times as long."""
    fit, observations = result.chosen, result.chosen.observations
    # Where an image's pixel (0, 0) lies in the crop in which the fit's pixels count.
    offset_px = (0, 0) if result.framing is None else result.framing.offset_px
    errors = rms_by_image(fit.residuals_px, observations)
    held = None if fit.held_out_px is None else rms_by_image(fit.held_out_px, observations)
    by_name = {image.name: image for image in images}
    for row in np.argsort(errors)[::-1]:
        visible = observations.visible[row]
        uv = observations.uv_px[row][visible]
        error = -fit.residuals_px[row][visible]
        low, high = _frame(uv, error * arrow_scale, fit)
        zoom = _WIDTH_PX / (high - low)[0]
        start = uv - error
        ends = zip(start, start + error * arrow_scale, strict=True)
        theta = np.degrees(fit.angles_rad[row][visible])
        held_out = "" if held is None else f", held out {held[row]:.2f}"
        yield Card(
            Path(observations.names[row]).name,
            f"RMS {errors[row]:.2f} px{held_out}, worst corner {np.hypot(*error.T).max():.2f} px; "
            f"{theta.min():.0f} to {theta.max():.0f}° from the axis, {len(uv)} of "
            f"{observations.pattern.count} corners",
            " ".join(f"{value:.1f}" for value in (*low, *(high - low))),
            zoom,
            *_image(by_name[observations.names[row]].grey(), offset_px, low, high, zoom),
            "".join(f"M{a:.2f} {b:.2f}L{c:.2f} {d:.2f}" for (a, b), (c, d) in ends),
            "".join(f"M{u:.2f} {v:.2f}h0" for u, v in start),
        )


def _frame(uv: FloatArray, arrows: FloatArray, fit: LensFit) -> tuple[FloatArray, FloatArray]:
    """First and last position [2] of the part to show: the board with a margin, three by two."""
    points = np.concatenate([uv, uv + arrows])
    low, high = points.min(0), points.max(0)
    middle = (low + high) / 2
    image = np.array([fit.observations.width, fit.observations.height], dtype=np.float64)
    span = np.maximum((high - low) * (1 + 2 * _MARGIN_SHARE), _LEAST_SPAN_PX)
    width = float(min(max(span[0], span[1] * 1.5), max(image[0], image[1] * 1.5)))
    size = np.array([width, width / 1.5])
    # Inside the image where it is large enough, else in its middle.
    room = np.maximum(image - size, 0)
    first = np.clip(middle - size / 2, 0, room)
    first = np.where(room > 0, first, (image - size) / 2)
    return first, first + size


def _image(
    grey: ImageArray, offset_px: tuple[int, int], low: FloatArray, high: FloatArray, zoom: float
) -> tuple[str, tuple[float, float, int, int]]:
    """JPEG (base64) and place of the image's part between two positions [2] in the crop."""
    offset = np.asarray(offset_px, dtype=np.float64)
    height, width = grey.shape[:2]
    u0, v0 = (int(x) for x in np.clip(np.floor(low - offset), 0, [width, height]))
    u1, v1 = (int(x) for x in np.clip(np.ceil(high - offset), 0, [width, height]))
    if u1 <= u0 or v1 <= v0:
        return "", (0, 0, 0, 0)
    shrink = min(1.0, zoom * 1.5)
    part = grey[v0:v1, u0:u1]
    shown = cv2.resize(part, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    # A pixel's middle is its position.
    place = (offset_px[0] + u0 - 0.5, offset_px[1] + v0 - 0.5, u1 - u0, v1 - v0)
    return base64.b64encode(jpeg.tobytes()).decode("ascii"), place
