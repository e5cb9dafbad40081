"""The work of `bikeped calibrate`, from files or a live camera to files and the console."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bikeped.capture import open_source
from bikeped.cli.common import progress_bar, text_table, write_json
from bikeped.config.build import framing
from bikeped.config.load import LoadedConfig, load_config
from bikeped.errors import BikepedError
from bikeped.files import write_whole
from bikeped.geometry.lens import canonical_projection
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.capture.coverage import measure_coverage
from bikeped.lab.calibration.capture.guide import CaptureGuide
from bikeped.lab.calibration.capture.images import CalibrationImage
from bikeped.lab.calibration.capture.live_session import LiveSession, capture_boards, live_page
from bikeped.lab.calibration.corners.candidates import assumed_lens
from bikeped.lab.calibration.image_pipeline import detect_boards
from bikeped.lab.calibration.report.results import (
    MODEL_COLUMNS,
    CalibrationResult,
    calibration_cautions,
    calibration_data,
    circle_radius_px,
    field_of_view,
    model_row,
    result_data,
    write_calibration,
)
from bikeped.lab.calibration.solver.lens_model import CornerObservations, LensModel
from bikeped.lab.calibration.solver.model_comparison import (
    comparison_models,
    fit_models,
    paper_criterion,
    recommend_model,
)
from bikeped.lab.calibration.solver.observations import prepare_observations

DEFAULT_FOLDER = Path("calibration-pictures")
_CIRCLE_IMAGES = 16  # enough to see the image circle
_MOST_NAMED = 8


def live_pictures(
    images: Sequence[Path], pattern: BoardPattern, loaded: LoadedConfig, screen: Console
) -> tuple[Path, ...]:
    """Guides a person before the configured camera; returns the folder of the pictures.

    Ends when there are enough, when the source ends, or with Ctrl-C, which keeps those taken.
    """
    if len(images) > 1:
        raise BikepedError("IMAGES: with --live one folder for the pictures, not several")
    folder = images[0] if images else DEFAULT_FOLDER
    if folder.exists() and not folder.is_dir():
        raise BikepedError(f"IMAGES {folder}: with --live the folder for the pictures, not a file")
    camera = loaded.config.camera
    lens, centre = assumed_lens(camera.width, camera.height)
    guide = CaptureGuide(pattern, camera.width, camera.height, lens, centre)
    session = LiveSession(guide)
    page = live_page(session, port=loaded.config.web.port)
    with (
        contextlib.closing(open_source(camera, base_dir=loaded.base_dir)) as source,
        page as (url, error),
    ):
        screen.print(f"pictures go into {escape(str(folder))}; Ctrl-C when you have enough")
        screen.print(f"open {url}" if url else f"no page: {error}")
        try:
            capture_boards(source, guide, folder, session, say=screen.print)
        except KeyboardInterrupt:
            session.stop()
            click.echo("bikeped: interrupted; calibrating from what was kept", err=True)
    return (folder,)


@dataclass(frozen=True)
class CalibrateOptions:
    """Board and models; `model` and `terms` None: as `--compare` recommends, or the defaults."""

    pattern: BoardPattern
    model: str | None
    terms: int | None
    board_shape: bool
    compare: bool
    folds: int  #: 0: each image is a fold


def run(
    images: Sequence[CalibrationImage], options: CalibrateOptions, loaded: LoadedConfig
) -> CalibrationResult:
    """From images to fits; CalibrationError, with the remedy, where they give no lens."""
    size = (images[0].width, images[0].height)
    sensor = framing(loaded)
    framed = sensor if size == (sensor.sensor_w, sensor.sensor_h) else None
    with progress_bar("boards", len(images)) as progress:
        boards = detect_boards(images, options.pattern, framed, progress=progress)
    prepared = prepare_observations(boards)
    projection = canonical_projection(options.model or "equidistant")
    terms = 4 if options.terms is None else options.terms
    model = LensModel(projection, terms, options.board_shape)
    models = comparison_models(model) if options.compare else [model]
    with progress_bar("models", len(models)) as progress:
        comparison = fit_models(prepared, models, options.folds, progress)
    recommendation = recommend_model(comparison)
    named = options.model is not None or options.terms is not None or options.board_shape
    recommended = options.compare and not named
    chosen = comparison.fits[recommendation.name if recommended else model.name]
    some = images[:: max(1, len(images) // _CIRCLE_IMAGES)][:_CIRCLE_IMAGES]
    bright = functools.reduce(np.maximum, (image.grey() for image in some))
    offset = (0, 0) if framed is None else framed.offset_px
    window = (0.0, 0.0, float(size[0]), float(size[1])) if framed is None else framed.window_px
    circle_px = circle_radius_px(bright, chosen.state.lens[:2] - offset)
    field = field_of_view(chosen, circle_px, window)
    views, centre = prepared.observations.views(), (chosen.cx, chosen.cy)
    return CalibrationResult(
        comparison,
        chosen,
        recommendation,
        field,
        measure_coverage(views, chosen.lens(field.half_rad), centre, window),
        [
            *calibration_cautions(prepared, chosen, field),
            *_configuration_cautions(loaded, size, framed is not None),
        ],
        framed,
    )


def write_outputs(
    result: CalibrationResult,
    images: Sequence[CalibrationImage],
    report: Path | None,
    json_path: str | None,
    out: Path | None,
    default_out: Path,
) -> list[str]:
    """Writes all outputs, computed before the first is written; one line about each."""
    prepared = result.comparison.prepared
    lens = calibration_data(prepared, result.chosen, result.field, result.framing)
    page = ""
    if report is not None:
        from bikeped.lab.calibration.report.html_report import report_page

        page = report_page(result, images)
    lines = []
    if report is not None:
        write_whole(report, page)
        lines.append(f"wrote {report}")
    if json_path is not None:
        write_json(result_data(result), json_path)
        if json_path != "-":
            lines.append(f"wrote {json_path}")
    target = out or default_out
    if out is None and default_out.exists():
        text = f"{target} exists and was left as it is; --out {target} replaces it"
        return [*lines, text]
    kept = write_calibration(target, lens)
    return [*lines, f"wrote {target}" + (f"; the former one is {kept}" if kept else "")]


def camera_config(config_path: Path | None, overrides: tuple[str, ...]) -> LoadedConfig:
    """The configuration with a stand-in for its calibration file, which may not exist yet."""
    # Any lens that makes sense in the crop, whose size only the configuration knows.
    lens = ("camera.calibration=null", "camera.radius_px=1000", "camera.fov_deg=180")
    width, height = framing(load_config(config_path, (*overrides, *lens))).crop_wh
    middle = {"model": "equidistant", "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    middle |= {"focal_length": min(width, height) / math.pi, "fov_deg": 180}
    with tempfile.TemporaryDirectory() as folder:
        stand_in = Path(folder) / "stand-in.json"
        stand_in.write_text(json.dumps(middle))
        return load_config(config_path, (*overrides, f"camera.calibration={stand_in}"))


def _configuration_cautions(loaded: LoadedConfig, size: tuple[int, int], framed: bool) -> list[str]:
    """Settings to change before the new file can be used."""
    camera = loaded.config.camera
    if not framed:
        caution = (
            f"the pictures are {size[0]} x {size[1]}, the camera in {loaded.source} {camera.width} "
            f"x {camera.height}: to use the file, set camera.width: {size[0]}, camera.height: "
            f"{size[1]}, and camera.pad_size and camera.crop_size to null"
        )
        return [caution]
    keys = ("projection", "fov_deg", "radius_px", "cx", "cy", "k1", "k2", "k3", "k4")
    given = ", ".join(f"camera.{key}" for key in keys if getattr(camera, key) is not None)
    override = "which override the file; set them to null to use the measured lens"
    return [f"{loaded.source} sets {given}, {override}"] if given else []


def print_result(screen: Console, result: CalibrationResult, compare: bool) -> None:
    """Boards, models, the recommendation, and cautions."""
    prepared, chosen = result.comparison.prepared, result.chosen
    observations = prepared.observations
    size = f"{observations.width} x {observations.height}"
    as_they_are = result.framing is None
    where = f"pictures of {size}, taken as they are" if as_they_are else f"in the {size} crop"
    corners = int(observations.visible.sum())
    refused = [f"not used: {_name(r.file)}: {escape(r.reason)}" for r in prepared.refused]
    outliers = [
        f"left out: corner {c.corner} of {_name(c.file)}, {c.off_px:.1f} px off"
        for c in prepared.outliers
    ]
    for line in (
        f"{len(observations)} of {prepared.images} boards, {corners} corners, {where}",
        *partial_board_lines(observations),
        *_first(refused, "more (--json, --report)"),
        *_first(outliers, "more corners"),
    ):
        screen.print(line)
    screen.print(_table(result))
    if compare:
        screen.print(f"recommended: {result.recommendation.reason}")
        screen.print(paper_criterion(result.comparison))
    k = chosen.state.terms[: chosen.model.terms]
    terms = "".join(f", k{n + 1} = {value:.6g}" for n, value in enumerate(k))
    screen.print(f"{chosen.name}{terms}")
    screen.print(
        f"field of view {result.field.fov_deg:.1f} degrees; ends at {result.field.ends_at}"
    )
    for caution in result.cautions:
        screen.print(f"caution: {escape(caution)}")


def partial_board_lines(observations: CornerObservations) -> list[str]:
    """A line for each board of which some corners are not used, the emptiest first."""
    whole, counts = observations.pattern.count, observations.visible.sum(1)
    lines = [
        f"in part: {_name(observations.names[row])}, {counts[row]} of {whole} corners"
        for row in np.argsort(counts, kind="stable")
        if counts[row] < whole
    ]
    return _first(lines, "more boards in part (--json, --report)")


def _first(lines: list[str], what: str) -> list[str]:
    """The first few lines, indented, and one that counts the others."""
    more = len(lines) - _MOST_NAMED
    shown = lines[:_MOST_NAMED] + ([f"and {more} {what}"] if more > 0 else [])
    return [f"  {line}" for line in shown]


def _name(file: str) -> str:
    return escape(Path(file).name)


def _table(result: CalibrationResult) -> Table:
    fits, folds = result.comparison.ranked, result.comparison.folds
    how = f"each of {folds} folds from the others"
    if folds == len(result.comparison.prepared.observations):
        how = "each picture from all others"
    rows = [model_row(fit) for fit in fits]
    return text_table(
        MODEL_COLUMNS,
        [(f"{row[0]} *" if row[0] == result.chosen.name else row[0], *row[1:]) for row in rows],
        title=f"error in px; cross-validated: {how}",
        note="* goes into the calibration file" if len(fits) > 1 else "",
    )
