"""The conformance report for a city engineer: what was tested, the results, and their limits.

One HTML page with relative links and no script; it follows the reader's light or dark setting and
prints on paper. The test bench's report (`lab/testbench/export.py`) uses the same parts.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from bikeped.files import write_whole
from bikeped.lab.experiments.figures import FIGURES
from bikeped.lab.governance.gates import check_gate_figures
from bikeped.lab.governance.register import register_from_figures
from bikeped.lab.result_tables import CellValue, ExperimentResult, ResultTable
from bikeped.templates import render

#: Without the table of scenarios, the verdict is on the comparison's first of these.
_IN_FORCE = ("deployed", "selected")
_TEMPLATES = Path(__file__).parent / "templates"


def write_index(
    folder: Path,
    results: Sequence[ExperimentResult],
    figures: Sequence[Path],
    provenance: Mapping[str, str],
) -> Path:
    """Writes `index.html` into `folder`, linking figures (and tables, where they lie there) by
    relative paths; returns its path. BikepedError names a file that cannot be written."""
    found = {r.name: r for r in results}
    command = provenance.get("command", "bikeped conformance reproduce")
    sections = [
        ("verdict", "Verdict", verdict_html(found)),
        ("tested", "What was tested", tested_html(found, provenance)),
        ("figures", "Figures", _figures_html(folder, figures)),
        ("tables", "Tables", _tables_html(folder, results)),
        ("risks", "Residual risks", risks_html(found, provenance)),
        ("provenance", "Provenance", definitions_html(provenance)),
        ("contest", "Run it again, or contest it", _render("rerun", command=command)),
    ]
    path = folder / "index.html"
    write_whole(path, _render("report", sections=sections))
    return path


def _render(template: str, /, **values: Any) -> Markup:
    return render(f"{template}.html", _TEMPLATES, **values)


def verdict_html(found: Mapping[str, ExperimentResult]) -> Markup:
    """The gates of the configuration in force, in one sentence and a table."""
    name, figures = _in_force(found)
    gates = [] if figures is None else check_gate_figures(figures)
    failed = [g.name.lower() for g in gates if not g.holds]
    return _render("verdict", name=name, gates=gates, failed=failed)


def _in_force(found: Mapping[str, ExperimentResult]) -> tuple[str, Mapping[str, Any] | None]:
    """The configuration in force, as the table of scenarios measured it; else the paper's."""
    run = found.get("run")
    if run is not None and run.data.get("metrics"):
        rows = {row["scenario"]: row for row in run.data.get("scenarios", ())}
        return "in force", {**run.data["metrics"], "by_scenario": rows}
    result = found.get("compare")
    configurations = result.data.get("configurations", {}) if result is not None else {}
    name = next((n for n in _IN_FORCE if n in configurations), next(iter(configurations), ""))
    return name, configurations.get(name)


def tested_html(found: Mapping[str, ExperimentResult], provenance: Mapping[str, str]) -> Markup:
    """What went through the simulation, and what did not."""
    data = found["compare"].data if "compare" in found else {}
    count = data.get("scenarios", provenance.get("scenarios", "a set of"))
    return _render("tested", count=count, camera=data.get("camera"))


def _figures_html(folder: Path, paths: Sequence[Path]) -> Markup:
    """Each figure once, with two sentences and links to its files."""
    stems = list(dict.fromkeys(p.with_suffix("") for p in paths))
    order = list(FIGURES)
    stems.sort(key=lambda p: order.index(p.name) if p.name in FIGURES else len(order))
    figures = []
    for stem in stems:
        text = FIGURES.get(stem.name)
        links = {p.suffix: _href(folder, p) for p in paths if p.with_suffix("") == stem}
        figures.append(
            {
                "title": stem.name.replace("-", " ").replace("_", " ") if not text else text.title,
                "explained": "" if text is None else text.explained,
                "image": links.get(".png", links.get(".svg")),
                "links": [(suffix[1:].upper(), link) for suffix, link in links.items()],
            }
        )
    return _render("figures", figures=figures)


def _tables_html(folder: Path, results: Sequence[ExperimentResult]) -> Markup:
    parts = []
    for table in (table for result in results for table in result.tables):
        file = f"{table.name}.csv"
        files = [p for p in (folder / file, folder / "tables" / file) if p.is_file()]
        parts.append(table_html(table, _href(folder, files[0]) if files else None))
    return Markup("").join(parts) or Markup("<p>No tables.</p>\n")


def table_html(table: ResultTable, link: str | None = None) -> Markup:
    """A table with its caption and note; `link` leads to its CSV."""
    columns = []
    for index, name in enumerate(table.columns):
        values = [row[index] for row in table.rows]
        right = any(map(_is_number, values)) and all(
            v in (None, "") or _is_number(v) for v in values
        )
        columns.append((name, Markup(" class=n" if right else ""), _texts(values)))
    return _render("table", table=table, columns=columns, link=link)


def risks_html(found: Mapping[str, ExperimentResult], provenance: Mapping[str, str]) -> Markup:
    """The residual-risk register of what was measured."""
    _, figures = _in_force(found)
    by_scenario = (figures or {}).get("by_scenario", {})
    register = register_from_figures(by_scenario, {}, provenance.get("suite_hash", ""))
    hazards, scenarios = register.tables()
    parts = [
        Markup(
            "<p>What the system does not or only partly answer. Field-blocking: more evidence is "
            "needed before it runs unsupervised; monitor: collect data in the field.</p>\n"
        ),
        table_html(hazards),
    ]
    if by_scenario:
        # The hazard classes are in the scenario files, which this page does not have.
        parts.append(table_html(scenarios.without("Hazard")))
    return Markup("").join(parts)


def definitions_html(items: Mapping[str, str]) -> Markup:
    """Names and values, e.g. hashes."""
    return _render("definitions", items=items.items())


def _href(folder: Path, path: Path) -> str:
    """A relative link that stays valid when the folder is moved."""
    return quote(Path(os.path.relpath(path, folder)).as_posix())


def _is_number(cell: CellValue) -> bool:
    """Numbers, and texts that are written numbers: they are aligned right."""
    if isinstance(cell, str):
        return cell.replace(".", "", 1).removeprefix("-").isdecimal()
    return isinstance(cell, (int, float)) and not isinstance(cell, bool)


def _texts(values: Sequence[CellValue]) -> list[str]:
    """The texts of a column: its fractions with equally many decimals, so that points align."""
    short = [f"{v:.6g}" for v in values if isinstance(v, float)]
    decimals = max((len(t.partition(".")[2]) for t in short if "e" not in t), default=0)
    return [
        "–" if v is None else f"{v:.{decimals}f}" if isinstance(v, float) else str(v)
        for v in values
    ]
