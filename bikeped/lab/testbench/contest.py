"""The whole suite under a challenge, before beside after, with what makes it again.

Before is the configuration in force on the suite as it is; after is the bench. The comparison is
`conformance.contest`'s; where `bikeped conformance contest` can say the same challenge, its command
line is told, and gives the same numbers.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from bikeped import __version__
from bikeped.config import LoadedConfig
from bikeped.config.provenance import DECIDING_CODE, MEASURING_CODE, code_hash
from bikeped.decision.episodes import runs
from bikeped.lab.governance.gates import check_gates
from bikeped.lab.governance.what_if import Comparison, Variant, compare_variants
from bikeped.lab.testbench.run import BenchRunner
from bikeped.lab.testbench.settings import (
    VIEW,
    BenchSettings,
    settings_in_force,
    settings_to_file,
    settings_to_link,
)


@dataclass(frozen=True)
class InvocationOptions:
    """Where the bench was started from: what a command line must repeat."""

    config: Path | None = None
    scenarios: Path | None = None
    overrides: tuple[str, ...] = ()

    def options(self) -> list[str]:
        words = ["-c", str(self.config)] if self.config is not None else []
        words += ["--scenarios", str(self.scenarios)] if self.scenarios is not None else []
        for item in self.overrides:
            words += ["--set", item]
        return words


def challenge(work: BenchRunner, bench: BenchSettings) -> Comparison:
    """Runs both sides."""
    before = work.whole(settings_in_force(work.loaded))
    after = before if _same_run(work, bench) else work.whole(bench)
    return compare_variants(before, work.loaded.config.decision, after, bench.decision)


def _same_run(work: BenchRunner, bench: BenchSettings) -> bool:
    base = settings_in_force(work.loaded)
    return msgspec.structs.replace(bench, decision=base.decision, scenario="", beside=()) == base


def comparison_json(
    work: BenchRunner, bench: BenchSettings, origin: InvocationOptions
) -> dict[str, Any]:
    """The contest for the page: figures, gates in words, strips, and how to repeat it."""
    found = challenge(work, bench)
    data = found.as_dict()
    for side, key in ((found.before, "before"), (found.after, "after")):
        for told, gate in zip(data[key]["gates"], check_gates(side.metrics), strict=True):
            told["rule"], told["shown"] = gate.rule, gate.format_value(gate.measured)
    data["strips"] = [_strip(found, name) for name in found.after.suite.names]
    base = settings_in_force(work.loaded)
    data["link"] = settings_to_link(bench, base)
    data["changes"] = changes(bench, base)
    data["command"] = command_line(bench, base, origin)
    again = ["bikeped", "testbench", "contest", "challenge.json", *origin.options()]
    data["again"] = shlex.join(again)
    data["file"] = settings_to_file(bench, base, facts(work.loaded))
    return data


def facts(loaded: LoadedConfig) -> dict[str, str | None]:
    """What a challenge was measured with; the same hashes give the same numbers."""
    return {
        "version": __version__,
        "rule_hash": code_hash(DECIDING_CODE),
        "measuring_hash": code_hash(MEASURING_CODE),
        "config_hash": loaded.hash,
        "calibration_hash": loaded.calibration_hash,
    }


def changes(bench: BenchSettings, base: BenchSettings) -> list[dict[str, Any]]:
    """What the bench sets otherwise than the configuration in force: key, before, after."""
    now, before = msgspec.to_builtins(bench), msgspec.to_builtins(base)
    found = []
    for key, value in now.items():
        if key == "scripts" or key in VIEW:
            continue
        if isinstance(value, dict) and isinstance(before[key], dict):
            found += [
                {"key": f"{key}.{k}", "before": before[key][k], "after": v}
                for k, v in value.items()
                if v != before[key][k]
            ]
        elif value != before[key]:
            found.append({"key": key, "before": before[key], "after": value})
    if bench.scripts:
        count = len(bench.scripts)
        found.append({"key": "own scenarios", "before": 0, "after": count})
    return found


def command_line(
    bench: BenchSettings, base: BenchSettings, origin: InvocationOptions
) -> str | None:
    """The `bikeped conformance contest` of this challenge; None where that command cannot say it.

    It knows the configuration's keys and the truth's thresholds. What the bench alone has (misses,
    delay, where the camera stands, own scenarios that are in no file) is repeated by
    `bikeped testbench contest` with the file or the link.
    """
    plain = msgspec.structs.replace
    said = plain(
        base,
        decision=bench.decision,
        danger=bench.danger,
        scenario=bench.scenario,
        beside=bench.beside,
        camera=plain(
            base.camera,
            height_m=bench.camera.height_m,
            pitch_deg=bench.camera.pitch_deg,
            fov_deg=bench.camera.fov_deg,
        ),
    )
    different = changes(bench, base)
    if said != bench or not different or origin.overrides:
        return None  # there, --set is what is contested
    words = ["bikeped", "conformance", "contest", *origin.options()]
    for change in different:
        section, _, name = change["key"].partition(".")
        value = change["after"]
        if section == "danger":
            words += ["--truth", f"{name}={_word(value)}"]
        else:
            words += ["--set", f"{change['key']}={_word(value)}"]
    return shlex.join(words)


def _word(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def _strip(found: Comparison, name: str) -> dict[str, Any]:
    """States and truth of one scenario as runs of equal frames, before and after."""
    index = found.after.suite.names.index(name)
    truth = found.after.suite.truths[index]
    return {
        "name": name,
        "hazard": found.after.suite.scenarios[index].hazard,
        "frames": len(truth.time_s),
        "truth": encode_runs(truth.danger.astype(int) + truth.imminent),
        "before": _states(found.before, name),
        "after": _states(found.after, name),
    }


def _states(side: Variant, name: str) -> list[list[int]] | None:
    return encode_runs(side.states[side.part(name)]) if name in side.suite.names else None


def encode_runs(codes: Any) -> list[list[int]]:
    """[[code, frames], ...] of equal neighbours."""
    return [[int(codes[a]), b - a] for a, b in runs(codes).tolist()]
