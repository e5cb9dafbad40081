"""The deployment gates (definitions, section 10; paper, section 4), and promotion of a decision.

Provisional design targets, as the paper says: they reject configurations that fail by design, and
say nothing about rain, darkness or real people.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

import msgspec

from bikeped import __version__
from bikeped.config.edit import completed, replace_section, set_values
from bikeped.config.load import LoadedConfig, config_hash, parse_config
from bikeped.config.provenance import (
    DECIDING_CODE,
    MEASURING_CODE,
    code_hash,
    decision_hash,
    provenance_path,
    setting_hashes,
)
from bikeped.config.schema import DecisionConfig
from bikeped.config.strict_yaml import read_text
from bikeped.errors import BikepedError, ConfigError
from bikeped.files import write_like
from bikeped.lab.simulation.metrics import Metrics, finite_or_none
from bikeped.lab.simulation.suite import Suite, camera_json
from bikeped.lab.simulation.truth import PEDESTRIAN_PRT_S
from bikeped.models import BUNDLED, model_file, model_sha256

SENSITIVITY_MIN = 0.90
SPECIFICITY_MIN = 0.90
#: The mean warning budget must exceed the distracted pedestrian's reaction time, s.
BUDGET_ABOVE_S = PEDESTRIAN_PRT_S


@dataclass(frozen=True)
class Gate:
    """One gate: `measured` is NaN where there was nothing to measure, and then it does not hold.

    `strict`: the measured figure must exceed `required`, not only reach it; `at_most`: it must not
    exceed it. `unit` is `%` (the figures are shares), `s` or `x` (a ratio). `kind`: one of the
    paper's gates, or of nuisance (`lab.governance.nuisance`).
    """

    name: str
    required: float
    strict: bool
    unit: str
    measured: float
    holds: bool
    kind: Literal["paper", "nuisance"] = "paper"
    at_most: bool = False

    def format_value(self, value: float) -> str:
        """A value in the gate's unit; one that fails never reads like one that holds.

        89.96 % must not read 90.0 % beside a gate of 90 %.
        """
        if not math.isfinite(value):
            return "nothing to measure"
        scale, digits = (100.0, 1) if self.unit == "%" else (1.0, 2)
        rounded = round(value * scale, digits)
        required = round(self.required * scale, digits)
        while value < self.required and rounded >= required and not self.at_most:
            digits += 1
            rounded = math.floor(value * scale * 10**digits) / 10**digits
        while self.at_most and value > self.required and rounded <= required:
            digits += 1
            rounded = math.ceil(value * scale * 10**digits) / 10**digits
        return f"{rounded:.{digits}f} {self.unit}"

    @property
    def rule(self) -> str:
        """The requirement in words."""
        relation = "at most" if self.at_most else "above" if self.strict else "at least"
        return f"{relation} {self.format_value(self.required)}"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**vars(self), "measured": finite_or_none(self.measured)}


def check_gates(metrics: Metrics) -> list[Gate]:
    """All gates of a suite's metrics.

    Sensitivity counts the actionable frames of all scenarios together, as the definition has it.
    """
    return check_gate_figures(metrics.as_dict())


def check_gate_figures(figures: Mapping[str, Any]) -> list[Gate]:
    """As `check_gates`, from the JSON of metrics (null: nothing was measured)."""

    def gate(name: str, key: str, required: float, unit: str, strict: bool = False) -> Gate:
        value = figures.get(key)
        measured = math.nan if value is None else float(value)
        holds = measured > required if strict else measured >= required
        return Gate(name, required, strict, unit, measured, holds)

    return [
        gate("Sensitivity over actionable frames", "sensitivity", SENSITIVITY_MIN, "%"),
        gate("Specificity", "specificity", SPECIFICITY_MIN, "%"),
        gate("Mean warning budget", "mean_warning_budget_s", BUDGET_ABOVE_S, "s", strict=True),
    ]


def all_hold(gates: Sequence[Gate]) -> bool:
    """Whether a configuration may be promoted."""
    return all(gate.holds for gate in gates)


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
    gates: Sequence[Gate],
    loaded: LoadedConfig,
    files: Sequence[tuple[str, Path]] = (),
) -> dict[str, Any]:
    """Everything that a promotion rests on: suite, settings, calibration, code, figures.

    `files` are further files to name by their hash: `candidate`, `trace`.
    """
    after = replace(loaded, config=msgspec.structs.replace(loaded.config, decision=decision))
    return {
        "format": 1,
        "promoted_at": datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "decision": msgspec.to_builtins(decision),
        **setting_hashes(after),
        "decision_hash_before": decision_hash(loaded.config.decision),
        "config_hash": config_hash(after.config, loaded.calibration_hash),
        "calibration_hash": loaded.calibration_hash,
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
        "gates": [gate.as_dict() for gate in gates],
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
    before = read_text(target, "give it with -c")
    note = f"promoted {record['promoted_at'][:10]}, see {provenance_path(target).name}"
    values = msgspec.to_builtins(decision)
    after = completed(replace_section(before, "decision", values, str(config_path), note))
    wanted = msgspec.structs.replace(loaded.config, decision=decision, complete=True)
    detection = loaded.config.detection
    model = None if detection.model is None else model_file(detection.model, loaded.base_dir)
    # The bundled one is always checked; one that is not on this machine cannot be pinned here.
    if detection.model != BUNDLED and detection.sha256 is None and model and model.is_file():
        pinned = {"sha256": model_sha256(model)}
        after = set_values(after, {"detection": pinned}, str(config_path))
        detection = msgspec.structs.replace(detection, **pinned)
        wanted = msgspec.structs.replace(wanted, detection=detection)
    if parse_config(after, str(config_path), config_path.parent).config != wanted:
        raise ConfigError(
            f"{config_path}: the file changed while the gates were checked, so nothing was "
            "written; promote again"
        )
    files = Promoted(target, target.with_name(target.name + ".bak"), provenance_path(target))
    write_like(files.backup, before.encode(), target)
    write_like(files.provenance, msgspec.json.format(msgspec.json.encode(record)) + b"\n", target)
    write_like(files.config, after.encode(), target)
    return files


def file_hash(path: Path) -> str:
    """SHA-256 of a file; BikepedError names it when it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise BikepedError(f"{path}: cannot be read ({error.strerror}); check the path") from error
