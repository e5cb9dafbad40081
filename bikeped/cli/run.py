"""`bikeped run`: the service."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import NoReturn

import click

from bikeped.cli.common import config_options
from bikeped.cli.web_options import open_pages
from bikeped.config import load_config


@click.command("run")
@config_options
def command(config_path: Path | None, overrides: tuple[str, ...]) -> NoReturn:
    """Run the service until SIGTERM: camera, detection, tracking, decision, light and sound."""
    from bikeped.pipeline.run import run_service

    root = logging.getLogger()
    root.setLevel(min(root.level, logging.INFO))
    loaded = load_config(config_path, overrides)
    pages = open_pages(loaded) if loaded.config.web.enabled else None
    status = run_service(loaded, pages=pages)
    # Everything is stopped and the light is dark. A thread that hangs in a driver must not keep the
    # process alive: exit without joining it.
    logging.shutdown()
    sys.stdout.flush()
    os._exit(status)
