"""`bikeped calibrate`: the lens, from pictures of a checkerboard."""

from __future__ import annotations

import os
import re
import signal
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bikeped.cli.common import FiniteRange, config_options, console, json_option
from bikeped.cli.guard import check_outputs, guarded, written_paths
from bikeped.errors import BikepedError, require
from bikeped.lab.calibration.board_view import BoardPattern

if TYPE_CHECKING:
    from rich.console import Console

_MODELS = ("equidistant", "equisolid", "stereographic", "orthographic", "linear", "equalarea")
_DEFAULT_OUT = Path("camera_calibration.json")
#: A board needs corners in two directions, and no printed one has more.
_FEWEST, _MOST = 3, 60


def _pattern(_ctx: click.Context, _param: click.Parameter, text: str | None) -> BoardPattern:
    """Inner corners as COLUMNSxROWS."""
    if text is None:
        raise BikepedError(
            "--pattern: missing; count the corners where four squares meet and give COLUMNSxROWS, "
            "e.g. --pattern 8x6"
        )
    match = re.fullmatch(r"(\d{1,3})[xX×](\d{1,3})", text.strip())
    sides = (0, 0) if match is None else (int(match[1]), int(match[2]))
    if not all(_FEWEST <= side <= _MOST for side in sides):
        raise click.BadParameter(
            f"{text!r} is no board: give the inner corners as COLUMNSxROWS, e.g. 8x6, each from "
            f"{_FEWEST} to {_MOST}"
        )
    return BoardPattern(*sides)


@click.command("calibrate")
@click.argument("images", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--pattern",
    callback=_pattern,
    metavar="COLUMNSxROWS",
    help="Inner corners of the board, where four squares meet, e.g. 8x6.",
)
@click.option(
    "--square",
    "square_m",
    type=FiniteRange(0, 10, min_open=True),
    metavar="METRES",
    help="Side of a square, as measured on the print. The lens does not depend on it.",
)
@click.option(
    "--model",
    type=click.Choice(_MODELS),
    help="Lens model to write. Default: equidistant; with --compare the recommended one.",
)
@click.option(
    "--terms",
    type=click.Choice(["0", "2", "4"]),
    help="Radial terms to fit. Default: 4; with --compare as recommended.",
)
@click.option("--board-shape", is_flag=True, help="Fit the board's shape too: boards bend.")
@click.option("--compare", is_flag=True, help="Fit all models on the same corners.")
@click.option(
    "--folds",
    type=click.IntRange(2, 1000),
    help="Cross-validation: each fold's pictures are predicted from the others. Default: each "
    "picture is a fold.",
)
@click.option(
    "--report",
    "report_path",
    type=click.Path(path_type=Path),
    metavar="FILE.html",
    help="A page with every picture's residuals, coverage and the lens's profile.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Calibration file; an existing one is kept as FILE.bak. Default: camera_calibration.json "
    "in this folder, unless it exists.",
)
@click.option(
    "--live",
    is_flag=True,
    help="Take the pictures now, guided, from camera.source; IMAGES is the folder for them.",
)
@click.option(
    "--board",
    "board_path",
    type=click.Path(path_type=Path),
    metavar="FILE.pdf",
    help="Write a board to print, and do nothing else.",
)
@click.option(
    "--page",
    type=click.Choice(["a4", "a3", "letter"]),
    default="a4",
    show_default=True,
    help="Paper for --board.",
)
@config_options
@json_option
@guarded
def command(
    images: tuple[Path, ...],
    pattern: BoardPattern,
    square_m: float | None,
    model: str | None,
    terms: str | None,
    board_shape: bool,
    compare: bool,
    folds: int | None,
    report_path: Path | None,
    out: Path | None,
    live: bool,
    board_path: Path | None,
    page: str,
    config_path: Path | None,
    overrides: tuple[str, ...],
    json_path: str | None,
) -> int:
    """Measure the lens from IMAGES: pictures of a checkerboard, a folder of them, or a video.

    Sensor frames (camera.width x camera.height) are calibrated in the square crop that the
    configuration describes, pictures of any other size as they are.
    """
    board = replace(pattern, square_m=square_m or 1.0)
    screen = console(json_path)
    if board_path is not None:
        _write_board(board_path, board, page, screen)
        return 0
    # The matrices are small: a second thread costs more than it does, some twenty times over. The
    # libraries read this once, when they are loaded.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    require("scipy", "threadpoolctl", extra="calibrate")
    if report_path is not None:
        require("matplotlib", extra="calibrate")
    _check_outputs(images, config_path, out or _DEFAULT_OUT, report_path, json_path)
    from bikeped.lab.calibration.capture.images import load_images
    from bikeped.lab.cli import calibrate_run as work

    number = None if terms is None else int(terms)
    options = work.CalibrateOptions(board, model, number, board_shape, compare, folds or 0)
    try:
        loaded = work.camera_config(config_path, overrides)
        if live:
            images = work.live_pictures(images, board, loaded, screen)
        if not images:
            raise BikepedError(
                "IMAGES: missing; name pictures of the board, a folder of them or a video, or use "
                "--live"
            )
        pictures = load_images(images)
        result = work.run(pictures, options, loaded)
        written = work.write_outputs(result, pictures, report_path, json_path, out, _DEFAULT_OUT)
    except KeyboardInterrupt:
        click.echo("bikeped: interrupted", err=True)
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # another Ctrl-C ends it without a trace
        raise click.exceptions.Exit(130) from None
    if json_path != "-":
        work.print_result(screen, result, compare)
        for line in written:
            click.echo(line)
    return 0


def _check_outputs(
    images: tuple[Path, ...],
    config_path: Path | None,
    out: Path,
    report_path: Path | None,
    json_path: str | None,
) -> None:
    """Also checks the default calibration file and its backup, which `guarded` does not know."""
    outputs = [(f"{out}, the lens,", out)]
    if out.exists():
        outputs.append((f"{out}.bak, the former lens,", out.with_name(out.name + ".bak")))
    for name, value in (("--report", report_path), ("--json", json_path)):
        outputs += [(name, path) for path in written_paths(value)]
    inputs = [("IMAGES", path) for path in images]
    check_outputs(inputs + [("-c", path) for path in written_paths(config_path)], outputs)


def _write_board(path: Path, pattern: BoardPattern, page: str, screen: Console) -> None:
    from rich.markup import escape

    from bikeped.lab.calibration.capture.board_pdf import write_board_pdf

    square_m = write_board_pdf(path, pattern, page=page)
    screen.print(
        f"wrote {escape(str(path))}: {pattern} inner corners, squares of {square_m * 1000:g} mm on "
        f"{page.upper()}"
    )
    screen.print(
        "print it at 100 % (no fitting to the page), hold a ruler against the printed one, glue it "
        f"onto something stiff; then --pattern {pattern} --square METRES as measured"
    )
