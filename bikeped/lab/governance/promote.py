"""Writing a decision section into config.yaml, with its provenance, and touching nothing else."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import msgspec
import yaml

from bikeped import __version__
from bikeped.config import DecisionConfig, LoadedConfig, config_hash, parse_config
from bikeped.config.provenance import (
    DECIDING_CODE,
    MEASURING_CODE,
    camera_hash,
    code_hash,
    decision_hash,
    provenance_path,
)
from bikeped.errors import BikepedError, ConfigError
from bikeped.files import write_like
from bikeped.lab.governance.gates import check_gates
from bikeped.lab.simulation.metrics import Metrics
from bikeped.lab.simulation.suite import Suite, camera_json


@dataclass(frozen=True)
class Promoted:
    """The files of a promotion."""

    config: Path
    backup: Path
    provenance: Path


def provenance_record(
    suite: Suite,
    decision: DecisionConfig,
    metrics: Metrics,
    loaded: LoadedConfig,
    files: Sequence[tuple[str, Path]] = (),
) -> dict[str, Any]:
    """Everything that a promotion rests on: suite, optimiser trace, calibration, code, figures.

    `files` are further files to name by their hash: `candidate`, `trace`.
    """
    after = msgspec.structs.replace(loaded.config, decision=decision)
    return {
        "format": 1,
        "promoted_at": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "decision": msgspec.to_builtins(decision),
        "decision_hash": decision_hash(decision),
        "decision_hash_before": decision_hash(loaded.config.decision),
        "config_hash": config_hash(after, loaded.calibration_hash),
        "calibration_hash": loaded.calibration_hash,
        "camera_hash": camera_hash(loaded),
        "camera": camera_json(suite),
        "suite_hash": suite.hash,
        "scenarios": len(suite.scenarios),
        "scenario_names": list(suite.names),
        "truth": {
            key: getattr(suite.truth_settings, key)
            for key in ("cpa_radius_m", "stopping_margin", "ttc_bound_s", "braking")
        },
        "version": __version__,
        "code_hash": code_hash(DECIDING_CODE),
        "measuring_code_hash": code_hash((*DECIDING_CODE, *MEASURING_CODE)),
        "metrics": metrics.as_dict(),
        "gates": [gate.as_dict() for gate in check_gates(metrics)],
        "files": {role: {"name": path.name, "sha256": file_hash(path)} for role, path in files},
    }


def promote(
    config_path: Path, loaded: LoadedConfig, decision: DecisionConfig, record: dict[str, Any]
) -> Promoted:
    """Replaces the decision section of `config_path`; the caller has seen that all gates hold.

    The file before it stays as `<name>.bak`. Each file appears whole or not at all, config.yaml
    last: whatever ends this early leaves a pole that says that section and provenance differ.
    """
    failed = [gate["name"] for gate in record["gates"] if not gate["holds"]]
    if failed:
        raise BikepedError(
            f"{config_path}: not promoted, for gates do not hold: {', '.join(failed)}"
        )
    target = config_path.resolve()  # a link to the file stays a link
    before = _read(target)
    note = f"promoted {record['promoted_at'][:10]}, see {provenance_path(target).name}"
    after = replace_section(before, str(config_path), decision, note)
    _compare(before, after, config_path, loaded, decision)
    files = Promoted(target, target.with_name(target.name + ".bak"), provenance_path(target))
    write_like(files.backup, before.encode(), target)
    write_like(files.provenance, msgspec.json.format(msgspec.json.encode(record)) + b"\n", target)
    write_like(files.config, after.encode(), target)
    return files


def replace_section(text: str, source: str, decision: DecisionConfig, note: str) -> str:
    """`text` with its decision section replaced, or with one added at its end.

    Everything before and after the section stays as it is, to the character. The section is what
    its own lines hold: comments in it go with it, for they speak of the values that go.
    """
    newline = "\r\n" if "\r\n" in text else "\n"
    start, end, indent = _span(text, source)
    lines = [f"decision:  # {note}"]
    for key, value in msgspec.to_builtins(decision).items():
        lines.append(f"  {key}: {yaml.safe_dump(value).splitlines()[0]}")
    # The text before the section already ends with the first line's indentation.
    block = (newline + indent).join(lines)
    before, after = text[:start], text[end:]
    if start == end:  # there was none
        gap = "" if not before else newline if before.endswith("\n") else 2 * newline
        return before + gap + indent + block + newline + after
    return before + block + (newline if text[end - 1 : end] == "\n" else "") + after


def file_hash(path: Path) -> str:
    """SHA-256 of a file; BikepedError names it when it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise BikepedError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def _span(text: str, source: str) -> tuple[int, int, str]:
    """First and one past the last character of the decision section, and its indentation."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if root is None:
        return len(text), len(text), ""
    if not isinstance(root, yaml.MappingNode) or root.flow_style:
        raise ConfigError(
            f"{source}: is written with braces; write one section below the other to promote into"
        )
    indent = ""
    for key, value in root.value:
        start = key.start_mark.index
        indent = text[text.rfind("\n", 0, start) + 1 : start].lstrip("\ufeff")
        if key.value != "decision":
            continue
        end = _content_end(value)
        if text[end - 1] != "\n":
            end = _line_end(text, end)
        # Comments that are indented like the section's keys are the section's.
        while True:
            line = text[end : _line_end(text, end)]
            inside = len(line) - len(line.lstrip()) > len(indent)
            if not (line.lstrip().startswith("#") and inside):
                return start, end, indent
            end += len(line)
    return len(text), len(text), indent if indent.isspace() else ""


def _content_end(node: yaml.Node) -> int:
    """One past a node's last own character; the mark of a block ends at the next key instead."""
    if isinstance(node, yaml.MappingNode) and not node.flow_style and node.value:
        return _content_end(node.value[-1][1])
    if isinstance(node, yaml.SequenceNode) and not node.flow_style and node.value:
        return _content_end(node.value[-1])
    return int(node.end_mark.index)


def _line_end(text: str, index: int) -> int:
    """One past the line's newline, or the text's end."""
    found = text.find("\n", index)
    return len(text) if found < 0 else found + 1


def _compare(
    before: str, after: str, path: Path, loaded: LoadedConfig, decision: DecisionConfig
) -> None:
    """Reads the new text back: the decision is the candidate, and all else is as it was."""
    try:
        new = parse_config(after, str(path), path.parent).config
        old_data, new_data = yaml.safe_load(before) or {}, yaml.safe_load(after)
    except (ConfigError, yaml.YAMLError):
        same = False
    else:
        old_data.pop("decision", None)
        new_data.pop("decision", None)
        expected = msgspec.structs.replace(loaded.config, decision=decision)
        same = new == expected and old_data == new_data
    if not same:
        raise ConfigError(
            f"{path}: its decision section cannot be replaced without touching the rest, so "
            "nothing was written; give decision: its own lines"
        )


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror}); give it with -c") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text; save it as UTF-8") from error
