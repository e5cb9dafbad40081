"""Experiments without random numbers: scenarios, comparison, localisation, truth, braking.

Each maps a suite to an `ExperimentResult`: `data` in plain JSON with exact figures (null where
there is none), tables for people in per cent with one decimal.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.decision.episodes import onsets
from bikeped.errors import ScenarioError
from bikeped.lab.result_tables import ExperimentResult, ResultTable, cells
from bikeped.lab.scenarios.scenario import SIZES_M
from bikeped.lab.simulation.metrics import Metrics, finite_or_none
from bikeped.lab.simulation.perception import error_table, localise
from bikeped.lab.simulation.simulate import PAPER, SimulatedTracker
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite, compare, compare_json
from bikeped.lab.simulation.truth import ATTENTIVE_PRT_S, PEDESTRIAN_PRT_S, GroundTruthSettings
from bikeped.types import State

#: The metrics of the short tables, by column. The columns are short, to fit a terminal of 80
#: columns; `contact` is the contact sensitivity.
METRIC_COLUMNS = {
    "sens, %": "sensitivity",
    "spec, %": "specificity",
    "SevFN, %": "sev_fn",
    "fatigue, %": "fatigue",
    "budget, s": "mean_warning_budget_s",
    "contact, %": "contact_sensitivity",
}

#: Thresholds of the ground truth that are varied one at a time (paper, table 4).
CPA_RADII_M = (3.0, 5.0, 7.0)
STOPPING_MARGINS = (0.6, 0.8, 1.0)
TTC_BOUNDS_S = (2.0, 3.0, 4.0)
MAP_STEP_M = 0.5
MAP_REACH_M = 25.0


def select_scenario(suite: Suite, name: str) -> Suite:
    """The suite with only the scenario of this name (case is ignored)."""
    found = [s for s in suite.scenarios if s.name.casefold() == name.strip().casefold()]
    if not found:
        known = {n.casefold(): n for n in suite.names}
        near = difflib.get_close_matches(name.casefold(), known, 1, 0.4)
        remedy = (
            f"did you mean {known[near[0]]!r}?" if near else f"known are {', '.join(suite.names)}"
        )
        raise ScenarioError(f"--scenario {name!r}: there is no such scenario; {remedy}")
    return replace(suite, scenarios=tuple(found))


def run_table(suite: Suite, decision: DecisionConfig) -> ExperimentResult:
    """Every scenario under one configuration, and the totals."""
    states = suite.states(decision)
    metrics = suite.measure(decision)
    rows: list[dict[str, Any]] = []
    for index, (scenario, truth) in enumerate(zip(suite.scenarios, suite.truths, strict=True)):
        frames = states[suite.rule_input.frame_slice(index)]
        share = np.bincount(frames, minlength=len(State)) / len(frames)
        rows.append(
            {
                "scenario": scenario.name,
                "hazard": scenario.hazard,
                "expected": scenario.expected,
                "dominant": State(int(share.argmax())).name.lower(),
                "states": {s.name.lower(): float(share[s]) for s in State},
                "frames": len(frames),
                "danger_frames": int(truth.danger.sum()),
                "actionable_frames": int(truth.actionable.sum()),
                **metrics.scenario_dict(index),
            }
        )
    totals = metrics.as_dict()
    budgets = warning_budgets(suite, decision)
    table = ResultTable.of(
        "run",
        "Scenarios",
        rows,
        {
            "scenario": "scenario",
            "expected": "expected",
            "dominant": "dominant",
            "danger": "danger_frames",
            "actionable": "actionable_frames",
            "sens, %": "sensitivity",
            "spec, %": "specificity",
            "SevFN, %": "sev_fn",
            "fatigue, %": "fatigue",
            "late, s": "alert_latency_s",
            "mean budget, s": "mean_warning_budget_s",
            "min budget, s": "min_warning_budget_s",
            "lead, s": "first_onset_lead_s",
        },
        "danger, actionable: frames; late: from the first actionable frame to ALERT; lead: from "
        "the first ALERT to the closest approach",
    )
    total = ResultTable.of("run_totals", "All scenarios", [totals], METRIC_COLUMNS)
    chosen = msgspec.to_builtins(decision)
    data = {"decision": chosen, "metrics": totals, "scenarios": rows, "budgets": budgets.data}
    return ExperimentResult("run", data, (table, total))


def compare_table(
    suite: Suite,
    loaded: LoadedConfig,
    configurations: Mapping[str, DecisionConfig] = CONFIGURATIONS,
    seed: int = 0,
) -> ExperimentResult:
    """All configurations, with and without localisation error."""
    data = compare_json(suite, compare(suite, configurations), loaded, seed)

    def table(name: str, key: str, error: str) -> ResultTable:
        rows = [(c, *cells(metrics, METRIC_COLUMNS)) for c, metrics in data[key].items()]
        title = f"Configurations, {error} localisation error"
        return ResultTable(name, title, ("configuration", *METRIC_COLUMNS), rows)

    tables = (
        table("compare", "configurations", "with"),
        table("compare_without_error", "without_localisation_error", "without"),
    )
    return ExperimentResult("compare", data, tables)


def localisation_errors(suite: Suite) -> ExperimentResult:
    """Localisation error: the paper's table, and a map of the ground in front of the camera.

    The map's rows go with `x_m` (forward), its columns with `y_m` (right); objects lie with their
    length across the camera's axis. Null where no corner can be seen.
    """
    table = error_table(suite.camera)
    x = np.arange(MAP_STEP_M, MAP_REACH_M + MAP_STEP_M / 2, MAP_STEP_M)
    y = np.arange(-MAP_REACH_M, MAP_REACH_M + MAP_STEP_M / 2, MAP_STEP_M)
    ground = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    across = np.tile([[0.0, 1.0]], (len(ground), 1))
    maps: dict[str, Any] = {}
    for kind in ("pedestrian", "cyclist", "car"):
        put, area = localise(suite.camera, ground, across, SIZES_M[kind])
        error = np.where(area > 0, np.hypot(*(put - ground).T), np.nan)
        maps[kind] = {
            "x_m": x.tolist(),
            "y_m": y.tolist(),
            "error_m": [[finite_or_none(v) for v in row] for row in error.reshape(len(x), len(y))],
        }
    distances = list(dict.fromkeys(float(row["distance_m"]) for row in table))
    error_m = {(r["kind"], r["bearing_deg"], r["distance_m"]): float(r["error_m"]) for r in table}
    lines = list(dict.fromkeys((str(r["kind"]), r["bearing_deg"]) for r in table))
    columns = ("kind", "bearing, degrees", *(f"{d:g} m" for d in distances))
    rows = [(k, b, *(round(error_m[k, b, d], 2) for d in distances)) for k, b in lines]
    printed = ResultTable("errors", "Localisation error, m", columns, rows)
    return ExperimentResult("errors", {"table": table, "map": maps}, (printed,))


def trackers_table(suite: Suite, loaded: LoadedConfig) -> ExperimentResult:
    """The configurations with the pole's tracker and with the paper's, side by side."""
    trackers = (SimulatedTracker.of(loaded), PAPER)
    rows = [
        {"configuration": name, "tracker": tracker.name, **other.measure(decision).as_dict()}
        for tracker in trackers
        for other in [replace(suite, tracker=tracker)]
        for name, decision in CONFIGURATIONS.items()
    ]
    rows.sort(key=lambda row: list(CONFIGURATIONS).index(row["configuration"]))
    table = ResultTable(
        "trackers",
        "The pole's tracker and the paper's",
        ("configuration", "tracker", *METRIC_COLUMNS),
        [(r["configuration"], r["tracker"], *cells(r, METRIC_COLUMNS)) for r in rows],
        "deployed: the configuration's tracker, who counts and what is shown as on the pole; "
        "paper: the tracker that the paper's figures hold with",
    )
    return ExperimentResult("trackers", {"rows": rows}, (table,))


def truth_sensitivity(suite: Suite, decision: DecisionConfig) -> ExperimentResult:
    """The same decisions under other thresholds of the ground truth, one varied at a time."""
    base = GroundTruthSettings(braking=suite.truth_settings.braking)
    cases: list[tuple[str, float | None, GroundTruthSettings]] = [
        *(("cpa_radius_m", v, replace(base, cpa_radius_m=v)) for v in CPA_RADII_M),
        *(("stopping_margin", v, replace(base, stopping_margin=v)) for v in STOPPING_MARGINS),
        *(("ttc_bound_s", v, replace(base, ttc_bound_s=v)) for v in TTC_BOUNDS_S),
        ("ttc_bound_s", None, base),
    ]
    rows = [
        {
            "parameter": parameter,
            "value": value,
            "default": settings == base,
            **suite.measure(decision, truth=suite.with_truth(settings).truth_frames).as_dict(),
        }
        for parameter, value, settings in cases
    ]
    names = {
        "cpa_radius_m": "CPA radius, m",
        "stopping_margin": "stopping margin",
        "ttc_bound_s": "TTC bound, s",
    }
    table = ResultTable(
        "truth",
        "Thresholds of the ground truth",
        ("parameter", "value", "default", *METRIC_COLUMNS),
        [
            (
                names[row["parameter"]],
                "1.87 + clearance" if row["value"] is None else row["value"],
                "yes" if row["default"] else "",
                *cells(row, METRIC_COLUMNS),
            )
            for row in rows
        ],
    )
    return ExperimentResult("truth", {"rows": rows}, (table,))


def braking_profiles(suite: Suite, decision: DecisionConfig) -> ExperimentResult:
    """The same decisions against ground truth in which all cyclists brake by one profile."""
    profiles = {"scenario": None, "bicycle": "bicycle", "ebike": "ebike", "aashto": "aashto"}
    rows: list[dict[str, Any]] = []
    for name, braking in profiles.items():
        other = suite.with_truth(replace(suite.truth_settings, braking=braking))
        rows.append({"profile": name, "metrics": other.measure(decision).as_dict()})
    table = ResultTable(
        "braking",
        "Braking profiles of the ground truth",
        ("profile", *METRIC_COLUMNS),
        [(row["profile"], *cells(row["metrics"], METRIC_COLUMNS)) for row in rows],
        "scenario: bicycle or e-bike, as each scenario has it",
    )
    return ExperimentResult("braking", {"rows": rows}, (table,))


def warning_budgets(suite: Suite, decision: DecisionConfig) -> ExperimentResult:
    """Time from each onset of ALERT to the closest approach, where there are actionable frames.

    The class goes by the worst onset of a scenario; a scenario without any is "below".
    """
    states = suite.states(decision)
    metrics: Metrics = suite.measure(decision)
    rows: list[dict[str, Any]] = []
    for index, (scenario, truth) in enumerate(zip(suite.scenarios, suite.truths, strict=True)):
        if not truth.actionable.any():
            continue
        alert = states[suite.rule_input.frame_slice(index)] == State.ALERT
        onset = onsets(alert) & np.isfinite(truth.budget_s)
        worst = finite_or_none(metrics.by_scenario["min_warning_budget_s"][index])
        rows.append(
            {
                "scenario": scenario.name,
                "mean": finite_or_none(metrics.by_scenario["mean_warning_budget_s"][index]),
                "min": worst,
                "onsets": [float(v) for v in truth.budget_s[onset]],
                "class": budget_class(worst),
            }
        )
    table = ResultTable.of(
        "budgets",
        "Warning budgets",
        [{**row, "count": len(row["onsets"])} for row in rows],
        {
            "scenario": "scenario",
            "mean, s": "mean",
            "min, s": "min",
            "onsets": "count",
            "class": "class",
        },
        f"distracted {PEDESTRIAN_PRT_S} s, attentive {ATTENTIVE_PRT_S} s; by the worst onset",
    )
    return ExperimentResult("budgets", {"rows": rows}, (table,))


def budget_class(budget_s: float | None) -> str:
    """A budget against the pedestrian's two reaction times."""
    if budget_s is None or budget_s <= ATTENTIVE_PRT_S:
        return "below"
    return "above distracted" if budget_s > PEDESTRIAN_PRT_S else "above attentive"
