"""The calibration report: one HTML file with all its figures."""

from __future__ import annotations

import base64
import datetime
import math
from collections.abc import Sequence
from pathlib import Path

from bikeped import __version__
from bikeped.lab.calibration.report.board_images import Thumbnail, image_cards
from bikeped.lab.calibration.report.figures import (
    angle_figure,
    board_figure,
    comparison_figure,
    coverage_figure,
    profile_figure,
)
from bikeped.lab.calibration.report.results import MODEL_COLUMNS, CalibrationResult, model_row
from bikeped.lab.calibration.solver.lens_fit import LensFit
from bikeped.lab.calibration.solver.model_comparison import paper_criterion
from bikeped.templates import render

_TEMPLATES = Path(__file__).with_name("templates")


def report_page(result: CalibrationResult, thumbnails: Sequence[Thumbnail]) -> str:
    """The page; `thumbnails`: the images that were used, in any order."""
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
        comparison_png=_base64(comparison_figure(comparison, fit.name)) if several else "",
        coverage_png=_base64(coverage_figure(fit, field, result.coverage.gaps)),
        advice=result.coverage.advice(),
        profile_png=_base64(profile_figure(fit, field)),
        angle_png=_base64(angle_figure(fit, field)),
        parameters=_parameter_rows(fit),
        board_png=_base64(board_figure(fit)) if fit.model.board else "",
        arrow_scale=arrow_scale,
        cards=image_cards(fit, thumbnails, arrow_scale),
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
                f"{s.slope:.1e}",
                s.stopped,
                "yes" if s.kept else "no",
            )
            for s in fit.stages
        ],
        version=__version__,
        now=datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds"),
        images_hash=prepared.images_hash,
    )


def _base64(png: bytes) -> str:
    return base64.b64encode(png).decode("ascii")


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
