"""What-if comparison: other scenarios, parameters or thresholds, before and after.

So a decision can be contested without camera, detector or access to the pole (paper, section 4).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from bikeped.config.provenance import decision_hash
from bikeped.config.schema import DecisionConfig
from bikeped.decision.episodes import runs
from bikeped.errors import BikepedError, ScenarioError
from bikeped.lab.governance.gates import all_hold, check_gates
from bikeped.lab.scenarios.scenario import Scenario, dump_scenario
from bikeped.lab.simulation.metrics import Metrics, finite_or_none
from bikeped.lab.simulation.suite import Suite
from bikeped.lab.simulation.truth import BRAKING_PROFILES, GroundTruthSettings
from bikeped.types import BoolArray, State

_TRUTH_RANGE = {"cpa_radius_m": 25.0, "stopping_margin": 10.0, "ttc_bound_s": 60.0}


@dataclass(frozen=True)
class Variant:
    """One side of the comparison: a suite, a decision, and their results."""

    suite: Suite
    decision: DecisionConfig
    states: npt.NDArray[np.int8]
    metrics: Metrics

    @staticmethod
    def of(suite: Suite, decision: DecisionConfig) -> Variant:
        return Variant(suite, decision, suite.states(decision), suite.measure(decision))

    def part(self, name: str) -> slice:
        """Where a scenario's frames lie in `states`."""
        return self.suite.rule_input.frame_slice(self.suite.names.index(name))

    def as_dict(self) -> dict[str, Any]:
        """Totals, gates and figures by scenario, for JSON."""
        return {
            "suite_hash": self.suite.hash,
            "scenarios": len(self.suite.scenarios),
            "decision": msgspec.to_builtins(self.decision),
            "decision_hash": decision_hash(self.decision),
            "truth": asdict(self.suite.truth_settings),
            "totals": self.metrics.as_dict(),
            "gates": [gate.as_dict() for gate in check_gates(self.metrics)],
            "promotable": all_hold(check_gates(self.metrics)),
            "by_scenario": {
                name: {"states": self._shares(name), **self.metrics.scenario_dict(i)}
                for i, name in enumerate(self.suite.names)
            },
        }

    def _shares(self, name: str) -> dict[str, float]:
        states = self.states[self.part(name)]
        return {s.name: float((states == int(s)).mean()) for s in State}


@dataclass(frozen=True)
class Comparison:
    """Before and after, and what changed between them."""

    before: Variant
    after: Variant
    changed: list[dict[str, Any]]

    def as_dict(self) -> dict[str, Any]:
        sides = {"before": self.before.as_dict(), "after": self.after.as_dict()}
        return {**sides, "changed": self.changed}


def compare_variants(
    before: Suite, decision: DecisionConfig, after: Suite, other: DecisionConfig
) -> Comparison:
    """Runs both sides and lists every scenario that is new or in which anything changed."""
    old, new = Variant.of(before, decision), Variant.of(after, other)
    scripts = {s.name: dump_scenario(s) for s in before.scenarios}
    changed = []
    for index, scenario in enumerate(after.scenarios):
        name = scenario.name
        if name not in scripts:
            what = "new scenario"
        elif scripts[name] != dump_scenario(scenario):
            what = "replaced scenario"
        else:
            entry = _differences(old, new, name, index)
            if entry["frames_state"] or entry["frames_truth"]:
                changed.append(entry)
            continue
        changed.append({"scenario": name, "what": what, "frames": len(after.truths[index].time_s)})
    return Comparison(old, new, changed)


def with_scenarios(suite: Suite, added: Sequence[Scenario]) -> Suite:
    """The suite with further scenarios; one replaces the scenario that has its name."""
    names = [s.name for s in added]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise ScenarioError(f"--scenario: {twice!r} is given twice; give each its own name")
    new = {s.name: s for s in added}
    kept = [new.pop(s.name, s) for s in suite.scenarios]
    return Suite(
        (*kept, *new.values()), suite.camera, suite.tracker, suite.pose, suite.truth_settings
    )


def parse_truth(settings: GroundTruthSettings, items: Sequence[str]) -> GroundTruthSettings:
    """`KEY=VALUE` items over ground-truth thresholds; BikepedError names the key and the remedy."""
    for item in items:
        key, equals, text = (part.strip() for part in item.partition("="))
        option = f"--truth {' '.join(item.split())}"
        if not equals:
            raise BikepedError(f"{option}: expected KEY=VALUE, e.g. --truth cpa_radius_m=7")
        if key == "braking":
            if text not in BRAKING_PROFILES:
                raise BikepedError(
                    f"{option}: unknown profile; use one of {', '.join(BRAKING_PROFILES)}"
                )
            settings = replace(settings, braking=text)
        elif key in _TRUTH_RANGE:
            value = _float(text, option)
            if not 0 < value <= _TRUTH_RANGE[key]:
                raise BikepedError(f"{option}: use a value above 0 to {_TRUTH_RANGE[key]:g}")
            # The keys are checked above, the values are numbers.
            settings = replace(settings, **{key: value})  # type: ignore[arg-type]
        else:
            known = ", ".join([*_TRUTH_RANGE, "braking"])
            raise BikepedError(f"{option}: unknown threshold; known are {known}")
    return settings


def apply_bounds(decision: DecisionConfig, items: Sequence[str]) -> DecisionConfig:
    """`KEY=LOW..HIGH` items: the decision with every key inside its bound.

    A value outside is moved to the nearest end (either end may be left open: `d_max_m=..15`).
    """
    for item in items:
        option = f"--bound {' '.join(item.split())}"
        match = re.fullmatch(r"\s*(?:decision\.)?(\w+)\s*=\s*(\S*?)\s*\.\.\s*(\S*?)\s*", item)
        if match is None or not (match[2] or match[3]):
            raise BikepedError(f"{option}: expected KEY=LOW..HIGH, e.g. --bound d_max_m=5..15")
        key = match[1]
        value = getattr(decision, key, None)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            numbers = [
                k for k, v in msgspec.to_builtins(decision).items() if type(v) in (int, float)
            ]
            raise BikepedError(
                f"{option}: not a number of the decision; known: {', '.join(numbers)}"
            )
        low = _float(match[2], option) if match[2] else -np.inf
        high = _float(match[3], option) if match[3] else np.inf
        if low > high:
            raise BikepedError(f"{option}: {low:g} is above {high:g}; exchange them")
        moved = min(max(value, low), high)
        if isinstance(value, int) and moved != value:
            moved = int(np.ceil(moved) if moved == low else np.floor(moved))
            if not low <= moved <= high:
                raise BikepedError(f"{option}: holds no whole number; widen it")
        data = {**msgspec.to_builtins(decision), key: moved}
        try:
            decision = msgspec.convert(data, DecisionConfig, strict=True)
        except msgspec.ValidationError as error:
            raise BikepedError(f"{option}: {error}; choose a bound that the key allows") from error
    if decision.d_min_m > decision.d_max_m:
        raise BikepedError(
            f"--bound: d_min_m {decision.d_min_m:g} comes to lie above d_max_m "
            f"{decision.d_max_m:g}; choose bounds that overlap"
        )
    return decision


def _differences(old: Variant, new: Variant, name: str, index: int) -> dict[str, Any]:
    """What differs in a scenario whose script is the same on both sides."""
    before, after = old.states[old.part(name)], new.states[new.part(name)]
    truth, truth_new = old.suite.truths[old.suite.names.index(name)], new.suite.truths[index]
    state = np.asarray(before != after)
    labels = (truth.danger != truth_new.danger) | (truth.actionable != truth_new.actionable)
    return {
        "scenario": name,
        "what": "states" if state.any() else "ground truth",
        "frames": len(before),
        "frames_state": int(state.sum()),
        "frames_truth": int(labels.sum()),
        "spans": _spans(truth.time_s, state, before, after),
    }


def _spans(
    time_s: npt.NDArray[np.float64],
    differs: BoolArray,
    before: npt.NDArray[np.int8],
    after: npt.NDArray[np.int8],
) -> list[dict[str, Any]]:
    """Runs of frames with the same change: from, to (s, both inclusive), state before and after."""
    code = np.where(differs, before.astype(np.int64) * 8 + after, -1)
    return [
        {
            "from_s": finite_or_none(round(float(time_s[a]), 4)),
            "to_s": finite_or_none(round(float(time_s[b - 1]), 4)),
            "before": State(int(before[a])).name,
            "after": State(int(after[a])).name,
        }
        for a, b in runs(code).tolist()
        if code[a] >= 0
    ]


def _float(text: str, option: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise BikepedError(f"{option}: {text!r} is not a number; write digits") from error
    if not np.isfinite(value):
        raise BikepedError(f"{option}: {text!r} is not a finite number; write digits")
    return value
