"""The `bikeped` command."""

from __future__ import annotations

import sys
from importlib import import_module

import click

from bikeped import __version__
from bikeped.cli.common import set_up_logging
from bikeped.errors import BikepedError

#: Command: module that holds it as `command`. Imported only when asked for: a help page must not
#: wait for a video library.
COMMANDS = {
    "run": "bikeped.cli.run",
    "replay": "bikeped.cli.replay",
    "demo": "bikeped.lab.cli.demo",
    "config": "bikeped.cli.config",
    "doctor": "bikeped.cli.doctor",
    "align": "bikeped.cli.align",
    "calibrate": "bikeped.lab.cli.calibrate",
    "conformance": "bikeped.lab.cli.conformance",
    "testbench": "bikeped.lab.cli.testbench",
    "scene": "bikeped.lab.cli.scene",
    "model": "bikeped.lab.cli.model",
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


@click.group(cls=_Lazy, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="bikeped")
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"]),
    default="warning",
    show_default=True,
    help="How much to say on standard error; `run` says at least info.",
)
def cli(log_level: str) -> None:
    """Warns cyclists and pedestrians at a crossing of one another."""
    set_up_logging(log_level)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command line: 0 did its job, 1 a check does not hold, 2 bad input."""
    try:
        result = cli.main(args=arguments, prog_name="bikeped", standalone_mode=False)
    except click.exceptions.Abort:
        click.echo("bikeped: interrupted", err=True)
        return 130
    except click.ClickException as error:
        context: click.Context | None = getattr(error, "ctx", None)
        if context is not None and type(error).__name__ == "NoArgsIsHelpError":  # click 8.2 on
            click.echo(context.get_help(), err=True)
            return 2
        command = context.command_path if context is not None else "bikeped"
        text = " ".join(error.format_message().split()).rstrip(".")
        click.echo(f"bikeped: {text}; see {command} --help", err=True)
        return 2
    except click.exceptions.Exit as leave:
        return leave.exit_code
    except BikepedError as error:
        click.echo(f"bikeped: {' '.join(str(error).split())}", err=True)
        return error.exit_status
    return int(result or 0)


if __name__ == "__main__":
    sys.exit(main())
