"""`bikeped config`: check, show, schema."""

from __future__ import annotations

from pathlib import Path

import click
import msgspec

from bikeped.cli.common import config_options, json_option, write_json
from bikeped.cli.guard import guarded
from bikeped.config.build import framing, ground_camera
from bikeped.config.load import load_config
from bikeped.config.runnable import check_runnable, warnings
from bikeped.errors import ConfigError
from bikeped.geometry.camera import GroundTable
from bikeped.models import model_file


@click.group("config")
def command() -> None:
    """Check, show or describe the configuration."""


@command.command("check")
@config_options
@json_option
@guarded
def check(config_path: Path | None, overrides: tuple[str, ...], json_path: str | None) -> None:
    """Check the configuration; report the first error, or a summary."""
    from bikeped.feedback import check_light

    loaded = load_config(config_path, overrides)
    frame = framing(loaded)
    camera = ground_camera(loaded)
    GroundTable(camera, *frame.crop_wh, step_px=64)
    check_light(loaded.config.feedback, loaded.config.lamp)
    model = loaded.config.detection.model
    file = None if model is None else model_file(model, loaded.base_dir)
    if file is not None and not file.is_file():
        raise ConfigError(
            f"{loaded.source}: detection.model: {file} does not exist; correct the path"
        )
    notes = list(warnings(loaded))
    try:
        check_runnable(loaded)
    except ConfigError as error:
        notes.append(f"`bikeped run` refuses it: {str(error).removeprefix(f'{loaded.source}: ')}")
    report = {
        "ok": True,
        "source": loaded.source,
        "config_hash": loaded.hash,
        "calibration_hash": loaded.calibration_hash,
        "focal_length_px": camera.lens.focal_px,
        "model": None if file is None else str(file),
        "warnings": notes,
    }
    if json_path is not None:
        write_json(report, json_path)
    if json_path != "-":
        click.echo(f"{loaded.source}: valid; configuration {loaded.hash[:12]}")
        click.echo(
            f"lens {camera.lens.projection}, f = {camera.lens.focal_px:.2f} px, "
            f"height {camera.height_m:g} m, pitch {camera.pitch_deg:g} degrees"
        )
        if model is None:
            click.echo("detection.model is not set: `bikeped run` needs one")
        for note in notes:
            click.echo(f"warning: {note}")


@command.command("show")
@config_options
@json_option
@guarded
def show(config_path: Path | None, overrides: tuple[str, ...], json_path: str | None) -> None:
    """Print the whole effective configuration as YAML."""
    loaded = load_config(config_path, overrides)
    if json_path is not None:
        write_json(msgspec.to_builtins(loaded.config), json_path)
    if json_path != "-":
        click.echo(f"# {loaded.source}, configuration {loaded.hash}")
        click.echo(msgspec.yaml.encode(loaded.config).decode(), nl=False)


@command.command("schema")
@config_options
@json_option
@guarded
def schema(config_path: Path | None, overrides: tuple[str, ...], json_path: str | None) -> None:
    """Print the JSON Schema of the configuration."""
    from bikeped.config.json_schema import json_schema

    write_json(json_schema(), json_path or "-")
