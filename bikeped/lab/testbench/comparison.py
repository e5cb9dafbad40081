"""The whole suite before and after changed settings, and the commands that compute it again.

Before is the configuration in force on the suite as it is; after is the changed settings. The
comparison is that of `governance.what_if`. Where `bikeped conformance contest` has options for all
changes, its command line is given too, and yields the same numbers.
"""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from bikeped import __version__
from bikeped.config.load import LoadedConfig
from bikeped.config.provenance import DECIDING_CODE, MEASURING_CODE, code_hash
from bikeped.decision.episodes import runs
from bikeped.lab.governance.gates import check_gates
from bikeped.lab.governance.what_if import Comparison, Variant, compare_variants
from bikeped.lab.testbench.playback import danger_tier
from bikeped.lab.testbench.runner import BenchRunner
from bikeped.lab.testbench.settings import (
    VIEW_KEYS,
    BenchSettings,
    differing_keys,
    settings_in_force,
    settings_to_file,
    settings_to_link,
    value_text,
)


@dataclass(frozen=True)
class InvocationOptions:
    """The options that the test bench was started with, for command lines that repeat it."""

    config: Path | None = None
    scenarios: Path | None = None
    overrides: tuple[str, ...] = ()

    def command_line(self, *words: str) -> str:
        """`bikeped` with these words and the options, quoted for a shell."""
        options = ["-c", str(self.config)] if self.config is not None else []
        options += ["--scenarios", str(self.scenarios)] if self.scenarios is not None else []
        options += [word for item in self.overrides for word in ("--set", item)]
        return shlex.join(["bikeped", *words, *options])


def compare_settings(work: BenchRunner, bench: BenchSettings) -> Comparison:
    """The suite under the configuration in force and under `bench`."""
    base = settings_in_force(work.loaded)
    before = work.full_suite(base)
    changed = msgspec.structs.replace(bench, decision=base.decision, scenario="", beside=())
    after = before if changed == base else work.full_suite(bench)  # a decision needs no new run
    return compare_variants(before, base.decision, after, bench.decision)


def comparison_json(
    work: BenchRunner, bench: BenchSettings, origin: InvocationOptions
) -> dict[str, Any]:
    """The comparison for the page: figures, gates in words, strips, and how to repeat it."""
    comparison = compare_settings(work, bench)
    data = comparison.as_dict()
    for key, side in (("before", comparison.before), ("after", comparison.after)):
        for row, gate in zip(data[key]["gates"], check_gates(side.metrics), strict=True):
            row["rule"], row["shown"] = gate.rule, gate.format_value(gate.measured)
    base = settings_in_force(work.loaded)
    return {
        **data,
        "strips": [_strip(comparison, name) for name in comparison.after.suite.names],
        "link": settings_to_link(bench, base),
        "changes": list_changes(bench, base),
        "command": contest_command(bench, base, origin),
        "again": origin.command_line("testbench", "contest", "challenge.json"),
        "file": settings_to_file(bench, base, code_and_config_hashes(work.loaded)),
    }


def code_and_config_hashes(loaded: LoadedConfig) -> dict[str, str | None]:
    """What the figures were computed with; the same hashes give the same figures."""
    return {
        "version": __version__,
        "rule_hash": code_hash(DECIDING_CODE),
        "measuring_hash": code_hash(MEASURING_CODE),
        "config_hash": loaded.hash,
        "calibration_hash": loaded.calibration_hash,
    }


def list_changes(bench: BenchSettings, base: BenchSettings) -> list[dict[str, Any]]:
    """The settings that differ from the configuration in force: key, before, after."""
    changes = [
        {"key": key, "before": before, "after": after}
        for key, before, after in differing_keys(bench, base)
        if key != "scripts" and key not in VIEW_KEYS
    ]
    if bench.scripts:
        changes.append({"key": "own scenarios", "before": 0, "after": len(bench.scripts)})
    return changes


#: Settings of the bench that `bikeped conformance contest` has options for.
_CONTEST_KEYS = ("decision.", "danger.", "camera.height_m", "camera.pitch_deg", "camera.fov_deg")


def contest_command(
    bench: BenchSettings, base: BenchSettings, origin: InvocationOptions
) -> str | None:
    """The `bikeped conformance contest` that computes the same; None where it has no option.

    It has the configuration's keys and the ground truth's thresholds. Misses, delay, the camera's
    position and drawn scenarios need `bikeped testbench contest` with the file or the link. With
    `--set` at the start, the overrides would count as changes.
    """
    changes = list_changes(bench, base)
    supported = all(change["key"].startswith(_CONTEST_KEYS) for change in changes)
    if not changes or not supported or origin.overrides:
        return None
    words = []
    for change in changes:
        section, _, name = change["key"].partition(".")
        truth = section == "danger"
        words += ["--truth", f"{name}="] if truth else ["--set", f"{change['key']}="]
        words[-1] += value_text(change["after"])
    return f"{origin.command_line('conformance', 'contest')} {shlex.join(words)}"


def _strip(comparison: Comparison, name: str) -> dict[str, Any]:
    """States and truth of one scenario as runs of equal frames, before and after."""
    suite = comparison.after.suite
    index = suite.names.index(name)
    truth = suite.truths[index]
    return {
        "name": name,
        "hazard": suite.scenarios[index].hazard,
        "frames": len(truth.time_s),
        "truth": encode_runs(danger_tier(truth)),
        "before": _states(comparison.before, name),
        "after": _states(comparison.after, name),
    }


def _states(side: Variant, name: str) -> list[list[int]] | None:
    return encode_runs(side.states[side.part(name)]) if name in side.suite.names else None


def encode_runs(codes: Any) -> list[list[int]]:
    """[[code, frames], ...]: the runs of equal codes in `codes` [frames]."""
    return [[int(codes[start]), end - start] for start, end in runs(codes).tolist()]
