"""`bikeped calibrate --live`: takes the pictures, guided."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.markup import escape

from bikeped.capture import open_source
from bikeped.config import LoadedConfig
from bikeped.errors import BikepedError
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.capture.guide import CaptureGuide
from bikeped.lab.calibration.capture.live_page import LivePage
from bikeped.lab.calibration.capture.live_session import LiveSession, capture_boards
from bikeped.lab.calibration.corners.candidates import assumed_lens

DEFAULT_FOLDER = Path("calibration-pictures")


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
    source = open_source(camera)
    try:
        with LivePage(session, port=loaded.config.web.port) as page:
            screen.print(f"pictures go into {escape(str(folder))}; Ctrl-C when you have enough")
            screen.print(f"open {page.url}" if page.url else f"no page: {page.error}")
            try:
                capture_boards(source, guide, folder, session, say=lambda line: screen.print(line))
            except KeyboardInterrupt:
                session.stop()
                click.echo("bikeped: interrupted; calibrating from what was kept", err=True)
    finally:
        source.close()
    return (folder,)
