"""What all commands share: groups, options, JSON output, tables, progress bar, log."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from bikeped.errors import BikepedError
from bikeped.files import write_whole

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

F = TypeVar("F", bound=Callable[..., Any])

#: An option that names a file or a folder.
PATH = click.Path(path_type=Path)
_PLACE = re.compile(r"(?:(?P<host>\[[^\]]+\]|[^:\[\]]+):)?(?P<port>\d{1,5})")


class LazyGroup(click.Group):
    """A group of commands that live in modules of their own; its help page imports none of them.

    `lazy` maps a command's name to (`package.module:name`, text for the group's help page), the
    name `command` if left out. Commands that are added in the usual way are listed behind those.
    """

    def __init__(self, *args: Any, lazy: Mapping[str, tuple[str, str]], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.lazy = lazy

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*self.lazy, *super().list_commands(ctx)]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.lazy:
            return super().get_command(ctx, cmd_name)
        module, _, attribute = self.lazy[cmd_name][0].partition(":")
        found: click.Command = getattr(import_module(module), attribute or "command")
        return found

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        rows = [(name, text) for name, (_, text) in self.lazy.items()]
        for name, command in sorted(self.commands.items()):
            if not command.hidden:
                rows.append((name, command.get_short_help_str(formatter.width)))
        with formatter.section("Commands"):
            formatter.write_dl(rows)


class FiniteRange(click.FloatRange):
    """A finite number in a range: click's own range accepts `nan`."""

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        found = float(super().convert(value, param, ctx))
        if not math.isfinite(found):
            self.fail(f"{value} is not a number that can be used here", param, ctx)
        return found


def config_options(command: F) -> F:
    """`-c` and `--set`, on every command that reads a configuration."""
    text = "Override one key of the configuration; may be repeated."
    setting = click.option(
        "--set", "overrides", multiple=True, metavar="SECTION.KEY=VALUE", help=text
    )
    text = "Configuration file; default: ./config.yaml, or the bundled one."
    return click.option("-c", "--config", "config_path", type=PATH, help=text)(setting(command))


def json_option(command: F) -> F:
    """`--json FILE`, `-` for standard output."""
    text = "Write machine-readable JSON; - for standard output, and nothing else there."
    return click.option("--json", "json_path", metavar="FILE", help=text)(command)


def web_option(command: F) -> F:
    """`--web [HOST:]PORT`: the live page of a replay while it runs, as `web_place`."""
    text = "Serve the live page meanwhile, at the recording's frame rate; e.g. 8080."
    return click.option("--web", "web_place", metavar="[HOST:]PORT", help=text)(command)


def web_overrides(place: str) -> tuple[str, ...]:
    """The value of `--web` as configuration overrides; BikepedError when it is no address."""
    found = _PLACE.fullmatch(place.strip())
    if found is None:
        raise BikepedError(f"--web {place}: is not [HOST:]PORT; give e.g. 8080 or 127.0.0.1:8080")
    host = (found["host"] or "127.0.0.1").strip("[]")
    return ("web.enabled=true", f"web.host={host!r}", f"web.port={int(found['port'])}")


def print_address(address: str) -> None:
    """Prints on standard error where the page is."""
    click.echo(f"{address} shows it while it runs", err=True)


def write_json(data: Any, target: str) -> None:
    """Writes JSON to a file (whole or not at all) or to standard output."""
    text = json.dumps(data, indent=2, allow_nan=False) + "\n"
    if target == "-":
        sys.stdout.write(text)
    else:
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
    from rich import progress

    text, bar_column = progress.TextColumn("{task.description}"), progress.BarColumn()
    columns = (text, bar_column, progress.MofNCompleteColumn(), progress.TimeRemainingColumn())
    with progress.Progress(*columns, console=screen, transient=True) as bar:
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
