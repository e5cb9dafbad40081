"""`bikeped align`: height, pitch and lens of the camera, fitted to marks on the street."""

from __future__ import annotations

import webbrowser
from dataclasses import replace
from pathlib import Path

import click
import cv2
import msgspec
import numpy as np
from rich.markup import escape

from bikeped.capture import open_source
from bikeped.cli.common import (
    PATH,
    FiniteRange,
    config_options,
    console,
    json_option,
    text_table,
    write_json,
)
from bikeped.cli.guard import guarded
from bikeped.config.build import framing, ground_camera
from bikeped.config.load import LoadedConfig, load_config
from bikeped.errors import BikepedError, CaptureError
from bikeped.files import write_whole
from bikeped.geometry.alignment import PARAMETER_NAMES, AlignmentFit
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.pipeline.application import load_detector_pool
from bikeped.pipeline.check_picture import known_answers, write_check_picture
from bikeped.pipeline.detection_scheduler import DetectionStage
from bikeped.types import Frame
from bikeped.web.align import add_align, frame_rgb
from bikeped.web.align_grid import draw_grid, ground_grid
from bikeped.web.align_points import Points, fit_json, fit_points, load_points
from bikeped.web.align_save import Saved, file_hash, save
from bikeped.web.server import serve_pages


@click.command("align")
@click.argument("picture", metavar="FRAME", type=PATH)
@config_options
@click.option(
    "--at",
    "at_s",
    type=FiniteRange(0, 1e6),
    default=0.0,
    metavar="SECONDS",
    help="The frame of a video at this time; default: the first.",
)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port; default: a free one.")
@click.option("--no-browser", is_flag=True, help="Print the address only, open no browser.")
@click.option(
    "--points",
    "points_path",
    type=PATH,
    help="Fit the marks of this file, which the page exports, without a browser.",
)
@click.option("--save", "write", is_flag=True, help="With --points: write the fitted keys into -c.")
@click.option(
    "--grid",
    "grid_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Draw the ground grid over FRAME into this .png or .jpg, without a browser.",
)
@click.option(
    "--check-picture",
    "check_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Save FRAME (.jpg) with the road users that the model finds in it, without a browser, to "
    "check the model with (detection.check_picture). It shows the people in FRAME.",
)
@json_option
@guarded
def command(
    picture: Path,
    config_path: Path | None,
    overrides: tuple[str, ...],
    at_s: float,
    port: int,
    no_browser: bool,
    points_path: Path | None,
    write: bool,
    grid_path: Path | None,
    check_path: Path | None,
    json_path: str | None,
) -> int:
    """Fit the camera's height, pitch and lens to marks on the street in FRAME (picture or video).

    Serves the align page, with the ground grid over FRAME, until Ctrl-C. With --points, --grid or
    --check-picture it needs no browser; it ends with 1 when the marks do not agree.
    """
    loaded = load_config(config_path, overrides)
    frame = _read_frame(picture, loaded, at_s)
    if points_path is None and (write or json_path is not None):
        raise BikepedError("--points: missing; --save and --json need a fit of marks")
    if grid_path is not None and grid_path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise BikepedError(f"--grid {grid_path}: cannot be drawn; name a .png or .jpg file")
    if check_path is not None and check_path.suffix.lower() not in (".jpg", ".jpeg"):
        raise BikepedError(f"--check-picture {check_path}: name a .jpg file")
    frame_framing = framing(loaded).for_frame(frame.width, frame.height)
    if check_path is not None:
        count = _save_check_picture(loaded, frame, check_path)
        if json_path != "-":
            click.echo(f"wrote {check_path}, {count} road users; set detection.check_picture to it")
        if points_path is None and grid_path is None:
            return 0
    if points_path is None and grid_path is None:
        _serve(loaded, frame, picture, port, no_browser)
        return 0
    found, points, saved = None, None, None
    if points_path is not None:
        points = load_points(points_path)
        found, _ = fit_points(ground_camera(loaded), framing(loaded), points)
        if write:
            path = Path(loaded.source)
            values = {key: getattr(found.alignment, key) for key in found.standard_errors}
            saved = save(path, values, file_hash(path), picture=frame_rgb(frame))
    if grid_path is not None:
        camera = ground_camera(loaded)
        if found is not None:
            camera = found.alignment.camera(camera)
        _draw(camera, frame_framing, frame, points, grid_path)
    if found is not None:
        if json_path is not None:
            written = {} if saved is None else {"saved": saved.keys, "backup": str(saved.backup)}
            write_json({**fit_json(found), **written}, json_path)
        if json_path != "-":
            _print(found, saved)
    if json_path != "-" and grid_path is not None:
        click.echo(f"wrote {grid_path}")
    return int(found is not None and bool(found.outliers))


def _read_frame(picture: Path, loaded: LoadedConfig, at_s: float) -> Frame:
    """One frame of a picture, a folder or a video."""
    if not picture.exists():
        raise CaptureError(f"{picture}: no such file; give a picture or a video of the camera")
    with open_source(loaded.config.camera, str(picture.absolute())) as source:
        for frame in iter(source.read, None):
            if frame.captured_s >= at_s - 1e-6:
                return frame
    raise CaptureError(f"{picture}: ends before {at_s:g} s; choose a smaller --at")


def _save_check_picture(loaded: LoadedConfig, frame: Frame, path: Path) -> int:
    """Writes the frame and what the configured model finds in it; returns how many."""
    pool = load_detector_pool(loaded)
    decoded = DetectionStage(pool).decode(frame, 0.0, 0.0)
    found = known_answers(pool.detect(decoded).detections, loaded.config.detection.confidence)
    if not len(found):
        raise BikepedError(
            f"--check-picture {path}: the model finds no person in FRAME with much confidence; "
            "take one with a pedestrian and a cyclist near the pole"
        )
    box_px = found.box_px * np.float32(decoded.rgb.shape[1] / frame.width)
    write_check_picture(path, decoded.rgb, replace(found, box_px=box_px), pool.model_hash)
    return len(found)


def _serve(loaded: LoadedConfig, frame: Frame, picture: Path, port: int, no_browser: bool) -> None:
    def announce(url: str) -> None:
        click.echo(f"{picture.name}: {url}align  (Ctrl-C ends)")
        if not no_browser:
            webbrowser.open(f"{url}align")

    serve_pages(
        msgspec.structs.replace(loaded.config.web, port=port),
        lambda app: add_align(app, loaded, lambda: frame, live=False),
        announce=announce,
        base_dir=loaded.base_dir,
        source=loaded.source,
    )


def _draw(
    camera: GroundCamera, framing: Framing, frame: Frame, points: Points | None, target: Path
) -> None:
    grid = ground_grid(camera, framing)
    marks: tuple[tuple[str, float, float], ...] = ()
    if points is not None:
        share = frame.width / points.frame.width
        marks = tuple((mark.name, mark.u * share, mark.v * share) for mark in points.marks)
    drawn = cv2.cvtColor(draw_grid(frame_rgb(frame), grid, marks), cv2.COLOR_RGB2BGR)
    write_whole(target, cv2.imencode(target.suffix.lower(), drawn)[1].tobytes())


def _print(found: AlignmentFit, saved: Saved | None) -> None:
    screen = console()
    fitted = []
    for key, error in found.standard_errors.items():
        value = getattr(found.alignment, key)
        fitted.append((f"{PARAMETER_NAMES[key]} (camera.{key})", f"{value:.4f}", f"{error:.4f}"))
    screen.print(text_table(("", "fitted", "+/-"), fitted))
    residuals = []
    for r in found.residuals:
        metres = (f"{r.measured_m:.2f}", f"{r.read_m:.2f}", f"{100 * r.error_m:+.1f}")
        residuals.append((r.mark, r.quantity, *metres, "look again" if r.is_outlier else ""))
    columns = ("mark", "what", "measured m", "reads m", "off cm", "")
    screen.print(text_table(columns, residuals, align="llrrrl"))
    if found.standard_error_at_10m_m is not None:
        screen.print(f"a mark at 10 m reads 10 m +/- {100 * found.standard_error_at_10m_m:.0f} cm")
    if not found.redundancy:
        screen.print("no measurement is left over: nothing checks these numbers; add a mark")
    if found.suspect_mark is not None:
        mark = escape(found.suspect_mark)
        screen.print(f"the others agree without mark {mark}: measure it again")
    elif found.outliers:
        screen.print("the marks do not agree with one another: measure them again")
    if saved is not None:
        keys = ", ".join(f"camera.{key}" for key in saved.keys)
        screen.print(f"wrote {keys} into {saved.config}; before: {saved.backup.name}")
        if saved.reference is not None:
            screen.print(f"wrote what the camera sees into {saved.reference}")
        else:
            screen.print(f"the camera's view is not saved: {saved.no_reference}")
