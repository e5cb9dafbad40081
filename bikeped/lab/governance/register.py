"""The residual-risk register: what was simulated, with which results, and what was not.

Ratings of named hazards follow the paper's table 8; measured results can only make them more
severe. `field-blocking: yes` means: more evidence before the system runs unsupervised; `monitor`:
collect data in the field.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bikeped.config.schema import DecisionConfig
from bikeped.lab.governance.gates import BUDGET_ABOVE_S, SENSITIVITY_MIN, SPECIFICITY_MIN
from bikeped.lab.result_tables import CellValue, ResultTable
from bikeped.lab.simulation.suite import Suite
from bikeped.types import State

_RATINGS = ("no", "monitor", "yes")


@dataclass(frozen=True)
class Hazard:
    """A failure mode, and words by which the names of its scenarios are recognised."""

    name: str
    words: tuple[str, ...]
    coverage: str
    sensor_model: str
    blocking: str
    reason: str


#: The paper's residual risks, in its order.
HAZARDS = (
    Hazard(
        "Late swerve toward the pedestrian",
        ("swerv",),
        "yes",
        "yes",
        "no",
        "detected, but the alert may come at the closest approach; no rule that reads past "
        "positions knows of a swerve before it begins",
    ),
    Hazard(
        "Emergence from behind something nearer than 9 m",
        ("occluded", "emerg"),
        "yes",
        "yes",
        "no",
        "all danger is imminent: a cyclist who appears this near leaves no time for a warning",
    ),
    Hazard(
        "Cyclist above 40 km/h",
        ("fast approach", "e-bike", "ebike"),
        "yes",
        "yes",
        "no",
        "the stopping distance exceeds the range of sight; the budget is short",
    ),
    Hazard(
        "Low light or rain",
        (),
        "no",
        "no",
        "yes",
        "recall was measured in daylight; it has to be measured at night and in rain first",
    ),
    Hazard(
        "Several cyclists hiding one another",
        ("multi-speed", "multiple cyclists", "multi-cyclist", "two cyclists"),
        "partial",
        "recall curve only",
        "monitor",
        "misses are drawn by size and by bursts, but not because one rider hides another",
    ),
    Hazard(
        "Sensor tampered with or failing",
        (),
        "no",
        "no",
        "yes",
        "a turned, covered or dying camera is not simulated; the service shows FAULT when pictures "
        "stop, but a turned camera still delivers pictures",
    ),
    Hazard(
        "Wheelchair on a slope",
        (),
        "no",
        "no",
        "monitor",
        "the ground is taken as flat: on a slope positions are off and speeds change",
    ),
)


@dataclass(frozen=True)
class RiskRegister:
    """Named hazards and every scenario of the suite, with measured figures, for JSON and people."""

    suite_hash: str
    hazards: list[dict[str, Any]]
    scenarios: list[dict[str, Any]]

    def as_dict(self) -> dict[str, Any]:
        return {"suite_hash": self.suite_hash, "hazards": self.hazards, "scenarios": self.scenarios}

    def tables(self) -> tuple[ResultTable, ResultTable]:
        """Named hazards, then scenarios."""
        hazards = ResultTable.of(
            "register_hazards",
            "Residual risks",
            [{**row, "scenarios": _coverage(row)} for row in self.hazards],
            {
                "Failure mode": "hazard",
                "Scenarios": "scenarios",
                "Sensor model": "sensor_model",
                "Field-blocking": "field_blocking",
                "Measured": "measured",
                "Why": "reason",
            },
            "Field-blocking yes: more evidence before the system runs unsupervised. Monitor: "
            "collect data in the field.",
        )
        shares = ("sensitivity", "specificity", "sev_fn")
        scenarios = ResultTable.of(
            "register_scenarios",
            "Every scenario of the suite",
            [
                {
                    **row,
                    **{key: _percent(row[key]) for key in shares},
                    "budget": _seconds(row["min_warning_budget_s"]),
                }
                for row in self.scenarios
            ],
            {
                "Scenario": "scenario",
                "Hazard": "hazard",
                "Sensitivity %": "sensitivity",
                "Specificity %": "specificity",
                "SevFN %": "sev_fn",
                "Min budget s": "budget",
                "Field-blocking": "field_blocking",
                "Remark": "remark",
            },
            f"Monitor: sensitivity below {100 * SENSITIVITY_MIN:g} %, specificity below "
            f"{100 * SPECIFICITY_MIN:g} %, or a budget of at most {BUDGET_ABOVE_S:g} s. Yes: "
            "danger without any alert. Each scenario is compared with the suite's gates here, "
            "which is stricter than the gates themselves.",
        )
        return hazards, scenarios

    def markdown(self) -> str:
        """The register as a page of Markdown."""
        parts = ["# Residual-risk register", "", f"Scenario suite `{self.suite_hash}`.", ""]
        for table in self.tables():
            parts += [f"## {table.title}", "", _row(table.columns)]
            parts.append(_row(tuple("---" for _ in table.columns), plain=True))
            parts += [_row(row) for row in table.rows]
            parts += ["", table.note, ""]
        return "\n".join(parts)


def build_register(suite: Suite, decision: DecisionConfig) -> RiskRegister:
    """The register of a decision on a suite."""
    metrics = suite.measure(decision)
    states = suite.states(decision)
    figures = {}
    for index, name in enumerate(suite.names):
        alert = states[suite.rule_input.frame_slice(index)] == int(State.ALERT)
        danger = suite.truths[index].danger
        figures[name] = {
            **metrics.scenario_dict(index),
            "danger_frames": int(danger.sum()),
            "danger_alert_frames": int((danger & alert).sum()),
        }
    return register_from_figures(figures, {s.name: s.hazard for s in suite.scenarios}, suite.hash)


def register_from_figures(
    figures: Mapping[str, Mapping[str, Any]], hazards: Mapping[str, str], suite_hash: str = ""
) -> RiskRegister:
    """The register from the figures by scenario of `conformance compare`; `hazards` by scenario."""
    scenarios = [_scenario(name, figures[name], hazards.get(name, "")) for name in figures]
    return RiskRegister(suite_hash, [_named(h, scenarios) for h in HAZARDS], scenarios)


def _scenario(name: str, figures: Mapping[str, Any], hazard: str) -> dict[str, Any]:
    sensitivity, specificity = figures.get("sensitivity"), figures.get("specificity")
    budget = figures.get("min_warning_budget_s")
    danger = figures.get("danger_frames")
    alerted = figures.get("danger_alert_frames")
    remarks, rating = [], "no"
    if danger == 0:
        remarks.append("no danger")
    elif danger and alerted == 0:
        remarks.append("danger, and not one alert in it")
        rating = "yes"
    elif sensitivity is None:
        remarks.append("all danger is imminent" if danger else "no actionable danger")
    if sensitivity is not None and sensitivity < SENSITIVITY_MIN:
        remarks.append("misses actionable danger")
        rating = _worse(rating, "monitor")
    if specificity is not None and specificity < SPECIFICITY_MIN:
        remarks.append("alerts without danger")
        rating = _worse(rating, "monitor")
    if budget is not None and budget <= BUDGET_ABOVE_S:
        remarks.append(f"an alert leaves {budget:.2f} s")
        rating = _worse(rating, "monitor")
    keys = ("sensitivity", "specificity", "sev_fn", "min_warning_budget_s")
    return {
        "scenario": name,
        "hazard": hazard,
        "covered": True,
        "sensor_model": "localisation error",
        "field_blocking": rating,
        "remark": "; ".join(remarks) or "within the gates",
        **{key: figures.get(key) for key in keys},
        "danger_frames": danger,
    }


def _named(hazard: Hazard, scenarios: list[dict[str, Any]]) -> dict[str, Any]:
    """A hazard with the results of its scenarios; rated more severe where they are bad."""
    found = [s for s in scenarios if any(w in s["scenario"].lower() for w in hazard.words)]
    coverage, rating = hazard.coverage, hazard.blocking
    reason = hazard.reason
    if hazard.words and not found:
        coverage, rating = "no", _worse(rating, "monitor")
        reason = "no scenario of this suite is about it; " + reason
    if any(s["field_blocking"] == "yes" for s in found):
        rating = "yes"
    return {
        "hazard": hazard.name,
        "coverage": coverage,
        "scenarios": [s["scenario"] for s in found],
        "sensor_model": hazard.sensor_model if coverage != "no" else "no",
        "field_blocking": rating,
        "measured": "; ".join(_measured(s) for s in found) or "not simulated",
        "reason": reason,
    }


def _measured(row: Mapping[str, Any]) -> str:
    if row["sensitivity"] is None:
        text = "no actionable frames"
    else:
        text = f"sensitivity {_percent(row['sensitivity'])} %, SevFN {_percent(row['sev_fn'])} %"
    budget = row["min_warning_budget_s"]
    return f"{row['scenario']}: {text}, " + (
        "no onset with a budget" if budget is None else f"least budget {budget:.2f} s"
    )


def _worse(a: str, b: str) -> str:
    return max(a, b, key=_RATINGS.index)


def _coverage(hazard: Mapping[str, Any]) -> str:
    named = ", ".join(hazard["scenarios"])
    return f"{hazard['coverage']} ({named})" if named else str(hazard["coverage"])


def _percent(value: float | None) -> str | None:
    return None if value is None else f"{100 * value:.1f}"


def _seconds(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"


def _row(cells: tuple[CellValue, ...], plain: bool = False) -> str:
    texts = ["-" if c is None else str(c) for c in cells]
    return "| " + " | ".join(t if plain else _escaped(t) for t in texts) + " |"


def _escaped(text: str) -> str:
    """Text with Markdown's special characters escaped: a scenario's name may hold any."""
    return re.sub(r"([\\`*_\[\]<>|#&])", r"\\\1", " ".join(text.split()))
