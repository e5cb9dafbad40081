"""`bikeped calibrate --live` and `--board`: before there are pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.markup import escape

from bikeped.capture import open_source
from bikeped.errors import BikepedError
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.capture.board_pdf import write_board_pdf
from bikeped.lab.calibration.capture.guide import Guide
from bikeped.lab.calibration.capture.live_page import LivePage
from bikeped.lab.calibration.capture.live_session import LiveSession, assumed_lens, capture_boards
from bikeped.lab.cli.calibrate_run import camera_config

DEFAULT_FOLDER = Path("calibration-pictures")


def write_board(path: Path, pattern: BoardPattern, page: str, screen: Console) -> None:
    """Writes the board and says how to check the print."""
    square_m = write_board_pdf(path, pattern, page=page)
    screen.print(
        f"wrote {escape(str(path))}: {pattern.columns}x{pattern.rows} inner corners, squares of "
        f"{square_m * 1000:g} mm on {page.upper()}"
    )
    screen.print(
        "print it at 100 % (no fitting to the page), hold a ruler against the printed one, glue it "
        f"onto something stiff; then --pattern {pattern.columns}x{pattern.rows} --square METRES as "
        "measured"
    )


def live_pictures(
    images: Sequence[Path],
    pattern: BoardPattern,
    config_path: Path | None,
    overrides: tuple[str, ...],
    screen: Console,
) -> tuple[Path, ...]:
    """Guides a person before the configured camera; the folder that the pictures are in.

    Ends when there is enough, when the source ends, or with Ctrl-C, which keeps what there is.
    """
    if len(images) > 1:
        raise BikepedError("IMAGES: with --live one folder for the pictures, not several")
    folder = images[0] if images else DEFAULT_FOLDER
    if folder.exists() and not folder.is_dir():
        raise BikepedError(f"IMAGES {folder}: with --live the folder for the pictures, not a file")
    loaded = camera_config(config_path, overrides)
    camera = loaded.config.camera
    lens, centre = assumed_lens(camera.width, camera.height)
    guide = Guide(pattern, camera.width, camera.height, lens, centre)
    session = LiveSession(guide)
    source = open_source(
        camera.source,
        width=camera.width,
        height=camera.height,
        fps=camera.fps,
        fourcc=camera.fourcc,
    )
    try:
        with LivePage(session, port=loaded.config.web.port) as page:
            screen.print(f"pictures go into {escape(str(folder))}; Ctrl-C when you have enough")
            screen.print(f"look at {page.url}" if page.url else f"no page: {page.error}")
            try:
                capture_boards(source, guide, folder, session, say=lambda line: screen.print(line))
            except KeyboardInterrupt:
                session.stop()
                click.echo("bikeped: interrupted; calibrating from what was kept", err=True)
    finally:
        source.close()
    return (folder,)
