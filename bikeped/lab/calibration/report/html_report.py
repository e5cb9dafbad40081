"""The calibration report: one HTML file with everything in it."""

from __future__ import annotations

import base64
import datetime
import html
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bikeped import __version__
from bikeped.lab.calibration.report.board_images import Thumbnail, picture_cards
from bikeped.lab.calibration.report.calibration_file import Field
from bikeped.lab.calibration.report.figures import (
    angle_figure,
    board_figure,
    comparison_figure,
    coverage_figure,
    profile_figure,
)
from bikeped.lab.calibration.report.style import STYLE
from bikeped.lab.calibration.solver.compare import Calibrated, Recommendation, paper_criterion
from bikeped.lab.calibration.solver.lens_fit import Fit


@dataclass(frozen=True)
class Told:
    """What the report tells of one run."""

    calibrated: Calibrated
    chosen: Fit
    recommendation: Recommendation
    field: Field
    cautions: Sequence[str]
    advice: Sequence[str]  #: what to photograph next
    gaps: Sequence[tuple[float, float, float, float]]  #: theta from, to, azimuth from, to; radians


def report_page(told: Told, thumbnails: Sequence[Thumbnail]) -> str:
    """The page; `thumbnails` are the used pictures in the order of the fit's sightings."""
    calibrated, chosen = told.calibrated, told.chosen
    sightings = chosen.sightings
    gaps = np.asarray(told.gaps, dtype=np.float64).reshape(-1, 4)
    parts = [
        _head(told),
        _section(
            "Models",
            _model_table(calibrated, chosen),
            f"<p>{_text(told.recommendation.why)}</p>",
            f"<p>{_text(paper_criterion(calibrated))}</p>" if len(calibrated.fits) > 1 else "",
            _figure(comparison_figure(calibrated, chosen.name), "error of each model")
            if len(calibrated.fits) > 1
            else "",
        ),
        _section(
            "Coverage",
            _pair(
                _figure(coverage_figure(chosen, told.field, gaps), "coverage of the image circle"),
                "<h3>What to photograph next</h3>" + _list(told.advice),
            ),
        ),
        _section(
            "The lens",
            _figure(profile_figure(chosen, told.field), "radial profile"),
            _figure(angle_figure(chosen, told.field), "residuals against the angle"),
            _parameter_table(chosen),
        ),
        _section("The board", _figure(board_figure(chosen), "board shape"))
        if chosen.model.board
        else "",
        _section(
            "Every picture",
            "<p>Arrows point from where the lens puts a corner to where it was seen, drawn "
            f"{_arrow_scale(chosen):.0f} times as long. Worst picture first.</p>",
            picture_cards(chosen, thumbnails, _arrow_scale(chosen)),
        ),
        _section("Left out", _left_out(calibrated))
        if calibrated.refused or calibrated.left_out
        else "",
        _section("How the adjustment went", _stage_table(chosen)),
    ]
    now = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    foot = (
        f"<footer>bikeped {_text(__version__)}, {now}; {len(sightings)} pictures, SHA-256 "
        f"{_text(calibrated.prepared.pictures_hash[:16])}…</footer>"
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>Calibration, {_text(chosen.name)}</title><style>{STYLE}</style></head>"
        f"<body><main>{''.join(parts)}{foot}</main></body></html>\n"
    )


def _head(told: Told) -> str:
    fit, field, prepared = told.chosen, told.field, told.calibrated.prepared
    held = fit.cross_validated_px
    used = len(fit.sightings)
    numbers = [
        (f"{held:.3f} px" if held is not None else "—", "cross-validated error, per point"),
        (f"{fit.rms_px:.3f} px", f"RMS per point ({fit.rms_per_coordinate_px:.3f} per coordinate)"),
        (f"{used} of {prepared.boards_total}", f"boards, {int(fit.sightings.seen.sum())} corners"),
        (f"{fit.focal_px:.2f} px", f"focal length, ± {fit.uncertainty['f']:.2f}"),
        (f"{fit.cx:.2f}, {fit.cy:.2f}", f"centre, px, ± {_centre_sigma(fit):.2f}"),
        (f"{field.fov_deg:.1f}°", f"field of view; ends at {field.ends_at}"),
    ]
    tiles = "".join(
        f'<div class="tile"><b>{_text(value)}</b><span>{_text(what)}</span></div>'
        for value, what in numbers
    )
    cautions = (
        f'<div class="caution"><h3>Mind</h3>{_list(told.cautions)}</div>' if told.cautions else ""
    )
    return (
        f"<header><h1>Calibration: {_text(fit.name)}</h1>"
        f'<div class="tiles">{tiles}</div>{cautions}</header>'
    )


def _centre_sigma(fit: Fit) -> float:
    return max(fit.uncertainty["cx"], fit.uncertainty["cy"])


def _arrow_scale(fit: Fit) -> float:
    """Arrows of typical residuals should be some 3 % of the picture."""
    wish = 0.03 * fit.sightings.width / max(fit.rms_px, 1e-3)
    return float(max(1.0, round(wish, -math.floor(math.log10(max(wish, 1.0))))))


def _model_table(calibrated: Calibrated, chosen: Fit) -> str:
    rows = []
    for f in sorted(calibrated.fits.values(), key=lambda f: f.cross_validated_px or f.rms_px):
        held = f.cross_validated_px
        mark = ' class="chosen"' if f is chosen else ""
        cells = [
            f.name,
            "—" if held is None else f"{held:.4f}",
            f"{f.rms_px:.4f}",
            f"{f.rms_per_coordinate_px:.4f}",
            f"{f.focal_px:.3f} ± {f.uncertainty['f']:.3f}",
            f"{f.cx:.3f}",
            f"{f.cy:.3f}",
        ]
        rows.append(f"<tr{mark}>" + "".join(f"<td>{_text(c)}</td>" for c in cells) + "</tr>")
    head = (
        "model",
        "cross-validated, px",
        "RMS per point, px",
        "per coordinate, px",
        "f, px",
        "cx, px",
        "cy, px",
    )
    return _table(head, rows)


def _parameter_table(fit: Fit) -> str:
    rows = []
    for name, value in zip(fit.model.parameters, fit.state.lens, strict=True):
        sigma = fit.uncertainty[name]
        unit = " px" if name in ("cx", "cy", "f") else ""
        usual = sigma > 0 and math.isfinite(sigma)
        digits = max(0, 2 - math.floor(math.log10(sigma))) if usual else 6
        digits = min(digits, 10)
        rows.append(
            f"<tr><td>{name}</td><td>{value:.{digits}f}{unit}</td>"
            f"<td>{sigma:.{digits}f}{unit}</td></tr>"
        )
    return (
        "<h3>Parameters</h3><p>r = f g(θ) (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸). The standard "
        "deviation knows the corners' noise only, not a model that does not fit.</p>"
        + _table(("parameter", "value", "standard deviation"), rows)
    )


def _stage_table(fit: Fit) -> str:
    rows = [
        f"<tr><td>{_text(s.name)}</td><td>{s.steps}</td><td>{s.cost_before:.4g}</td>"
        f"<td>{s.cost_after:.4g}</td><td>{s.slope:.1e}</td><td>{_text(s.stopped)}</td>"
        f"<td>{'yes' if s.kept else 'no'}</td></tr>"
        for s in fit.stages
    ]
    head = ("stage", "steps", "cost before, px²", "after", "gradient", "stopped because", "kept")
    return _table(head, rows)


def _left_out(calibrated: Calibrated) -> str:
    rows = [
        f"<tr><td>{_text(Path(r.name).name)}</td><td>{_text(r.why)}</td></tr>"
        for r in calibrated.refused
    ]
    rows += [
        f"<tr><td>{_text(Path(c.name).name)}</td><td>corner {c.corner}: {c.off_px:.1f} px off</td>"
        "</tr>"
        for c in calibrated.left_out
    ]
    return _table(("picture", "why"), rows)


def _section(title: str, *parts: str) -> str:
    return f"<section><h2>{_text(title)}</h2>{''.join(parts)}</section>"


def _pair(left: str, right: str) -> str:
    return f'<div class="pair"><div>{left}</div><div>{right}</div></div>'


def _figure(data: bytes, what: str) -> str:
    source = base64.b64encode(data).decode("ascii")
    return f'<img class="figure" alt="{_text(what)}" src="data:image/png;base64,{source}">'


def _table(head: Iterable[str], rows: Sequence[str]) -> str:
    cells = "".join(f"<th>{_text(name)}</th>" for name in head)
    return (
        f'<div class="wide"><table><thead><tr>{cells}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _list(lines: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{_text(line)}</li>" for line in lines) + "</ul>"


def _text(value: str) -> str:
    return html.escape(str(value))
