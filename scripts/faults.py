"""The fault campaign: injects faults against the real service and writes docs/faults.md.

`scripts/faults` runs all rows, `scripts/faults 1 9 13` some; the page is written when all ran, in
this run or in those whose figures `--also` names. Ends with 1 when a row fails that this campaign
is to pass.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from rich.console import Console

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))


def main() -> int:
    runner = importlib.import_module("campaign.runner")

    os.chdir(ROOT)
    known = runner.load_rows()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("numbers", nargs="*", type=int, metavar="N", help="rows; all without")
    parser.add_argument("--repeat", type=int, metavar="K", help="repetitions of each row")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument(
        "--also", type=Path, nargs="+", default=(), help="figures of other runs, the first counts"
    )
    parser.add_argument("--page", type=Path, help="write the page here, whatever ran")
    arguments = parser.parse_args()
    unknown = [number for number in arguments.numbers if number not in known]
    if unknown:
        parser.error(f"no row {unknown[0]}; rows are 1 to {max(known)}")
    console = Console()
    rows = [known[number] for number in arguments.numbers or known]
    results: list[Any] | None = [] if arguments.also and not arguments.numbers else None
    if results is None:
        results = runner.run(rows, arguments.repeat, console)
    ran = {result.row.number for result in results}
    for path in arguments.also:
        found = runner.from_figures(known, json.loads(path.read_text(encoding="utf-8")))
        results += [result for result in found if result.row.number not in ran]
        ran |= {result.row.number for result in found}
    results.sort(key=lambda result: result.row.number)
    console.print(runner.table(results))
    if arguments.json:
        text = json.dumps(runner.figures(results), indent=2)
        arguments.json.write_text(text + "\n", encoding="utf-8")
    if arguments.page or {result.row.number for result in results} == set(known):
        runner.write_page(results, arguments.page or ROOT / "docs" / "faults.md")
    failed = runner.failed(results)
    if failed:
        console.print(f"failed: {', '.join(map(str, failed))}")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
