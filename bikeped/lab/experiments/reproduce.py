"""All experiments on all cores, with every table and figure, resumed after an interruption.

Each experiment is one job; the longest start first. A finished one is written to
`data/<name>.json` with a key over everything it depends on (scenarios, configuration, code,
parameters) and is read from there when the key is the same.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bikeped import __version__
from bikeped.config.load import LoadedConfig
from bikeped.config.provenance import DECIDING_CODE, MEASURING_CODE, code_hash
from bikeped.files import make_folder, write_whole
from bikeped.lab.experiments import deployment, latency, optimizer
from bikeped.lab.experiments.deterministic import (
    braking_profiles,
    compare_table,
    localisation_errors,
    run_table,
    trackers_table,
    truth_sensitivity,
    warning_budgets,
)
from bikeped.lab.experiments.trials import BURST_FRAMES, TRIALS, montecarlo
from bikeped.lab.process_pool import ProgressCallback, no_progress, run_jobs
from bikeped.lab.result_tables import ExperimentResult, ResultTable
from bikeped.lab.simulation.perception import RecallCurve, RecallModel, recall_models
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite, result_provenance

#: Parts of bikeped whose source decides what an experiment gives.
_CODE = (*DECIDING_CODE, *MEASURING_CODE, "config", "types")


@dataclass(frozen=True)
class ReproduceSettings:
    """What a reproduction may vary."""

    trials: int = TRIALS
    seed: int = 0
    burst: float = BURST_FRAMES
    curve: RecallCurve | None = None
    maxiter: int = optimizer.MAXITER
    popsize: int = optimizer.POPSIZE
    deployment_trials: int = deployment.DEPLOYMENT_TRIALS
    placement_trials: int = deployment.PLACEMENT_TRIALS

    @property
    def recall(self) -> RecallModel:
        """The finest recall model there is."""
        return recall_models(self.curve)[-1]


Experiment = Callable[[Suite, LoadedConfig, ReproduceSettings], ExperimentResult]
#: By name: the longest first, so that no core waits long at the end.
EXPERIMENTS: dict[str, Experiment] = {
    "montecarlo": lambda suite, _, s: montecarlo(
        suite, CONFIGURATIONS, s.trials, s.seed, s.burst, s.curve
    ),
    "optimize": lambda suite, loaded, s: optimizer.optimize(
        suite, loaded.config.decision, maxiter=s.maxiter, popsize=s.popsize
    ),
    "latency_loss": lambda suite, loaded, s: latency.sweep_with_loss(
        suite, loaded.config.decision, recall=s.recall, trials=s.trials, seed=s.seed
    ),
    "deployment": lambda suite, loaded, s: deployment.deployment(
        suite.camera, suite.tracker, loaded.config.decision, s.deployment_trials, s.seed, s.recall
    ),
    "placement": lambda suite, loaded, s: deployment.placement(
        suite.camera, suite.tracker, loaded.config.decision, s.placement_trials, s.seed, s.recall
    ),
    "latency": lambda suite, loaded, _: latency.sweep(suite, loaded.config.decision),
    "truth": lambda suite, loaded, _: truth_sensitivity(suite, loaded.config.decision),
    "braking": lambda suite, loaded, _: braking_profiles(suite, loaded.config.decision),
    "run": lambda suite, loaded, _: run_table(suite, loaded.config.decision),
    "compare": lambda suite, loaded, s: compare_table(suite, loaded, seed=s.seed),
    "trackers": lambda suite, loaded, _: trackers_table(suite, loaded),
    "budgets": lambda suite, loaded, _: warning_budgets(suite, loaded.config.decision),
    "errors": lambda suite, loaded, _: localisation_errors(suite),
}
#: The order of the report.
REPORT_ORDER = (
    "run",
    "compare",
    "trackers",
    "budgets",
    "errors",
    "truth",
    "braking",
    "latency",
    "montecarlo",
    "latency_loss",
    "deployment",
    "placement",
    "optimize",
)


@cache
def code_version() -> str:
    """SHA-256 over the sources and the numpy that decide a result."""
    return hashlib.sha256(f"{code_hash(_CODE)} {np.__version__}".encode()).hexdigest()


def cache_key(name: str, suite: Suite, loaded: LoadedConfig, settings: ReproduceSettings) -> str:
    """Everything that the result of an experiment depends on, as one hash.

    The order of the scenarios counts too: tables and sums follow it.
    """
    parts = [
        name,
        code_version(),
        suite.hash,
        list(suite.names),
        [scenario.hazard for scenario in suite.scenarios],
        repr(suite.pose),
        suite.tracker.name,
        repr(suite.truth_settings),
        loaded.hash,
        repr(settings),
    ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def run_experiment(
    name: str,
    key: str,
    suite: Suite,
    loaded: LoadedConfig,
    settings: ReproduceSettings,
    folder: Path,
    figures: bool,
) -> tuple[ExperimentResult, float | None, list[Path]]:
    """One experiment: its result, the seconds that it took (None: stored under `key` before), and
    its figures. The job of a process."""
    path = folder / "data" / f"{name}.json"
    result, seconds = read_stored(path, key), None
    if result is None:
        begin = time.perf_counter()
        result = EXPERIMENTS[name](suite, loaded, settings)
        seconds = time.perf_counter() - begin
        document = {
            "key": key,
            "provenance": result_provenance(suite, loaded, settings.seed),
            "seconds": seconds,
            "data": result.data,
            "tables": [_table_dict(table) for table in result.tables],
        }
        write_whole(path, _json(document))
    drawn: list[Path] = []
    if figures:
        from bikeped.lab.experiments.report import draw_all

        drawn = draw_all({name: result.data}, suite, folder / "figures")
    return result, seconds, drawn


@dataclass(frozen=True)
class Reproduction:
    """Results in the order of the report, names of reused ones, seconds of the others, files."""

    results: tuple[ExperimentResult, ...]
    reused: tuple[str, ...]
    seconds: Mapping[str, float]
    figures: tuple[Path, ...]
    index: Path | None


def reproduce(
    suite: Suite,
    loaded: LoadedConfig,
    folder: Path,
    settings: ReproduceSettings = ReproduceSettings(),
    processes: int = 1,
    figures: bool = True,
    progress: ProgressCallback = no_progress,
) -> Reproduction:
    """Runs every experiment that is not stored yet, then writes tables, figures and the report.

    Progress counts experiments, and the report as one more.
    """
    for part in ("data", "tables"):
        make_folder(folder / part)
    progress(0)
    _ = suite.truth_frames, suite.rule_input  # computed once, before the suite goes to the workers
    jobs = [
        (name, cache_key(name, suite, loaded, settings), suite, loaded, settings, folder, figures)
        for name in EXPERIMENTS
    ]
    done = dict(zip(EXPERIMENTS, run_jobs(run_experiment, jobs, processes, progress), strict=True))
    results = tuple(done[name][0] for name in REPORT_ORDER)
    for result in results:
        for table in result.tables:
            write_whole(folder / "tables" / f"{table.name}.csv", table.csv())
            write_whole(folder / "tables" / f"{table.name}.json", _json(_table_dict(table)))
    drawn = tuple(path for name in REPORT_ORDER for path in done[name][2])
    index: Path | None = None
    if figures:
        from bikeped.lab.experiments.report import write_index

        provenance = {
            "version": __version__,
            "scenarios": str(len(suite.scenarios)),
            "suite": suite.hash,
            "configuration": loaded.hash,
            "calibration": loaded.calibration_hash or "none",
            "code": code_version(),
            "trials": str(settings.trials),
            "seed": str(settings.seed),
            "optimiser's seed": str(optimizer.SEED),
        }
        index = write_index(folder, results, drawn, provenance)
    progress(len(EXPERIMENTS) + 1)
    seconds = {name: taken for name, (_, taken, _) in done.items() if taken is not None}
    reused = tuple(name for name in done if name not in seconds)
    return Reproduction(results, reused, seconds, drawn, index)


def read_stored(path: Path, key: str) -> ExperimentResult | None:
    """A finished experiment of this key; None when there is none, or it is of another key."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["key"] != key:
            return None
        tables = tuple(
            ResultTable(
                **{**t, "columns": tuple(t["columns"]), "rows": [tuple(row) for row in t["rows"]]}
            )
            for t in document["tables"]
        )
        return ExperimentResult(path.stem, document["data"], tables)
    except (OSError, ValueError, KeyError, TypeError):
        return None  # missing, cut off or written by hand: computed again


def _table_dict(table: ResultTable) -> dict[str, Any]:
    return {**vars(table), "rows": [list(row) for row in table.rows]}


def _json(document: Mapping[str, Any]) -> str:
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
