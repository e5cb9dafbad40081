"""Runs rows, and shows what they gave as a table and as docs/faults.md."""

from __future__ import annotations

import importlib
import pkgutil
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import campaign
from campaign.registry import ROWS, Result, Row, Skip
from campaign.rig import Rig

PAGE_HEAD = """# The fault campaign

Every fault of this list is injected against the real service: `bikeped run` as a process, a
loopback camera (Motion JPEG over HTTP), a real mosquitto, and a light that keeps its colour when
its process dies, as a relay does. Its changes are read from outside. This page is written by

```sh
scripts/faults            # all; `scripts/faults 1 9 13 --repeat 3` some; `--json FILE` the figures
```

Beside each limit, a row fails when the service ends, or when green or blue shows during the fault.
*Measured* is the worst figure of all repetitions (×). What is not tried here says who closes it:
GPIO, USB and V4L2 drivers need the virtual pole; soak beyond two hours is not tried.

| # | fault | expected | limit | worst measured | verdict | closed by |
| --- | --- | --- | --- | --- | --- | --- |
"""


def load_rows() -> dict[int, Row]:
    """All rows, by number."""
    for module in pkgutil.iter_modules(campaign.__path__):
        if module.name.startswith("rows_"):
            importlib.import_module(f"campaign.{module.name}")
    return dict(sorted(ROWS.items()))


def run_row(row: Row, repeat: int | None = None) -> Result:
    """Injects a row's fault; an exception in it is a failure of the row."""
    if row.function is None:
        return Result(row)
    began_s, rig = time.monotonic(), Rig(row, repeat)
    try:
        row.function(rig)
    except Skip as reason:
        rig.result.skipped = str(reason)
    except Exception as error:  # noqa: BLE001 - the other rows still run
        text = str(error).strip() or type(error).__name__
        rig.expect(False, f"{type(error).__name__}: {text[:1500]}")
    finally:
        rig.close()
    rig.result.took_s = time.monotonic() - began_s
    return rig.result


def table(results: Iterable[Result]) -> Table:
    """What was measured, for the terminal."""
    shown = Table("#", "fault", "limit", "worst measured", "×", "verdict", "seen or closed by")
    colours = {"pass": "green", "fail": "red", "not tried": "yellow"}
    for result in results:
        row, verdict = result.row, result.verdict
        shown.add_row(
            str(row.number),
            row.injected,
            "; ".join(map(str, row.limits)),
            result.measured,
            str(result.repetitions or ""),
            f"[{colours[verdict]}]{verdict}[/]",
            _remark(result).replace("[", r"\["),
        )
    return shown


def page(results: Sequence[Result]) -> str:
    """docs/faults.md."""
    lines = []
    for result in results:
        row = result.row
        measured = result.measured
        if result.repetitions > 1:
            measured += f" (× {result.repetitions})"
        cells = (
            str(row.number),
            row.injected,
            row.expected,
            "; ".join(map(str, row.limits)),
            measured,
            f"**{result.verdict}**" if result.verdict == "fail" else result.verdict,
            row.closed_by,
        )
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return PAGE_HEAD + "\n".join(lines) + "\n"


def figures(results: Iterable[Result]) -> list[dict[str, Any]]:
    """The results as plain values, for --json."""
    rows = []
    for result in results:
        values = asdict(result) | {"verdict": result.verdict}
        values["row"] = {
            key: value for key, value in values["row"].items() if key not in ("function", "limits")
        } | {"limit": "; ".join(map(str, result.row.limits))}
        rows.append(values)
    return rows


def from_figures(rows: Mapping[int, Row], data: Iterable[Mapping[str, Any]]) -> list[Result]:
    """The results of an earlier run, from its `figures`."""
    kept = ("worst", "failures", "seen", "repetitions", "took_s", "skipped")
    return [Result(rows[one["row"]["number"]], **{k: one[k] for k in kept}) for one in data]


def run(rows: Sequence[Row], repeat: int | None, console: Console) -> list[Result]:
    """Runs rows one after the other, with a line each."""
    results = []
    for row in rows:
        result = run_row(row, repeat)
        results.append(result)
        console.print(
            f"{row.number:>3} {result.verdict:<9} {result.took_s:6.1f} s  {row.injected}: "
            f"{result.measured} {_remark(result)[:600]}",
            markup=False,
            highlight=False,
        )
    return results


def failed(results: Iterable[Result]) -> list[int]:
    """Numbers of the rows that failed and that no later work closes."""
    return [r.row.number for r in results if r.verdict == "fail" and not r.row.closed_by]


def write_page(results: Sequence[Result], path: Path) -> None:
    """Writes docs/faults.md, of a run of all rows."""
    path.write_text(page(results), encoding="utf-8")


def _remark(result: Result) -> str:
    parts = [*result.failures, *result.seen, result.skipped]
    if result.row.closed_by:
        parts.append(f"closed by: {result.row.closed_by}")
    return "; ".join(part for part in parts if part)
