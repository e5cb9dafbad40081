"""What the conformance commands share: options, configuration and suite, tables and JSON."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bikeped.cli.common import (
    FiniteRange,
    config_options,
    console,
    json_option,
    text_table,
    write_json,
)
from bikeped.cli.guard import guarded
from bikeped.config.load import LoadedConfig, load_config
from bikeped.config.schema import DecisionConfig
from bikeped.cores import cores

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

    from bikeped.lab.result_tables import CellValue, ExperimentResult, ResultTable
    from bikeped.lab.simulation.simulate import TrackerName
    from bikeped.lab.simulation.suite import Suite

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


def scenarios_option(command: F) -> F:
    """`--scenarios DIR` in place of the bundled suite."""
    return click.option(
        "--scenarios",
        "scenarios_dir",
        type=click.Path(path_type=Path),
        metavar="DIR",
        help="Folder of scenario files (*.yaml) in place of the bundled 24, or `street`: bundled "
        "scenes of an ordinary street.",
    )(command)


tracker_option = click.option(
    "--tracker",
    type=click.Choice(["deployed", "paper"]),
    default="deployed",
    show_default=True,
    help="The configuration's tracker, as the pole runs it, or the one that the paper's figures "
    "hold with (every track counts, the light shows the raw state).",
)


@dataclass
class SuiteRun:
    """The options that all conformance commands share; configuration and suite on first use.

    So a command checks its own options before anything is loaded.
    """

    config_path: Path | None
    overrides: tuple[str, ...]
    scenarios_dir: Path | None
    json_path: str | None
    tracker: TrackerName = "deployed"
    seed_option: int | None = None

    @property
    def seed(self) -> int:
        return self.seed_option or 0

    @cached_property
    def loaded(self) -> LoadedConfig:
        return load_config(self.config_path, self.overrides)

    @cached_property
    def suite(self) -> Suite:
        """The scenarios of the folder (None: the bundled ones) before the configured camera."""
        from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
        from bikeped.lab.simulation.suite import Suite

        scenarios = load_scenarios(self.scenarios_dir or bundled_folder())
        return Suite.load(scenarios, self.loaded, self.tracker)

    @property
    def decision(self) -> DecisionConfig:
        return self.loaded.config.decision

    @cached_property
    def console(self) -> Console:
        return console(self.json_path)

    def write_json(self, data: dict[str, Any]) -> None:
        """Writes `data` where `--json` says; nothing without it."""
        if self.json_path is not None:
            write_json(data, self.json_path)

    def provenance(self, seed: int | None = None) -> dict[str, Any]:
        """The keys that every experiment's JSON begins with."""
        from bikeped.lab.simulation.suite import result_provenance

        return result_provenance(self.suite, self.loaded, self.seed if seed is None else seed)

    def emit(self, result: ExperimentResult, seed: int | None = None) -> None:
        """The result as JSON where it is asked for, and as tables unless JSON goes to stdout."""
        if self.json_path is not None:
            self.write_json({**self.provenance(seed), **result.data})
        if self.json_path != "-":
            for table in result.tables:
                self.console.print(rich_table(table))
                self.console.print()


def suite_options(function: Callable[..., T]) -> Callable[..., T]:
    """`-c`, `--set`, `--scenarios`, `--tracker`, `--json`, which the function gets as a `SuiteRun`.

    Its files are checked before it starts (`cli.guard`).
    """

    @functools.wraps(function)
    def with_run(
        config_path: Path | None,
        overrides: tuple[str, ...],
        scenarios_dir: Path | None,
        json_path: str | None,
        tracker: TrackerName,
        seed: int | None = None,
        **options: Any,
    ) -> T:
        run = SuiteRun(config_path, overrides, scenarios_dir, json_path, tracker, seed)
        return function(run, **options)

    return config_options(scenarios_option(tracker_option(json_option(guarded(with_run)))))


def experiment_options(function: Callable[..., T]) -> Callable[..., T]:
    """`suite_options` and `--seed`."""
    return click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        help="Seed of all random numbers; the JSON records it. Default: 0; optimize: 42.",
    )(suite_options(function))


def trials_option(default: int) -> Callable[[F], F]:
    """`--trials`."""
    return click.option(
        "--trials",
        type=click.IntRange(1, 100_000),
        default=default,
        show_default=True,
        help="Number of random trials.",
    )


processes_option = click.option(
    "--processes",
    type=click.IntRange(1, 256),
    callback=lambda ctx, param, value: value or cores(),
    help="Number of processes; default: one a core. Results do not depend on it.",
)
curve_option = click.option(
    "--recall-curve",
    "curve_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Detector recall by projected area: CSV or JSON of bin centre (square pixels), recall.",
)
burst_option = click.option(
    "--burst",
    type=FiniteRange(1, 1000),
    default=5.0,
    show_default=True,
    help="Mean length of a burst of missed detections, in frames.",
)


def misses_options(command: F) -> F:
    """The options of random trials with missed detections."""
    return trials_option(50)(burst_option(curve_option(processes_option(command))))


def rich_table(table: ResultTable) -> RichTable:
    """A result's table for a terminal: per cent with one decimal, seconds with two."""
    text = [any(isinstance(row[i], str) for row in table.rows) for i in range(len(table.columns))]
    return text_table(
        table.columns,
        [map(_cell_text, row, table.columns) for row in table.rows],
        align="".join("l" if is_text else "r" for is_text in text),
        title=table.title,
        note=table.note,
    )


def _cell_text(cell: CellValue, column: str) -> str:
    """One value as the column's name asks for it; a dash where there is none."""
    if cell is None:
        return "-"
    if isinstance(cell, float) and column.endswith("%"):
        return f"{cell:.1f}"
    if isinstance(cell, float) and column.endswith(", s"):
        return f"{cell:.2f}"
    return f"{cell:g}" if isinstance(cell, float) else str(cell)
