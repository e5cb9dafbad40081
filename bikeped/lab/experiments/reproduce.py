"""All experiments in all cores, with every table and figure, resumed after an interruption.

Each experiment is one job; the longest start first. A finished one is written whole to
`data/<name>.json` with a key made of everything it depends on (scenarios, configuration, code,
parameters) and is taken from there when the key is the same.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from bikeped.config import LoadedConfig
from bikeped.config.provenance import DECIDING_CODE, MEASURING_CODE, code_hash
from bikeped.files import make_folder, write_whole
from bikeped.lab.experiments import deployment, latency, montecarlo, optimizer
from bikeped.lab.experiments import deterministic as experiments
from bikeped.lab.experiments.deterministic import ProgressCallback, no_progress, result_provenance
from bikeped.lab.process_pool import worker_pool
from bikeped.lab.result_tables import ExperimentResult, ResultTable
from bikeped.lab.simulation.perception import RecallModel
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite

#: Parts of bikeped whose source decides what an experiment gives.
_CODE = (*DECIDING_CODE, *MEASURING_CODE, "config", "types")


@dataclass(frozen=True)
class ReproduceSettings:
    """What a reproduction may vary."""

    trials: int = montecarlo.TRIALS
    seed: int = 0
    burst: float = montecarlo.BURST_FRAMES
    curve: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    maxiter: int = optimizer.MAXITER
    popsize: int = optimizer.POPSIZE
    deployment_trials: int = deployment.DEPLOYMENT_TRIALS
    placement_trials: int = deployment.PLACEMENT_TRIALS

    @property
    def recall(self) -> RecallModel:
        """The finest recall model there is."""
        return montecarlo.recall_models(self.curve)[-1]


Experiment = Callable[[Suite, LoadedConfig, ReproduceSettings], ExperimentResult]


def _montecarlo(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return montecarlo.montecarlo(suite, CONFIGURATIONS, s.trials, s.seed, s.burst, s.curve)


def _latency_loss(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return latency.sweep_with_loss(
        suite, loaded.config.decision, recall=s.recall, trials=s.trials, seed=s.seed
    )


def _optimize(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return optimizer.optimize(suite, loaded.config.decision, maxiter=s.maxiter, popsize=s.popsize)


def _deployment(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    decision = loaded.config.decision
    return deployment.deployment(suite.camera, decision, s.deployment_trials, s.seed, s.recall)


def _placement(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    decision = loaded.config.decision
    return deployment.placement(suite.camera, decision, s.placement_trials, s.seed, s.recall)


def _latency(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return latency.sweep(suite, loaded.config.decision)


def _truth(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return experiments.truth_sensitivity(suite, loaded.config.decision)


def _braking(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return experiments.braking_profiles(suite, loaded.config.decision)


def _run(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return experiments.run_table(suite, loaded.config.decision)


def _budgets(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return experiments.warning_budgets(suite, loaded.config.decision)


def _compare(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return experiments.compare_table(suite, loaded, seed=s.seed)


def _errors(suite: Suite, loaded: LoadedConfig, s: ReproduceSettings) -> ExperimentResult:
    return experiments.errors(suite)


#: The longest first, so that no core waits long at the end.
EXPERIMENTS: dict[str, Experiment] = {
    "montecarlo": _montecarlo,
    "optimize": _optimize,
    "latency_loss": _latency_loss,
    "deployment": _deployment,
    "placement": _placement,
    "latency": _latency,
    "truth": _truth,
    "braking": _braking,
    "run": _run,
    "compare": _compare,
    "budgets": _budgets,
    "errors": _errors,
}
#: The order of the index page.
SHOWN_ORDER = (
    "run",
    "compare",
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
        repr(suite.truth_settings),
        loaded.hash,
        repr(settings),
    ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def compute(
    name: str, suite: Suite, loaded: LoadedConfig, settings: ReproduceSettings
) -> tuple[ExperimentResult, float]:
    """One experiment and the seconds it took: the job of a process."""
    begin = time.perf_counter()
    result = EXPERIMENTS[name](suite, loaded, settings)
    return result, time.perf_counter() - begin


def draw_figures(result: ExperimentResult, suite: Suite, folder: Path) -> list[Path]:
    """The figures of one experiment: the job of a process too."""
    from bikeped.lab.experiments.figures import draw_all

    return draw_all({result.name: result.data}, suite, folder)


@dataclass(frozen=True)
class Reproduction:
    """What a run left: results in the order of the page, those reused, files, seconds."""

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
    """Runs every experiment that is not there yet, then writes tables, figures and the page.

    Progress counts experiments, and the figures as one more.
    """
    data_folder, table_folder = folder / "data", folder / "tables"
    for part in (data_folder, table_folder):
        make_folder(part)
    keys = {name: cache_key(name, suite, loaded, settings) for name in EXPERIMENTS}
    found: dict[str, ExperimentResult] = {}
    seconds: dict[str, float] = {}
    for name, key in keys.items():
        stored = read_stored(data_folder / f"{name}.json", key)
        if stored is not None:
            found[name] = stored
    reused = tuple(found)
    progress(len(found))
    stamp = result_provenance(suite, loaded, settings.seed)

    def keep(name: str, result: ExperimentResult, took: float) -> None:
        found[name], seconds[name] = result, took
        document = {
            "key": keys[name],
            "provenance": stamp,
            "seconds": took,
            "data": result.data,
            "tables": [_table_dict(table) for table in result.tables],
        }
        write_whole(data_folder / f"{name}.json", _json(document))
        progress(len(found))

    _ = suite.truth_frames, suite.rule_input  # made once, before the suite goes to every process
    missing = [name for name in EXPERIMENTS if name not in found]
    pictures: dict[str, list[Path]] = {}
    if processes > 1:
        with worker_pool(processes) as pool:
            jobs: dict[Future[Any], tuple[str, bool]] = {}

            def picture(name: str) -> None:
                if figures:
                    job = pool.submit(draw_figures, found[name], suite, folder / "figures")
                    jobs[job] = (name, True)

            for name in missing:
                jobs[pool.submit(compute, name, suite, loaded, settings)] = (name, False)
            for name in reused:
                picture(name)
            while jobs:
                for job in wait(jobs, return_when=FIRST_COMPLETED).done:
                    name, is_picture = jobs.pop(job)
                    if is_picture:
                        pictures[name] = job.result()
                    else:
                        keep(name, *job.result())
                        picture(name)
    else:
        for name in missing:
            keep(name, *compute(name, suite, loaded, settings))
        if figures:
            for name, result in found.items():
                pictures[name] = draw_figures(result, suite, folder / "figures")

    results = tuple(found[name] for name in SHOWN_ORDER)
    for result in results:
        for table in result.tables:
            write_whole(table_folder / f"{table.name}.csv", table.csv())
            write_whole(table_folder / f"{table.name}.json", _json(_table_dict(table)))
    drawn = tuple(path for name in SHOWN_ORDER for path in pictures.get(name, []))
    index: Path | None = None
    if figures:
        from bikeped.lab.experiments.report import write_index

        said = {
            "version": str(stamp["version"]),
            "scenarios": str(stamp["scenarios"]),
            "suite": suite.hash,
            "configuration": loaded.hash,
            "calibration": loaded.calibration_hash or "none",
            "code": code_version(),
            "trials": str(settings.trials),
            "seed": str(settings.seed),
            "optimiser's seed": str(optimizer.SEED),
        }
        index = write_index(folder, list(results), list(drawn), said)
    progress(len(EXPERIMENTS) + 1)
    return Reproduction(results, reused, seconds, drawn, index)


def read_stored(path: Path, key: str) -> ExperimentResult | None:
    """A finished experiment of this key; None when there is none, or it is of another key."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["key"] != key:
            return None
        tables = tuple(
            ResultTable(
                t["name"],
                t["title"],
                tuple(t["columns"]),
                [tuple(row) for row in t["rows"]],
                t["note"],
            )
            for t in document["tables"]
        )
        return ExperimentResult(path.stem, document["data"], tables)
    except (OSError, ValueError, KeyError, TypeError):
        return None  # missing, cut off or written by hand: computed again


def _table_dict(table: ResultTable) -> dict[str, Any]:
    return {
        "name": table.name,
        "title": table.title,
        "columns": list(table.columns),
        "rows": [list(row) for row in table.rows],
        "note": table.note,
    }


def _json(document: Mapping[str, Any]) -> str:
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
