"""`bikeped model`: the detector's own tooling."""

from __future__ import annotations

from importlib import import_module

import click

#: Command: module that holds it as `command`, imported only when asked for.
COMMANDS = {
    "augment": "bikeped.lab.cli.model_augment",
    "train": "bikeped.lab.cli.model_train",
    "export": "bikeped.lab.cli.model_export",
    "evaluate": "bikeped.lab.cli.model_evaluate",
}


class _Lazy(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        module = COMMANDS.get(cmd_name)
        if module is None:
            return None
        found: click.Command = import_module(module).command
        return found


@click.group("model", cls=_Lazy)
def command() -> None:
    """Augment data, train, export and evaluate detectors."""
