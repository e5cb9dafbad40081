"""`bikeped run`: the service."""

from __future__ import annotations

import logging
from pathlib import Path

import click

from bikeped.cli.common import config_options
from bikeped.config import load_config


@click.command("run")
@config_options
def command(config_path: Path | None, overrides: tuple[str, ...]) -> int:
    """Watch the crossing until told to stop (SIGTERM): the service."""
    from bikeped.service.run import EXIT_RESTART, run_service

    root = logging.getLogger()
    root.setLevel(min(root.level, logging.INFO))
    status = run_service(load_config(config_path, overrides))
    if status == EXIT_RESTART:
        # A thread is stuck in a driver; only leaving without joining it ends the process.
        logging.shutdown()
        import os

        os._exit(status)
    return status
