"""The HTML report in one file: playback of every scenario, figures, gates and residual risks.

It needs no network and no server: style sheets, scripts and data are inline, and its content
security policy allows nothing else. The playback runs the test bench's scripts; gates, tables and
risks are plain HTML, for printing and for browsers without scripts.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
from markupsafe import Markup

from bikeped import __version__
from bikeped.config.load import LoadedConfig
from bikeped.config.provenance import DECIDING_CODE, MEASURING_CODE, code_hash
from bikeped.config.schema import DecisionConfig
from bikeped.lab.experiments.deterministic import compare_table, run_table
from bikeped.lab.experiments.report import (
    definitions_html,
    risks_html,
    table_html,
    tested_html,
    verdict_html,
)
from bikeped.lab.result_tables import ExperimentResult
from bikeped.lab.scenarios.scenario import Scenario
from bikeped.lab.testbench.comparison import encode_runs
from bikeped.lab.testbench.pages import configurations
from bikeped.lab.testbench.playback import coverage, playback
from bikeped.lab.testbench.runner import BenchRunner, BenchSuite
from bikeped.lab.testbench.settings import settings_in_force
from bikeped.templates import render
from bikeped.web.server import WEB_FOLDER

FOLDERS = (Path(__file__).parent, WEB_FOLDER)  #: with `static/` and `templates/`, own ones first
#: In the order of their imports.
_SCRIPTS = (
    "ui.js",
    "canvas.js",
    "testbench-words.js",
    "testbench-timeline.js",
    "testbench-plan.js",
    "testbench-flow.js",
    "testbench-player.js",
    "report.js",
)
_STYLES = ("app.css", "testbench.css", "report.css")
#: Digits of positions in the file: centimetres.
_DIGITS = 2


def render_report(
    loaded: LoadedConfig,
    scenarios: Sequence[Scenario],
    command: str,
    progress: Callable[[int], None] = lambda done: None,
) -> str:
    """The report on the configuration in force.

    `command` is the command line that repeats it; `progress` gets the number of finished scenarios.
    """
    work = BenchRunner(loaded, scenarios)
    suite = work.full_suite(settings_in_force(loaded))
    named = configurations(loaded)
    decision = loaded.config.decision
    found = {"run": run_table(suite, decision), "compare": compare_table(suite, loaded, named)}
    name = next(n for n, d in named.items() if d == decision)
    plays = []
    for index in range(len(suite.scenarios)):
        plays.append(_play(suite, index, name, named))
        progress(index + 1)
    data = {
        "plays": plays,
        "cameras": [coverage(suite.camera, pose) for pose in suite.poses],
        "strips": [_strip(suite, i, play) for i, play in enumerate(plays)],
        "in_force": name,
    }
    return _page(found, data, suite, loaded, command)


def _static(name: str) -> str:
    """A script or style sheet of the test bench, or one that all pages share."""
    files = (folder / "static" / name for folder in FOLDERS)
    return next(file for file in files if file.is_file()).read_text(encoding="utf-8")


def _play(
    suite: BenchSuite, index: int, name: str, named: Mapping[str, DecisionConfig]
) -> dict[str, Any]:
    """A playback with all numbers of the configuration in force, and the others' states."""
    others = {n: d for n, d in named.items() if n != name}
    play = playback(suite, index, {name: named[name], **others})
    for side in play["sides"][1:]:
        for key in ("sentence", "chosen", "pairs", "pedestrians", "since_cyclist_s", "remembered"):
            del side[key]
        side["state"] = encode_runs(side["state"])
    for agent in play["agents"]:
        for key in ("true", "detected", "heading"):
            agent[key] = _round(agent[key])
        agent["missed"] = encode_runs(agent["missed"])
    play["tracks"]["xy"] = _round(play["tracks"]["xy"])
    del play["truth"]["severity"]
    return play


def _round(values: list[float | None]) -> list[float | None]:
    return [None if v is None else round(v, _DIGITS) for v in values]


def _strip(suite: BenchSuite, index: int, play: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "name": suite.scenarios[index].name,
        "hazard": suite.scenarios[index].hazard,
        "frames": play["frames"],
        "truth": encode_runs(play["truth"]["tier"]),
        "before": None,
        "after": encode_runs(play["sides"][0]["state"]),
    }


def _page(
    found: Mapping[str, ExperimentResult],
    data: Mapping[str, Any],
    suite: BenchSuite,
    loaded: LoadedConfig,
    command: str,
) -> str:
    provenance = {
        "version": __version__,
        "deciding_code": code_hash(DECIDING_CODE),
        "measuring_code": code_hash(MEASURING_CODE),
        "suite_hash": suite.hash,
        "config_hash": loaded.hash,
        "calibration_hash": str(loaded.calibration_hash),
        "command": command,
    }
    style, theme, script = inline_files(_STYLES, _SCRIPTS)
    # "<" could end the script element; \\u003c is the same JSON.
    data_json = msgspec.json.encode(data).decode().replace("<", "\\u003c")
    return render(
        "report.html",
        *(folder / "templates" for folder in FOLDERS),
        version=__version__,
        policy=page_policy(style, theme, script),
        style=Markup(style),
        theme=Markup(theme),
        script=Markup(script),
        data=Markup(data_json),
        verdict=verdict_html(found),
        tested=tested_html(found, provenance),
        tables=Markup("").join(table_html(t) for result in found.values() for t in result.tables),
        risks=risks_html(found, provenance),
        provenance=definitions_html(provenance),
        command=command,
        decision=json.dumps(msgspec.to_builtins(loaded.config.decision)),
    )


def inline_files(styles: Sequence[str], scripts: Sequence[str]) -> tuple[str, str, str]:
    """The style sheets, the script of the theme, and the scripts in one, for a page in one file."""
    style = "\n".join(map(_static, styles))
    return style, _static("theme.js"), bundle({name: _static(name) for name in scripts})


def page_policy(style: str, theme: str, script: str) -> str:
    """A content security policy that allows these inline texts, and nothing else."""
    return (
        "default-src 'none'; img-src data:; base-uri 'none'; form-action 'none'; "
        f"style-src {_hash(style)}; script-src {_hash(theme)} {_hash(script)}"
    )


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


_IMPORT = re.compile(r'^import (\{[^}]*\}) from "/static/([\w.-]+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?(?:const|let|function|class)) ([\w$]+)", re.MULTILINE)


def bundle(modules: Mapping[str, str]) -> str:
    """JavaScript modules as one script, because a page opened from the disk cannot import files.

    Each module becomes a function that returns its exports; `modules` by name, in import order.
    Supports `import {a, b} from "/static/x.js";` and `export const|let|function|class name`;
    ValueError for other forms.
    """
    parts = ['"use strict";', "const modules = {};"]
    for name, text in modules.items():
        exported = [found[2] for found in _EXPORT.finditer(text)]
        text = _IMPORT.sub(lambda found: f'const {found[1]} = modules["{found[2]}"];', text)
        text = _EXPORT.sub(lambda found: f"{found[1]} {found[2]}", text)
        if re.search(r"^(?:import|export)\b", text, re.MULTILINE) or "</" in text:
            raise ValueError(
                f"{name}: holds an import, export or closing tag that cannot be inlined"
            )
        parts.append(
            f'modules["{name}"] = (() => {{\n{text}\nreturn {{ {", ".join(exported)} }};\n}})();'
        )
    return "\n".join(parts)
