"""What the conformance commands share: options, the suite, tables and JSON."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from bikeped.cli.common import FiniteRange, config_options, console, json_option, write_json
from bikeped.config import LoadedConfig, load_config

if TYPE_CHECKING:
    from bikeped.lab.result_tables import CellValue, ExperimentResult, ResultTable
    from bikeped.lab.simulation.suite import Suite

F = TypeVar("F", bound=Callable[..., Any])


def scenarios_option(command: F) -> F:
    """`--scenarios DIR` in place of the bundled suite."""
    return click.option(
        "--scenarios",
        "scenarios_dir",
        type=click.Path(path_type=Path),
        metavar="DIR",
        help="Folder of scenario files in place of the bundled ones.",
    )(command)


def suite_options(function: F) -> F:
    """`-c`, `--set`, `--scenarios`, `--seed` and `--json`, on every experiment."""
    for option in (
        json_option,
        click.option(
            "--seed",
            type=click.IntRange(0, 2**32 - 1),
            help="Seed of everything random; it is told in the JSON. Default: 0; optimize: 42.",
        ),
        scenarios_option,
        config_options,
    ):
        function = option(function)
    return function


def trials_option(default: int) -> Callable[[F], F]:
    """`--trials`."""
    return click.option(
        "--trials",
        type=click.IntRange(1, 100_000),
        default=default,
        show_default=True,
        help="Random repetitions.",
    )


processes_option = click.option(
    "--processes",
    type=click.IntRange(1, 256),
    help="Processes; default: one a core. The figures do not depend on it.",
)
curve_option = click.option(
    "--recall-curve",
    "curve_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Recall over projected area: CSV or JSON of bin centre (square pixels), recall.",
)
burst_option = click.option(
    "--burst",
    type=FiniteRange(1, 1000),
    default=5.0,
    show_default=True,
    help="Mean length of a burst of misses, in frames.",
)


def print_table(screen: Console, table: ResultTable) -> None:
    """A table for people."""
    screen.print(rich_table(table))


def rich_table(table: ResultTable) -> RichTable:
    """A table for a terminal: per cent with one decimal, seconds with two."""
    drawn = RichTable(
        title=escape(table.title),
        title_justify="left",
        caption=escape(table.note) or None,
        caption_justify="left",
        box=None,
        pad_edge=False,
    )
    for column, name in enumerate(table.columns):
        is_text = any(isinstance(row[column], str) for row in table.rows)
        drawn.add_column(escape(name), justify="left" if is_text else "right")
    for row in table.rows:
        drawn.add_row(*(cell_text(c, n) for c, n in zip(row, table.columns, strict=True)))
    return drawn


def cell_text(cell: CellValue, column: str) -> str:
    """One figure as the column's name asks for it; a dash where there is none."""
    if cell is None:
        return "-"
    if isinstance(cell, float) and column.endswith("%"):
        return f"{cell:.1f}"
    if isinstance(cell, float) and column.endswith(", s"):
        return f"{cell:.2f}"
    return f"{cell:g}" if isinstance(cell, float) else escape(str(cell))


def begin(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
) -> tuple[LoadedConfig, Suite]:
    """Configuration and suite, and every quick check before the work."""
    loaded = load_config(config_path, overrides)
    return loaded, load_suite(loaded, scenarios_dir)


def load_suite(loaded: LoadedConfig, scenarios_dir: Path | None) -> Suite:
    """The scenarios of a folder (None: the bundled ones) before the configured camera."""
    from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
    from bikeped.lab.simulation.suite import Suite

    return Suite.load(load_scenarios(scenarios_dir or bundled_folder()), loaded)


def emit(
    result: ExperimentResult, suite: Suite, loaded: LoadedConfig, seed: int, json_path: str | None
) -> None:
    """JSON where it is asked for, tables for people unless standard output is JSON's."""
    if json_path is not None:
        write_json({**stamp(suite, loaded, seed), **result.data}, json_path)
    if json_path == "-":
        return
    screen = console()
    for table in result.tables:
        print_table(screen, table)
        screen.print()


def stamp(suite: Suite, loaded: LoadedConfig, seed: int) -> dict[str, Any]:
    """What every JSON begins with: where its figures come from."""
    from bikeped.lab.experiments.deterministic import result_provenance

    return result_provenance(suite, loaded, seed)
