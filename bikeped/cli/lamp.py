"""`bikeped lamp`: the lamp's own process, and the end of what it latched."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

from bikeped.cli.common import PATH, config_options
from bikeped.cli.guard import guarded
from bikeped.config.load import load_config
from bikeped.errors import ConfigError
from bikeped.feedback import check_light
from bikeped.feedback.lamp_client import ask_lamp, write_settings


@click.group("lamp", invoke_without_command=True)
@config_options
@click.option("--write", type=PATH, help="Only write the settings of the process to this file.")
@guarded
def command(config_path: Path | None, overrides: tuple[str, ...], write: Path | None) -> None:
    """Drive the lamp by the service's heartbeats, where feedback.light is lamp."""
    context = click.get_current_context()
    if context.invoked_subcommand is not None:
        context.obj = (config_path, overrides)
        return
    loaded = load_config(config_path, overrides)
    feedback, lamp = loaded.config.feedback, loaded.config.lamp
    if feedback.light != "lamp":
        if write is not None:  # settings of old would take the lines from the service
            write.unlink(missing_ok=True)
        raise ConfigError(f"{loaded.source}: feedback.light is {feedback.light}; set it to lamp")
    check_light(feedback, lamp)
    path = write or Path(lamp.socket).with_name("lamp.json")
    write_settings(path, lamp, feedback)
    if write is None:
        # A fresh interpreter: this one has loaded much that the lamp's process must not need.
        os.execv(sys.executable, [sys.executable, "-m", "bikeped.lamp", str(path)])


@command.command("reset")
@config_options
@guarded
def reset(config_path: Path | None, overrides: tuple[str, ...]) -> None:
    """End what the lamp has latched; its cause should be found first."""
    above = click.get_current_context().obj or (None, ())
    loaded = load_config(config_path or above[0], (*above[1], *overrides))
    status = ask_lamp(loaded.config.lamp.socket, {"reset": True})
    click.echo(f"the lamp is reset; it shows {status.get('colour')}")
