"""The conformance report for a city engineer: figures with their texts, results, and their limits.

One HTML page with relative links and no script; it follows the reader's light or dark setting and
prints on paper. The test bench's report (`lab/testbench/export.py`) uses the same parts.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from bikeped.errors import require
from bikeped.files import make_folder, write_whole
from bikeped.lab.experiments import figure_areas, figure_lines
from bikeped.lab.governance.gates import check_gate_figures
from bikeped.lab.governance.register import register_from_figures
from bikeped.lab.result_tables import CellValue, ExperimentResult, ResultTable
from bikeped.lab.simulation.suite import Suite
from bikeped.templates import render

Draw = Callable[[Mapping[str, Any], str, str, Path], list[Path]]


@dataclass(frozen=True)
class ReportFigure:
    """One figure and its texts: `caption` is printed on it, `explained` is for the report.

    `experiment` names the data that it is drawn from, `needs` the key in them that it shows.
    """

    draw: Draw
    experiment: str
    needs: str
    title: str
    caption: str
    explained: str


#: By file stem, in the order of the report.
FIGURES: dict[str, ReportFigure] = {
    "compare": ReportFigure(
        figure_lines.compare,
        "compare",
        "configurations",
        "Which configuration detects danger, and which alerts without danger?",
        "Up: more of the actionable danger is answered with an alert. Right: fewer alerts "
        "without danger. Filled marks include the camera's localisation error.",
        "Each mark is one way to set up the decision: the further up, the more danger it "
        "answers, the further right, the less often it alerts for nothing. Only what lies in "
        "the grey corner passes the two gates that a deployment needs.",
    ),
    "budgets": ReportFigure(
        figure_areas.budgets,
        "budgets",
        "rows",
        "How much time does an alert leave?",
        "Bars: mean over a scenario's alerts. Ticks: each alert. Colour and hatching go by a "
        "scenario's worst alert.",
        "From the moment of the alert to the moment at which cyclist and pedestrian are "
        "nearest, compared with how long people take to react. A hatched bar holds at least one"
        " alert that leaves a distracted person too little time.",
    ),
    "latency": ReportFigure(
        figure_lines.latency,
        "latency",
        "delay_ms",
        "What does a slow camera cost?",
        "The later the picture, the later the alert. Prediction moves positions ahead by the "
        "known delay.",
        "Every camera delivers its pictures late, and what it shows has moved on meanwhile. The"
        " curves show what this costs, and whether predicting where people are by now makes up "
        "for it.",
    ),
    "loss_latency": ReportFigure(
        figure_lines.loss_latency,
        "latency_loss",
        "predictors",
        "A slow camera that also misses people",
        "Late pictures and missed detections together. Bands: 95 % confidence interval of the "
        "mean over random trials.",
        "As before, but the detector also misses people at random, as real ones do. Where the "
        "bands of two predictors overlap, their difference may be chance.",
    ),
    "montecarlo": ReportFigure(
        figure_lines.montecarlo,
        "montecarlo",
        "rows",
        "How well does it do when the detector misses people?",
        "Mean over random trials with its 95 % confidence interval. Bursts: misses come several"
        " frames in a row.",
        "Detectors miss people; here each person is missed at random as often as was measured, "
        "either frame by frame or several frames in a row. Whiskers show how sure the mean is.",
    ),
    "truth": ReportFigure(
        figure_lines.truth,
        "truth",
        "rows",
        "Do the results depend on the ground-truth thresholds?",
        "One threshold of the definition of danger is varied at a time; filled marks are the "
        "default. SevFN: share of missed danger, weighted by the cyclist's energy.",
        "What counts as danger is a choice, and these are its three thresholds, each moved in "
        "turn. If the marks of a group lie close together, the result does not depend on that "
        "choice.",
    ),
    "braking": ReportFigure(
        figure_areas.braking,
        "braking",
        "rows",
        "Do the results depend on how cyclists brake?",
        "The same decisions against ground truth in which every cyclist brakes in one way "
        "(reaction time, deceleration).",
        "How soon a cyclist can stop decides what counts as danger. The bars repeat the "
        "comparison with other reaction times and brakes; the decisions stay the same.",
    ),
    "errors": ReportFigure(
        figure_lines.error_lines,
        "errors",
        "table",
        "How far off is a position?",
        "Distance between where an object stands and where the camera puts it, by how far it is"
        " and how far it is aside of the camera's axis.",
        "The camera takes the middle of a box's lower edge for the point where a person stands,"
        " and that is a little wrong. Long objects at the edge of the view are off most.",
    ),
    "errors_map": ReportFigure(
        figure_areas.error_map,
        "errors",
        "map",
        "Where on the ground is a position off?",
        "Seen from above, camera at the black triangle looking up the page; objects lie across "
        "the view. Lines: 0.5, 1 and 2 m.",
        "The same error everywhere in front of the camera, out to the 25 m within which "
        "decisions are made. Dark is good: positions there are right to within a few "
        "decimetres.",
    ),
    "deployment": ReportFigure(
        figure_areas.deployment,
        "deployment",
        "rows",
        "One camera or two, on narrow and wide roads",
        "Mean sensitivity over random trials with its 95 % confidence interval; black dashes: "
        "the same if objects that no camera sees are never detected.",
        "A second camera on the other side sees whom the first one misses. Bars compare the two"
        " for usual road widths and two ways to mount a camera.",
    ),
    "placement": ReportFigure(
        figure_areas.placement,
        "placement",
        "sensitivity",
        "How high to mount the camera, and how steep?",
        "Mean sensitivity on a 40 ft road for every height and pitch; brighter is better.",
        "Each cell is one way to mount the camera. Where two maps are shown and the right one "
        "is darker, the mount looks good on the left only because people were detected whom the"
        " camera cannot see.",
    ),
    "optimize": ReportFigure(
        figure_lines.optimize,
        "optimize",
        "trace",
        "How the parameters were found",
        "Best cost found so far; the cost weighs missed danger, false alerts, latency and fatigue.",
        "A search tries thousands of parameter sets and keeps the one of least cost on these "
        "scenarios. A curve that has been flat for long says that more search would hardly "
        "help.",
    ),
}


def draw_all(data: Mapping[str, Mapping[str, Any]], suite: Suite, folder: Path) -> list[Path]:
    """Draws every figure whose experiment is in `data` into `folder`, as PNG and PDF.

    The same data give the same bytes. BikepedError when matplotlib is not installed or a file
    cannot be written.
    """
    require("matplotlib")
    make_folder(folder)
    paths: list[Path] = []
    for figure in FIGURES.values():
        found = data.get(figure.experiment)
        if not found or not found.get(figure.needs):
            continue
        caption = figure.caption
        # Those three have their own objects and roads.
        if figure.experiment not in ("errors", "deployment", "placement"):
            caption += f" On {len(suite.scenarios)} scenarios."
        paths += figure.draw(found, figure.title, caption, folder)
    return paths


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
