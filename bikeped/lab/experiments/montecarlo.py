"""Monte Carlo: the suite with missed detections, independent and in bursts, many trials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bikeped.config import DecisionConfig
from bikeped.lab.experiments.trials import (
    TRIALS,
    LossModel,
    run_trials,
    sorted_suite,
    summarize_metrics,
    summarize_scenario,
    trial_jobs,
)
from bikeped.lab.process_pool import ProgressCallback, no_progress
from bikeped.lab.result_tables import ExperimentResult, ResultTable
from bikeped.lab.simulation.perception import RecallCurve, recall_models
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite

BURST_FRAMES = 5.0


def montecarlo(
    suite: Suite,
    configurations: Mapping[str, DecisionConfig] = CONFIGURATIONS,
    trials: int = TRIALS,
    seed: int = 0,
    burst: float = BURST_FRAMES,
    curve: RecallCurve | None = None,
    processes: int = 1,
    progress: ProgressCallback = no_progress,
) -> ExperimentResult:
    """Independent and bursty misses, recall flat, by size and (when given) by curve.

    `by_scenario` holds the first configuration, independent misses, the finest recall given.
    """
    ordered = sorted_suite(suite)
    models = recall_models(curve)
    cases = [(loss, model) for loss in ("independent", "burst") for model in models]
    losses = [LossModel(model, burst if loss == "burst" else None) for loss, model in cases]
    found = run_trials(ordered, losses, configurations, trials, seed, processes, progress)
    rows = [
        {
            "loss": loss,
            "recall": model.mode,
            "configuration": name,
            "metrics": summarize_metrics(metrics),
        }
        for (loss, model), part in zip(cases, found, strict=True)
        for name, metrics in part[0, 0].items()
    ]
    detailed = len(models) - 1
    first = next(iter(configurations))
    case = {"loss": "independent", "recall": models[detailed].mode, "configuration": first}
    data: dict[str, Any] = {
        "trials": trials,
        "seed": seed,
        "burst": burst,
        "rows": rows,
        "by_scenario": {
            name: summarize_scenario(found[detailed][0, 0][first], ordered.names.index(name))
            for name in suite.names
        },
        "by_scenario_of": case,
    }
    if curve is not None:
        data["curve"] = {"area_px2": list(curve[0]), "recall": list(curve[1])}
    return ExperimentResult("montecarlo", data, tuple(_tables(data)))


def montecarlo_jobs(trials: int, curve: bool) -> int:
    """How far the progress of `montecarlo` counts."""
    return trial_jobs(6 if curve else 4, trials)


def _tables(data: Mapping[str, Any]) -> Iterator[ResultTable]:
    columns = {
        "sens, %": "metrics.sensitivity.mean",
        "from, %": "metrics.sensitivity.low",
        "to, %": "metrics.sensitivity.high",
        "spec, %": "metrics.specificity.mean",
        "SevFN, %": "metrics.sev_fn.mean",
        "fatigue, %": "metrics.fatigue.mean",
        "budget, s": "metrics.mean_warning_budget_s.mean",
    }
    note = (
        f"{data['trials']} trials; from and to: 95 % confidence interval of the mean; bursts of "
        f"{data['burst']:g} frames on average"
    )
    yield ResultTable.of(
        "montecarlo",
        "Monte Carlo",
        data["rows"],
        {
            "loss": "loss",
            "recall": "recall",
            "configuration": "configuration",
            **columns,
            "contact, %": "metrics.contact_sensitivity.mean",
        },
        note,
    )
    case = data["by_scenario_of"]
    yield ResultTable.of(
        "montecarlo_by_scenario",
        f"Monte Carlo by scenario: {case['configuration']}, {case['loss']}, {case['recall']}",
        [{"scenario": n, "metrics": m} for n, m in data["by_scenario"].items()],
        {"scenario": "scenario", **columns},
        note,
    )
