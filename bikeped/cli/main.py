"""The `bikeped` command."""

from __future__ import annotations

import sys

import click

from bikeped import __version__
from bikeped.cli.common import LazyGroup, set_up_logging
from bikeped.errors import EXTRAS, BikepedError, MissingPackageError

#: Every command: its module, and the text for the help page. The lab's are found by name, so that
#: the device imports nothing of the lab.
COMMANDS = {
    "run": ("bikeped.cli.run:run", "Run the service: camera, tracking, decision, light and sound."),
    "lamp": ("bikeped.cli.lamp", "Drive the lamp in a process of its own; end what it latched."),
    "replay": ("bikeped.cli.run:replay", "Run a recorded video through the service's loop."),
    "demo": ("bikeped.lab.cli.demo", "Draw a crossing and run it through the loop."),
    "config": ("bikeped.cli.config", "Check, show or describe the configuration."),
    "doctor": ("bikeped.cli.doctor", "Check camera, model, light, speaker, broker, clock, disk."),
    "align": ("bikeped.cli.align", "Fit the camera's height and tilt to marks on the street."),
    "calibrate": ("bikeped.lab.cli.calibrate", "Calibrate a lens from checkerboard pictures."),
    "conformance": (
        "bikeped.lab.cli.conformance",
        "Simulate scripted hazards: experiments, gates, promotion.",
    ),
    "testbench": ("bikeped.lab.cli.testbench", "Explore scenarios and settings in the browser."),
    "scene": ("bikeped.lab.cli.scene", "Render a scenario as labelled fisheye video."),
    "model": ("bikeped.lab.cli.model", "Augment data, train, export and evaluate detectors."),
}


@click.group(cls=LazyGroup, lazy=COMMANDS, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="bikeped")
@click.option(
    "--log-level",
    type=click.Choice(["debug", "info", "warning", "error"]),
    default="warning",
    show_default=True,
    help="Least level of log lines on standard error; `run` logs at least info.",
)
def cli(log_level: str) -> None:
    """Warn cyclists and pedestrians at a crossing of one another."""
    set_up_logging(log_level)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command line; returns 0 (success), 1 (a check failed), 2 (bad input), 130 (^C)."""
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
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        click.echo(f"bikeped: {MissingPackageError(package)}", err=True)
        return BikepedError.exit_status
    return int(result or 0)


if __name__ == "__main__":
    sys.exit(main())
