"""`bikeped testbench`: the browser test bench, saved challenges, and the HTML report."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.markup import escape

from bikeped.cli.common import config_options, console, json_option, progress_bar, write_json
from bikeped.cli.guard import guarded
from bikeped.config.load import LoadedConfig, load_config
from bikeped.errors import BikepedError
from bikeped.files import write_whole
from bikeped.lab.cli.conformance_governance import print_comparison
from bikeped.lab.cli.conformance_shared import scenarios_option
from bikeped.lab.scenarios.scenario import Scenario, bundled_folder, load_scenarios

if TYPE_CHECKING:
    from bikeped.lab.testbench.comparison import InvocationOptions
    from bikeped.lab.testbench.settings import BenchSettings


@click.group("testbench", invoke_without_command=True)
@config_options
@scenarios_option
@click.option("--port", type=click.IntRange(0, 65535), help="Port to serve; 0: any free one.")
@click.option("--host", help="Address to serve; all but loopback addresses need web.token_file.")
@guarded
def command(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    port: int | None,
    host: str | None,
) -> None:
    """Serve the test bench in a browser: play scenarios, change settings, compare results.

    It runs the deployed tracker and rules on simulated scenarios, and changes no running service.
    """
    context = click.get_current_context()
    if context.invoked_subcommand is not None:
        if config_path or overrides or scenarios_dir or port is not None or host:
            raise BikepedError(
                f"testbench: write options after the subcommand: bikeped testbench "
                f"{context.invoked_subcommand} ... -c FILE"
            )
        return
    import msgspec

    from bikeped.lab.testbench.pages import add_testbench
    from bikeped.web.server import serve_pages

    loaded, scenarios, origin = _load(config_path, overrides, scenarios_dir)
    given = {"port": port, "host": host}
    web = msgspec.structs.replace(
        loaded.config.web, **{key: value for key, value in given.items() if value is not None}
    )

    def announce(url: str) -> None:
        console().print(f"Test bench: {escape(url)}testbench (Ctrl-C ends it)", soft_wrap=True)

    add = partial(add_testbench, loaded=loaded, scenarios=scenarios, origin=origin)
    serve_pages(web, add, announce=announce, base_dir=loaded.base_dir, source=loaded.source)


@command.command("contest")
@click.argument("challenge", metavar="FILE_OR_LINK")
@config_options
@scenarios_option
@json_option
@guarded
def contest(
    challenge: str,
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    json_path: str | None,
) -> None:
    """Run the suite with settings saved by the test bench, and compare before and after.

    FILE_OR_LINK is the saved file, or the page's address with all that follows its #.
    """
    from bikeped.lab.testbench.comparison import compare_settings
    from bikeped.lab.testbench.runner import BenchRunner, trial_summaries

    loaded, scenarios, origin = _load(config_path, overrides, scenarios_dir)
    bench = _read_challenge(challenge, loaded)
    work = BenchRunner(loaded, scenarios)
    comparison = compare_settings(work, bench).as_dict()
    trials = trial_summaries(work.full_suite(bench), bench)
    words = origin.command_line("testbench", "contest", challenge)
    if json_path is not None:
        write_json({"command": words, **comparison, "trials": trials}, json_path)
    print_comparison(comparison, words, console(json_path))
    if trials is not None and (mean := trials["sensitivity"]["mean"]) is not None:
        console(json_path).print(
            f"Over {trials['trials']} trials of misses: sensitivity {100 * mean:.1f} %."
        )


@command.command("export")
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False), metavar="REPORT.html")
@config_options
@scenarios_option
@json_option
@guarded
def export(
    out: Path,
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    json_path: str | None,
) -> None:
    """Write an HTML report in one file: playback of every scenario, figures, gates, risks.

    It needs no network and no server.
    """
    from bikeped.lab.testbench.export import render_report

    loaded, scenarios, origin = _load(config_path, overrides, scenarios_dir)
    command_line = origin.command_line("testbench", "export", "report.html")
    with progress_bar("scenarios", len(scenarios)) as progress:
        page = render_report(loaded, scenarios, command_line, progress)
    write_whole(out, page)
    size_mb = len(page.encode()) / 1e6
    if json_path is not None:
        write_json({"file": str(out), "scenarios": len(scenarios), "size_mb": size_mb}, json_path)
    console(json_path).print(f"{escape(str(out))}: {len(scenarios)} scenarios, {size_mb:.1f} MB")


def _load(
    config_path: Path | None, overrides: tuple[str, ...], scenarios_dir: Path | None
) -> tuple[LoadedConfig, list[Scenario], InvocationOptions]:
    from bikeped.lab.testbench.comparison import InvocationOptions

    loaded = load_config(config_path, overrides)
    scenarios = load_scenarios(scenarios_dir or bundled_folder())
    return loaded, scenarios, InvocationOptions(config_path, scenarios_dir, overrides)


def _read_challenge(challenge: str, loaded: LoadedConfig) -> BenchSettings:
    """The settings of a saved file, or of a link."""
    from bikeped.lab.testbench.settings import (
        settings_from_file,
        settings_from_link,
        settings_in_force,
    )

    path = Path(challenge)
    try:
        is_file = not ("=" in challenge or "#" in challenge) or path.is_file()
    except (OSError, ValueError):  # longer than any file's name
        is_file = False
    if not is_file:
        return settings_from_link(challenge, settings_in_force(loaded))
    try:
        if path.stat().st_size > 1_000_000:
            raise BikepedError(f"{path}: larger than 1 MB; a challenge is a short text")
        return settings_from_file(path.read_bytes(), challenge)
    except OSError as error:
        raise BikepedError(f"{path}: cannot be read ({error.strerror}); check the path") from error
