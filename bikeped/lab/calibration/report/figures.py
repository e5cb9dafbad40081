"""The figures of the calibration report, each a PNG in base64."""

from __future__ import annotations

import base64
import io
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from bikeped.geometry.lens import PROJECTIONS
from bikeped.lab.calibration.capture.coverage import CircleSector
from bikeped.lab.calibration.report.results import FieldOfView
from bikeped.lab.calibration.solver.lens_fit import LensFit
from bikeped.lab.calibration.solver.lens_model import angles, camera_points
from bikeped.lab.calibration.solver.model_comparison import ModelComparison
from bikeped.lab.calibration.solver.observations import FISHEYE
from bikeped.lab.plotting import BLACK, BLUE, GREY, LIGHT, RED, SERIES, FigureSheet
from bikeped.types import FloatArray

_BIN_DEG = 10.0


def _png(sheet: FigureSheet) -> str:
    """The sheet's picture in base64; the same drawing gives the same bytes."""
    data = io.BytesIO()
    sheet.figure.savefig(data, format="png", metadata={"Software": None})
    return base64.b64encode(data.getvalue()).decode("ascii")


def comparison_figure(comparison: ModelComparison, chosen: str) -> str:
    """RMS and cross-validated error of every model, least last."""
    from matplotlib.ticker import LogLocator, NullFormatter

    fits = comparison.ranked[::-1]
    rows = np.arange(len(fits))
    with FigureSheet(
        "Error of each model on the same corners",
        "Per point, sqrt(mean(dx² + dy²)), on a logarithmic scale. Cross-validated: on pictures "
        f"that did not help to fit the lens ({comparison.folds} folds). Bold: the model written.",
        width=7.0,
        height=0.9 + 0.26 * len(fits),
    ) as sheet:
        axes = sheet.axes[0]
        fitted = [f.rms_px for f in fits]
        held_out = [np.nan if f.cross_validated_px is None else f.cross_validated_px for f in fits]
        axes.plot([fitted, held_out], [rows, rows], "-", color=LIGHT, lw=3, zorder=1)
        axes.plot(fitted, rows, "o", color=BLUE, label="fitted (RMS)")
        axes.plot(held_out, rows, "s", color=RED, label="cross-validated")
        for row, f in zip(rows, fits, strict=True):
            at = max(f.rms_px, f.cross_validated_px or 0.0)
            where: dict[str, Any] = {"xytext": (7, 0), "textcoords": "offset points"}
            axes.annotate(f"{f.ranking_px:.3f}", (at, float(row)), **where, va="center", fontsize=8)
        axes.set_yticks(rows, [f.name for f in fits])
        for label in axes.get_yticklabels():
            if label.get_text() == chosen:
                label.set_fontweight("bold")
        axes.set_xscale("log")
        axes.set_xlabel("error, px")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        low, high = axes.get_xlim()
        axes.set_xlim(low, high * 1.25)
        axes.grid(axis="y", visible=False)
        axes.legend(loc="upper right")
        return _png(sheet)


def radial_residuals(fit: LensFit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angle (degrees), and residual along and across the radius (px), of every seen corner.

    Seen minus projected: positive along means that the corner lies farther out than the lens says.
    """
    seen = fit.observations.visible
    offset = fit.observations.uv_px[seen] - fit.state.lens[:2]
    outward = offset / np.maximum(np.hypot(*offset.T), 1e-9)[:, None]
    error = -fit.residuals_px[seen]
    along = (error * outward).sum(1)
    across = error[:, 1] * outward[:, 0] - error[:, 0] * outward[:, 1]
    return np.degrees(fit.angles_rad[seen]), along, across


def angle_figure(fit: LensFit, field: FieldOfView) -> str:
    """Residuals against the angle from the axis."""
    theta, along, across = radial_residuals(fit)
    edges = np.arange(0, np.degrees(field.half_rad) + _BIN_DEG, _BIN_DEG)
    with FigureSheet(
        "Residuals against the angle from the optical axis",
        "Each dot a corner, seen minus projected. Line: mean of each ten degrees; band: one "
        "standard deviation. A line that leaves zero is a lens that the model does not follow. "
        "Dashed: the edge of the field of view.",
        width=7.0,
        height=4.4,
        rows=2,
        columns=1,
        sharex=True,
    ) as sheet:
        limit = 1.15 * float(np.quantile(np.abs(np.concatenate([along, across])), 0.999))
        for axes, values, what in zip(
            sheet.axes, (along, across), ("along the radius", "across it"), strict=True
        ):
            axes.plot(theta, values, ".", ms=2.5, color=GREY, alpha=0.55, rasterized=True)
            middles, means, spreads = [], [], []
            for low, high in itertools.pairwise(edges):
                inside = values[(theta >= low) & (theta < high)]
                if len(inside) >= 5:
                    middles.append((low + high) / 2)
                    means.append(inside.mean())
                    spreads.append(inside.std())
            mean, spread = np.asarray(means), np.asarray(spreads)
            axes.fill_between(middles, mean - spread, mean + spread, color=BLUE, alpha=0.2, lw=0)
            axes.plot(middles, mean, "o-", color=BLUE, ms=4)
            axes.axhline(0, color=BLACK, lw=0.8)
            axes.axvline(np.degrees(field.half_rad), color=RED, ls="--", lw=1)
            axes.set_ylim(-limit, limit)
            axes.set_ylabel(f"{what}, px")
        sheet.axes[-1].set_xlabel("angle from the axis, degrees")
        sheet.axes[-1].set_xlim(0, np.degrees(field.half_rad) * 1.04)
        return _png(sheet)


def profile_figure(fit: LensFit, field: FieldOfView) -> str:
    """r(theta), and its difference from the four ideal lenses of the same slope on the axis."""
    theta: FloatArray = np.linspace(0.0, field.half_rad, 400, dtype=np.float64)
    degrees = np.degrees(theta)
    own = fit.state.radius_px(theta)
    with FigureSheet(
        "The lens's profile",
        "Left: image radius against the angle from the axis. Right: how far the four ideal "
        "projections, each with its own best focal length over the angles that were measured, are "
        "from it. Grey: angles that no corner reached, where the profile is extrapolated.",
        width=7.0,
        height=3.2,
        columns=2,
        legend_rows=2,
    ) as sheet:
        left, right = sheet.axes
        left.plot(degrees, own, color=BLACK, lw=2.2, label=fit.name)
        measured = theta <= fit.measured_to_rad
        worst = 0.0
        for projection, (colour, _, dash) in zip(FISHEYE, SERIES, strict=False):
            limit = PROJECTIONS[projection].limit_rad
            inside = theta <= limit
            base = np.where(inside, PROJECTIONS[projection].radius(np.minimum(theta, limit)), 0.0)
            both = inside & measured
            focal = float((base[both] @ own[both]) / (base[both] @ base[both]))
            ideal = np.where(inside, focal * base, np.nan)
            left.plot(degrees, ideal, color=colour, ls=dash, lw=1.1)
            right.plot(degrees, ideal - own, color=colour, ls=dash, lw=1.4, label=projection)
            if projection in ("equidistant", "equisolid"):
                worst = max(worst, float(np.nanmax(np.abs((ideal - own)[both]))))
        for axes in (left, right):
            axes.axvspan(np.degrees(fit.measured_to_rad), degrees[-1], color=LIGHT, alpha=0.5, lw=0)
            axes.set_xlim(0, degrees[-1])
            axes.set_xlabel("angle from the axis, degrees")
        left.set_ylabel("radius, px")
        left.set_ylim(0, float(own.max()) * 1.1)
        right.axhline(0, color=BLACK, lw=0.8)
        bound = max(3 * worst, 1.0)
        right.set_ylim(-bound, bound)
        right.set_ylabel("ideal minus fitted radius, px")
        handles = [*left.get_lines()[:1], *right.get_lines()[: len(FISHEYE)]]
        sheet.legend(handles, columns=3)
        return _png(sheet)


def board_figure(fit: LensFit) -> str:
    """The board's fitted shape: out of the plane as colours, in the plane as arrows."""
    pattern = fit.observations.pattern
    flat, shape = fit.observations.flat, fit.state.shape * 100
    # Counted as in a mirror, the board's z axis looks at the camera.
    facing = (fit.state.rotation[:, :, 2] * fit.state.translation).sum(-1)
    height = np.sign(np.median(facing)) * shape[:, 2].reshape(pattern.rows, pattern.columns)
    bound = max(float(np.abs(height).max()), 0.1)
    with FigureSheet(
        "The board as it is",
        "Offsets of the corners from a flat, even board in per cent of a square. Colour: out of "
        "the plane (positive away from the camera). Arrows: in the plane, drawn forty times as "
        "long. Shift, tilt, turn and scale are taken out.",
        width=7.0,
        height=7.0 * (pattern.rows + 0.6) / (pattern.columns + 2.2),
    ) as sheet:
        axes = sheet.axes[0]
        u, v = pattern.columns / 2, pattern.rows / 2
        shown = axes.imshow(height, "PuOr", vmin=-bound, vmax=bound, extent=(-u, u, v, -v))
        scale: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1}
        axes.quiver(*flat.T[:2], *shape.T[:2] * 0.4, **scale, width=0.003, color=BLACK)
        axes.grid(visible=False)
        axes.set_xticks([])
        axes.set_yticks([])
        sheet.figure.colorbar(shown, ax=axes, label="out of the plane, % of a square", shrink=0.85)
        return _png(sheet)


def coverage_figure(fit: LensFit, field: FieldOfView, gaps: Sequence[CircleSector] = ()) -> str:
    """All corners by their direction in the lens: the angle from the axis as radius."""
    points = camera_points(fit.state, fit.observations.flat)[fit.observations.visible]
    theta, phi = np.degrees(angles(points)), np.arctan2(points[:, 1], points[:, 0])
    half = float(np.degrees(field.half_rad))
    with FigureSheet(
        "Where the boards were",
        "Each dot a corner, in the lens's own directions: the middle is the optical axis, the "
        "circle the edge of the field of view. Hatched: parts of the picture with too few corners, "
        "where a board would help most. White and empty at the rim: not on the picture.",
        width=5.4,
        height=5.2,
        subplot_kw={"projection": "polar"},
    ) as sheet:
        axes = sheet.axes[0]
        look: dict[str, Any] = {"color": "#f6e3c9", "edgecolor": "#d08a2e", "hatch": "///"}
        for gap in gaps:
            axes.bar(
                (gap.start_rad + gap.stop_rad) / 2,
                np.degrees(gap.to_rad - gap.from_rad),
                width=gap.stop_rad - gap.start_rad,
                bottom=np.degrees(gap.from_rad),
                lw=0.6,
                **look,
            )
        axes.plot(phi, theta, ".", ms=3, color=BLUE, alpha=0.6, rasterized=True)
        axes.set_theta_direction(-1)  # type: ignore[attr-defined]
        axes.set_rlim(0, half)  # type: ignore[attr-defined]
        axes.set_rlabel_position(45)  # type: ignore[attr-defined]
        axes.set_yticks(np.arange(30, half, 30), [f"{d:.0f}°" for d in np.arange(30, half, 30)])
        axes.set_xticks(np.radians([0, 90, 180, 270]), ["right", "down", "left", "up"])
        return _png(sheet)
