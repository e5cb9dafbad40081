"""What all commands share: options, JSON output, tables, progress bar, log."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bikeped.files import write_whole

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

F = TypeVar("F", bound=Callable[..., Any])


class FiniteRange(click.FloatRange):
    """A finite number in a range: click's own range accepts `nan`."""

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        found = float(super().convert(value, param, ctx))
        if not math.isfinite(found):
            self.fail(f"{value} is not a number that can be used here", param, ctx)
        return found


def config_options(command: F) -> F:
    """`-c` and `--set`, on every command that reads a configuration."""
    command = click.option(
        "--set",
        "overrides",
        multiple=True,
        metavar="SECTION.KEY=VALUE",
        help="Override one key of the configuration; may be repeated.",
    )(command)
    return click.option(
        "-c",
        "--config",
        "config_path",
        type=click.Path(path_type=Path),
        help="Configuration file; default: ./config.yaml, or the bundled one.",
    )(command)


def json_option(command: F) -> F:
    """`--json FILE`, `-` for standard output."""
    return click.option(
        "--json",
        "json_path",
        metavar="FILE",
        help="Write machine-readable JSON; - for standard output, and nothing else there.",
    )(command)


def write_json(data: Any, target: str) -> None:
    """Writes JSON to a file (whole or not at all) or to standard output."""
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
        return
    write_whole(Path(target), text)


def console(json_path: str | None = None) -> Console:
    """The console for tables: standard output, or standard error when JSON goes there."""
    from rich.console import Console

    screen = Console(stderr=json_path == "-", highlight=False, soft_wrap=True)
    if not screen.is_terminal:
        screen.width = 250  # do not wrap in a file or a pipe
    return screen


def text_table(
    columns: Sequence[str],
    rows: Iterable[Iterable[str | Text]],
    *,
    align: str = "",
    title: str = "",
    note: str = "",
) -> Table:
    """A table for a terminal or a file, without rules. A text cell is printed as it is, never read
    as markup; a rich Text keeps its style.

    `align` has one letter a column, `l` or `r`; default: the first left, the others right.
    """
    from rich.markup import escape
    from rich.table import Table

    table = Table(
        title=escape(title) or None,
        title_justify="left",
        caption=escape(note) or None,
        caption_justify="left",
        box=None,
        pad_edge=False,
        show_header=any(columns),
    )
    sides = align or "l" + "r" * (len(columns) - 1)
    for name, side in zip(columns, sides, strict=True):
        table.add_column(escape(name), justify="left" if side == "l" else "right")
    for row in rows:
        table.add_row(*(escape(cell) if isinstance(cell, str) else cell for cell in row))
    return table


@contextlib.contextmanager
def progress_bar(what: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error if that is a terminal; call it with the count so far."""
    screen = console("-")
    if not screen.is_terminal:
        yield lambda done: None
        return
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeRemainingColumn(), console=screen, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda done: bar.update(task, completed=done)


def set_up_logging(level: str) -> None:
    """Log lines on standard error; under systemd without the time, which the journal adds."""
    form = "%(levelname)s %(name)s: %(message)s"
    if "JOURNAL_STREAM" not in os.environ:
        form = "%(asctime)s " + form
    logging.basicConfig(level=level.upper(), format=form, stream=sys.stderr)
    logging.getLogger("asyncio").setLevel(logging.WARNING)


def width_height(text: str) -> tuple[int, int] | None:
    """Width and height of a text like 1920x1080; None where it is none."""
    match = re.fullmatch(r"(\d{2,4})x(\d{2,4})", text)
    return None if match is None else (int(match[1]), int(match[2]))
