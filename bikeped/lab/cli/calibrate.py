"""`bikeped calibrate`: the lens, from pictures of a checkerboard."""

from __future__ import annotations

import os
from pathlib import Path

import click

from bikeped.cli.common import FiniteRange, config_options, console, json_option
from bikeped.cli.guard import check_outputs, guarded, written_paths
from bikeped.errors import require
from bikeped.lab.cli.calibrate_options import PATTERN, Asked

_MODELS = ("equidistant", "equisolid", "stereographic", "orthographic", "linear", "equalarea")
_DEFAULT_OUT = Path("camera_calibration.json")


@click.command("calibrate")
@click.argument("images", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--pattern",
    type=PATTERN,
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
    help="Calibration file; what it held is kept as FILE.bak. Default: camera_calibration.json "
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
    pattern: tuple[int, int] | None,
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
    # The matrices are small: a second thread costs more than it does, some twenty times over. The
    # libraries read this once, when they are loaded.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    require("scipy", extra="calibrate")
    from bikeped.lab.cli.calibrate_capture import live_pictures, write_board
    from bikeped.lab.cli.calibrate_run import run
    from bikeped.lab.cli.calibrate_tables import print_result

    if report_path is not None:
        require("matplotlib")
    target = out or _DEFAULT_OUT
    if board_path is None:
        lens = [(f"{target}, the lens,", target)]
        if out is not None and target.exists():
            lens.append((f"{target}.bak, the former lens,", target.with_name(target.name + ".bak")))
        others = (("--report", report_path), ("--json", json_path))
        named = [(name, path) for name, value in others for path in written_paths(value)]
        check_outputs(
            [("IMAGES", path) for path in images]
            + ([("-c", config_path)] if config_path is not None else []),
            lens + named,
        )
    screen = console(json_path)
    asked = Asked.of(pattern, square_m, model, terms, board_shape, compare, folds or 0)
    if board_path is not None:
        write_board(board_path, asked.pattern, page, screen)
        return 0
    if live:
        images = live_pictures(images, asked.pattern, config_path, overrides, screen)
    done = run(images, asked, config_path, overrides)
    written = done.write(report_path, json_path, out, _DEFAULT_OUT)
    if json_path != "-":
        print_result(screen, done)
        for line in written:
            click.echo(line)
    return 0
