"""One page that a city engineer can read: what was tested, what came out, what it does not say.

The page is plain HTML with relative links and no script; it follows the reader's light or dark
setting and prints on paper.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

from bikeped.files import write_whole
from bikeped.lab.experiments.figures import FIGURES
from bikeped.lab.governance.gates import all_hold, check_gate_figures
from bikeped.lab.governance.register import register_from_figures
from bikeped.lab.result_tables import CellValue, ExperimentResult, ResultTable

#: Without the table of scenarios, the verdict is on the comparison's first of these.
_JUDGED = ("deployed", "selected")
_CSS = """
:root{--ink:#1c1c1c;--soft:#55585c;--paper:#fff;--line:#d8dadd;--tint:#f4f5f7;--good:#00614a;
--bad:#a33b00;--link:#005a8e}
@media (prefers-color-scheme:dark){:root{--ink:#e8e8e8;--soft:#a9adb3;--paper:#16181b;
--line:#3a3e44;--tint:#1f2226;--good:#5fd3ae;--bad:#ff9d66;--link:#7cc4f0}}
*{box-sizing:border-box}
body{margin:0 auto;padding:1.5rem 1rem 4rem;max-width:62rem;background:var(--paper);
color:var(--ink);font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
h1{font-size:1.75rem;line-height:1.2;margin:.4rem 0 .6rem}
h2{font-size:1.25rem;margin:2.4rem 0 .5rem;padding-top:.6rem;border-top:1px solid var(--line)}
h3{font-size:1.02rem;margin:1.6rem 0 .3rem}
p{max-width:46rem;margin:.4rem 0 .8rem}
a{color:var(--link)}
nav ul{display:flex;flex-wrap:wrap;gap:.2rem 1.1rem;padding:0;margin:.6rem 0;list-style:none}
.verdict{font-size:1.08rem;border-left:.35rem solid var(--good);background:var(--tint);
padding:.7rem 1rem;margin:1rem 0}
.verdict.bad{border-color:var(--bad)}
.yes{color:var(--good);font-weight:600}.no{color:var(--bad);font-weight:600}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:.88rem;margin:.4rem 0;font-variant-numeric:tabular-nums}
caption{text-align:left;font-weight:600;padding:.3rem 0}
th,td{padding:.28rem .65rem;border-bottom:1px solid var(--line);text-align:left;vertical-align:top}
th{font-weight:600;border-bottom:2px solid var(--line)}
td.n,th.n{text-align:right;white-space:nowrap}
figure{margin:1.4rem 0}
figure img{max-width:100%;height:auto;background:#fff;border:1px solid var(--line);
border-radius:4px}
figcaption{max-width:46rem;margin-top:.4rem}
.note{color:var(--soft);font-size:.88rem}
code,pre{font-family:ui-monospace,Menlo,Consolas,monospace;font-size:.86rem}
pre{background:var(--tint);border:1px solid var(--line);border-radius:4px;padding:.7rem;
overflow-x:auto}
dl{display:grid;grid-template-columns:max-content 1fr;gap:.15rem 1rem}
dt{color:var(--soft)}dd{margin:0;overflow-wrap:anywhere}
@media print{body{max-width:none;font-size:10.5pt;padding:0;--paper:#fff;--ink:#000;--soft:#444;
--line:#bbb;--tint:#f4f4f4;--good:#00614a;--bad:#a33b00;--link:#000}
nav{display:none}figure,tr{break-inside:avoid}h2,h3{break-after:avoid}
.scroll{overflow:visible}table{font-size:8pt}a{text-decoration:none}}
"""


def write_index(
    folder: Path, results: list[ExperimentResult], figures: list[Path], provenance: dict[str, str]
) -> Path:
    """Writes `index.html` into `folder`, linking figures (and tables, where they lie there) by
    relative paths; returns its path. BikepedError names a file that cannot be written."""
    found = {r.name: r for r in results}
    sections = [
        ("verdict", "Verdict", verdict_html(found)),
        ("tested", "What was tested", tested_html(found, provenance)),
        ("figures", "Figures", _figures(folder, figures)),
        ("tables", "Tables", _tables(folder, results)),
        ("risks", "Residual risks", risks_html(found, provenance)),
        ("provenance", "Provenance", definitions_html(provenance)),
        ("contest", "Run it again, or contest it", _rerun(provenance)),
    ]
    links = "".join(f'<li><a href="#{key}">{escape(name)}</a></li>' for key, name, _ in sections)
    body = "\n".join(
        f'<section id="{key}"><h2>{escape(name)}</h2>\n{content}</section>'
        for key, name, content in sections
    )
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width,initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>Conformance report</title>\n<style>{_CSS}</style>\n</head>\n<body>\n"
        "<header><h1>Does the crossing warn in time?</h1>\n"
        "<p>Conformance report of a bikeped warning light: its decision rule, run through scripted "
        "encounters of cyclists and pedestrians.</p></header>\n"
        f'<nav aria-label="Sections"><ul>{links}</ul></nav>\n<main>\n{body}\n</main>\n'
        "</body>\n</html>\n"
    )
    path = folder / "index.html"
    write_whole(path, page)
    return path


def verdict_html(found: Mapping[str, ExperimentResult]) -> str:
    """The gates of the configuration in force, in one sentence and a table."""
    name, figures = _judged(found)
    if figures is None:
        return "<p>Nothing was measured, so there is no verdict on the gates.</p>\n"
    gates = check_gate_figures(figures)
    holds = all_hold(gates)
    failed = " and ".join(g.name.lower() for g in gates if not g.holds)
    text = (
        "passes all gates. It may be promoted to a pole, within the limits below."
        if holds
        else f"fails: {failed}. It may not be promoted to a pole."
    )
    rows = "".join(
        f"<tr><td>{escape(g.name)}</td><td class=n>{escape(g.rule)}</td>"
        f"<td class=n>{escape(g.format_value(g.measured))}</td>"
        f"<td class={'yes' if g.holds else 'no'}>{'holds' if g.holds else 'fails'}</td></tr>"
        for g in gates
    )
    return (
        f'<p class="verdict{"" if holds else " bad"}">The configuration '
        f"<b>{escape(name)}</b> {escape(text)}</p>\n"
        "<table><thead><tr><th>Gate</th><th class=n>Required</th><th class=n>Measured</th>"
        f"<th>Verdict</th></tr></thead><tbody>{rows}</tbody></table>\n"
        "<p class=note>Sensitivity: share of the moments of danger, in which a warning can still "
        "help, that had an alert. Specificity: share of the moments without danger that had none. "
        "Warning budget: time from the alert to the closest approach. The gates are provisional "
        "design targets, not acceptance criteria of a field test.</p>\n"
    )


def _judged(found: Mapping[str, ExperimentResult]) -> tuple[str, Mapping[str, Any] | None]:
    """The configuration in force, as the table of scenarios measured it; else the paper's."""
    run = found.get("run")
    if run is not None and run.data.get("metrics"):
        rows = {row["scenario"]: row for row in run.data.get("scenarios", ())}
        return "in force", {**run.data["metrics"], "by_scenario": rows}
    result = found.get("compare")
    configurations = result.data.get("configurations", {}) if result is not None else {}
    name = next((n for n in _JUDGED if n in configurations), next(iter(configurations), ""))
    return name, configurations.get(name)


def tested_html(found: Mapping[str, ExperimentResult], provenance: Mapping[str, str]) -> str:
    """What went through the simulation, and what did not."""
    data = found["compare"].data if "compare" in found else {}
    count = data.get("scenarios", provenance.get("scenarios", "a set of"))
    camera = data.get("camera", {})
    where = ""
    if camera:
        where = (
            f" The camera hangs {float(camera['height_m']):.2f} m high with a pitch of "
            f"{float(camera['pitch_deg']):g}° and sees {float(camera['fov_deg']):.1f}°."
        )
    return (
        f"<p>{escape(str(count))} scripted encounters went through the tracker and the decision "
        "rule of the pole, with the errors that its camera makes in placing people."
        f"{escape(where)} The scripts are conformance cases that name kinds of encounter; they are "
        "not a sample of traffic, and no percentage here is a percentage of real encounters.</p>\n"
        "<p>Not tested are the light, the sound, and whether people heed them; the detector itself "
        "appears only through its measured recall.</p>\n"
    )


def _figures(folder: Path, figures: Sequence[Path]) -> str:
    """Each picture once, with two sentences and a link to its PDF."""
    stems = list(dict.fromkeys(p.with_suffix("") for p in figures))
    order = list(FIGURES)
    stems.sort(key=lambda p: order.index(p.name) if p.name in FIGURES else len(order))
    parts = []
    for stem in stems:
        text = FIGURES.get(stem.name)
        title = text.title if text is not None else stem.name.replace("-", " ").replace("_", " ")
        said = text.explained if text is not None else ""
        files = {p.suffix: p for p in figures if p.with_suffix("") == stem}
        picture = files.get(".png", files.get(".svg"))
        image = ""
        if picture is not None:
            image = f'<img src="{_href(folder, picture)}" alt="{escape(title)}" loading="lazy">'
        links = ", ".join(
            f'<a href="{_href(folder, p)}">{escape(p.suffix[1:].upper())}</a>'
            for p in files.values()
        )
        parts.append(
            f"<figure><h3>{escape(title)}</h3>{image}<figcaption>{escape(said)} "
            f"<span class=note>{links}</span></figcaption></figure>\n"
        )
    return "".join(parts) or "<p>No figures were drawn.</p>\n"


def _tables(folder: Path, results: Iterable[ExperimentResult]) -> str:
    parts = []
    for result in results:
        for table in result.tables:
            file = next(
                (p for p in _places(folder, table.name) if p.is_file()),
                None,
            )
            link = f' <a href="{_href(folder, file)}">CSV</a>' if file is not None else ""
            parts.append(table_html(table, link))
    return "".join(parts) or "<p>No tables.</p>\n"


def _places(folder: Path, name: str) -> list[Path]:
    """Where a table's CSV may lie beside the page."""
    file = f"{name}.csv"
    return [folder / file, folder / "tables" / file]


def table_html(table: ResultTable, link: str = "") -> str:
    """A table with its caption and note; `link` is HTML behind the caption."""
    columns = [[row[i] for row in table.rows] for i in range(len(table.columns))]
    texts = [_column(cells) for cells in columns]
    mark = [
        " class=n" if any(map(_is_number, cells)) and all(map(_numberish, cells)) else ""
        for cells in columns
    ]
    head = "".join(f"<th{m}>{escape(c)}</th>" for m, c in zip(mark, table.columns, strict=True))
    rows = "".join(
        "<tr>"
        + "".join(f"<td{m}>{escape(column[r])}</td>" for m, column in zip(mark, texts, strict=True))
        + "</tr>"
        for r in range(len(table.rows))
    )
    note = f"<p class=note>{escape(table.note)}</p>\n" if table.note else ""
    return (
        f'<div class=scroll tabindex=0 role=region aria-label="{escape(table.title)}">'
        f"<table><caption>{escape(table.title)}{link}</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>\n{note}"
    )


def risks_html(found: Mapping[str, ExperimentResult], provenance: Mapping[str, str]) -> str:
    """The residual-risk register of what was measured."""
    _, figures = _judged(found)
    by_scenario = (figures or {}).get("by_scenario", {})
    register = register_from_figures(by_scenario, {}, provenance.get("suite_hash", ""))
    hazards, scenarios = register.tables()
    intro = (
        "<p>What the system does not or only partly answer. Field-blocking: more evidence is "
        "needed before it runs unsupervised; monitor: collect data in the field.</p>\n"
    )
    parts = [intro, table_html(hazards)]
    if by_scenario:
        # The hazard classes are in the scenario files, which this page does not have.
        columns = [i for i, c in enumerate(scenarios.columns) if c != "Hazard"]
        parts.append(
            table_html(
                ResultTable(
                    scenarios.name,
                    scenarios.title,
                    tuple(scenarios.columns[i] for i in columns),
                    [tuple(row[i] for i in columns) for row in scenarios.rows],
                    scenarios.note,
                )
            )
        )
    return "".join(parts)


def definitions_html(items: Mapping[str, str]) -> str:
    """Names and values, e.g. hashes."""
    rows = "".join(
        f"<dt>{escape(str(k).replace('_', ' '))}</dt><dd><code>{escape(str(v))}</code></dd>"
        for k, v in items.items()
    )
    return f"<dl>{rows}</dl>\n<p class=note>The same hashes mean the same inputs.</p>\n"


def _rerun(provenance: Mapping[str, str]) -> str:
    command = provenance.get("command", "bikeped conformance reproduce")
    return (
        "<p>Everything here can be made again on any computer, without a camera:</p>\n"
        f"<pre>{escape(command)}</pre>\n"
        "<p>Who thinks that a case is missing, that a parameter is wrong, or that danger should be "
        "defined otherwise, can say so with a file or a number, and see what it changes:</p>\n"
        "<pre>bikeped conformance contest --scenario my-crossing.yaml\n"
        "bikeped conformance contest --set decision.d_max_m=15\n"
        "bikeped conformance contest --truth cpa_radius_m=7\n"
        "bikeped conformance contest --bound d_max_m=..20</pre>\n"
        "<p>Each prints the figures before and after, and the line with which anybody else gets "
        "the same.</p>\n"
    )


def _href(folder: Path, path: Path) -> str:
    """A relative link that stays valid when the folder is moved."""
    relative = os.path.relpath(path, folder)
    return escape(quote(PurePosixPath(Path(relative).as_posix()).as_posix()))


def _is_number(cell: CellValue) -> bool:
    """Numbers, and texts that are written numbers: they stand on the right."""
    if isinstance(cell, str):
        return cell.replace(".", "", 1).removeprefix("-").isdecimal()
    return isinstance(cell, (int, float)) and not isinstance(cell, bool)


def _numberish(cell: CellValue) -> bool:
    return cell is None or cell == "" or _is_number(cell)


def _column(cells: Sequence[CellValue]) -> list[str]:
    """The texts of a column: its fractions with equally many decimals, so that points align."""
    shown = [f"{c:.6g}" for c in cells if isinstance(c, float)]
    decimals = max((len(t.partition(".")[2]) for t in shown if "e" not in t), default=0)
    return [
        "–" if c is None else f"{c:.{decimals}f}" if isinstance(c, float) else str(c) for c in cells
    ]
