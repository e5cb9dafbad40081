"""The deployment gates (definitions, section 10; paper, section 4).

Provisional design targets, as the paper says: they reject configurations that fail by design, and
say nothing about rain, darkness or real people.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bikeped.lab.simulation.metrics import Metrics, finite_or_none
from bikeped.lab.simulation.truth import PEDESTRIAN_PRT_S

SENSITIVITY_MIN = 0.90
SPECIFICITY_MIN = 0.90
#: The mean warning budget must exceed the distracted pedestrian's reaction time, s.
BUDGET_ABOVE_S = PEDESTRIAN_PRT_S


@dataclass(frozen=True)
class Gate:
    """One gate: `measured` is NaN where there was nothing to measure, and then it does not hold.

    `strict`: the measured figure must exceed `required`, not only reach it. `unit` is `%` (the
    figures are shares) or `s`.
    """

    name: str
    required: float
    measured: float
    holds: bool
    unit: str
    strict: bool = False

    def format_value(self, value: float) -> str:
        """A value in the gate's unit; one that fails never reads like one that holds.

        89.96 % must not read 90.0 % beside a gate of 90 %.
        """
        if not math.isfinite(value):
            return "nothing to measure"
        scale, digits = (100.0, 1) if self.unit == "%" else (1.0, 2)
        rounded = round(value * scale, digits)
        while value < self.required and rounded >= round(self.required * scale, digits):
            digits += 1
            rounded = math.floor(value * scale * 10**digits) / 10**digits
        return f"{rounded:.{digits}f} {self.unit}"

    @property
    def rule(self) -> str:
        """The requirement in words."""
        return f"{'above' if self.strict else 'at least'} {self.format_value(self.required)}"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "name": self.name,
            "required": self.required,
            "strict": self.strict,
            "unit": self.unit,
            "measured": finite_or_none(self.measured),
            "holds": self.holds,
        }


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
        return Gate(name, required, measured, holds, unit, strict)

    return [
        gate("Sensitivity over actionable frames", "sensitivity", SENSITIVITY_MIN, "%"),
        gate("Specificity", "specificity", SPECIFICITY_MIN, "%"),
        gate("Mean warning budget", "mean_warning_budget_s", BUDGET_ABOVE_S, "s", strict=True),
    ]


def all_hold(gates: list[Gate]) -> bool:
    """Whether a configuration may be promoted."""
    return all(gate.holds for gate in gates)
