"""Parameter selection by differential evolution (definitions, section 9; paper, section 4.3).

The tracker runs once; an evaluation only asks the rule and counts, a few milliseconds. The same
seed gives the same answer: one process, one generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import scipy
from scipy.optimize import Bounds, differential_evolution

from bikeped.config.schema import DecisionConfig
from bikeped.errors import ScenarioError
from bikeped.lab.experiments.deterministic import METRIC_COLUMNS
from bikeped.lab.process_pool import ProgressCallback, no_progress
from bikeped.lab.result_tables import ExperimentResult, ResultTable, cells
from bikeped.lab.simulation.metrics import Metrics, measure
from bikeped.lab.simulation.simulate import outcome
from bikeped.lab.simulation.suite import Suite
from bikeped.types import FloatArray

SEED = 42
#: Individuals per parameter: SciPy's default. With five parameters, 75 individuals.
POPSIZE = 15
#: Generations: 75 * (60 + 1) = 4575 evaluations. The cost is flat in steps (frames are counted),
#: so no tolerance ends the search before.
MAXITER = 60


@dataclass(frozen=True)
class Bound:
    """Range of one key of the decision section; `whole`: an integer."""

    key: str
    low: float
    high: float
    whole: bool = False


BOUNDS = (
    Bound("memory_frames", 0, 120, True),
    Bound("d_min_m", 0.5, 5.0),
    Bound("d_max_m", 5.0, 25.0),
    Bound("min_displacement_m", 0.01, 0.5),
    Bound("lookback_frames", 1, 10, True),
)


def cost(metrics: Metrics) -> float:
    """What is minimised; a figure that has nothing to count takes its worst value."""
    adequate = 0.0 if math.isnan(metrics.adequate_share) else metrics.adequate_share
    false_positive_rate = 0.0 if math.isnan(metrics.specificity) else 1 - metrics.specificity
    return (
        5 * metrics.sev_fn
        + false_positive_rate
        + 2 * metrics.mean_alert_latency_s
        + 3 * (1 - adequate)
        + max(0.0, metrics.fatigue - 0.20)
        + 20 * max(0.0, 0.90 - metrics.sensitivity)
    )


def decision_at(point: FloatArray, base: DecisionConfig) -> DecisionConfig:
    """The configuration of a point within `BOUNDS`; what is not searched stays as in `base`."""
    values = {
        b.key: round(float(x)) if b.whole else float(x) for b, x in zip(BOUNDS, point, strict=True)
    }
    return msgspec.structs.replace(base, **values)


def optimize(
    suite: Suite,
    base: DecisionConfig,
    seed: int = SEED,
    maxiter: int = MAXITER,
    popsize: int = POPSIZE,
    progress: ProgressCallback = no_progress,
) -> ExperimentResult:
    """The best parameters for this suite. Progress counts evaluations."""
    truth, run = suite.truth_frames, suite.rule_input
    if not truth.actionable.any():
        raise ScenarioError(
            "optimize: no scenario has an actionable danger frame; add one with a closing cyclist"
        )
    count, best = 0, math.inf
    trace: list[list[float]] = []

    def evaluate(point: FloatArray) -> float:
        nonlocal count, best
        found = outcome(run, suite.tracker.rule(decision_at(point, base)))
        value = cost(measure(truth, found.states, found.raw))
        count += 1
        progress(count)
        if value < best:
            best = value
            trace.append([count, value])
        return value

    # Up to 1.14 the argument was named seed; a generator makes the same numbers under both names.
    name = "rng" if tuple(map(int, scipy.__version__.split(".")[:2])) >= (1, 15) else "seed"
    randomness: dict[str, Any] = {name: np.random.default_rng(seed)}
    # Not polished: that takes derivatives, of a step function of whole numbers.
    found: Any = differential_evolution(
        evaluate,
        Bounds([b.low for b in BOUNDS], [b.high for b in BOUNDS]),
        strategy="best1bin",
        maxiter=maxiter,
        popsize=popsize,
        tol=0.0,
        integrality=[b.whole for b in BOUNDS],
        polish=False,
        **randomness,
    )
    decision = decision_at(np.asarray(found.x, np.float64), base)
    metrics, before = suite.measure(decision), suite.measure(base)
    data = {
        "evaluations": count,
        "cost": cost(metrics),
        "decision": msgspec.to_builtins(decision),
        "trace": trace,
        "bounds": {b.key: [b.low, b.high] for b in BOUNDS},
        "seed": seed,
        "maxiter": maxiter,
        "popsize": popsize,
        "strategy": "best1bin",
        "scipy": scipy.__version__,
        "metrics": metrics.as_dict(),
        "start": {
            "decision": msgspec.to_builtins(base),
            "cost": cost(before),
            "metrics": before.as_dict(),
        },
    }
    table = ResultTable(
        "optimize",
        f"Optimiser, {count} evaluations",
        (
            "configuration",
            "cost",
            "N",
            "d_min, m",
            "d_max, m",
            "delta_min, m",
            "k",
            *METRIC_COLUMNS,
        ),
        [
            (
                name,
                round(value, 3),
                d.memory_frames,
                round(d.d_min_m, 3),
                round(d.d_max_m, 3),
                round(d.min_displacement_m, 4),
                d.lookback_frames,
                *cells(m.as_dict(), METRIC_COLUMNS),
            )
            for name, value, d, m in (
                ("configured", cost(before), base, before),
                ("found", cost(metrics), decision, metrics),
            )
        ],
    )
    return ExperimentResult("optimize", data, (table,))


def evaluations(maxiter: int = MAXITER, popsize: int = POPSIZE) -> int:
    """How many evaluations a search makes."""
    return popsize * len(BOUNDS) * (maxiter + 1)


def candidate_yaml(result: ExperimentResult, suite_hash: str, config_hash: str) -> str:
    """A file with the found decision section, and in comments where it comes from."""
    data = result.data
    section = msgspec.yaml.encode({"decision": data["decision"]}).decode()
    return (
        "# Candidate of `bikeped conformance optimize`; check it with `bikeped conformance gate`.\n"
        f"# cost {data['cost']:.6f} after {data['evaluations']} evaluations, seed {data['seed']}, "
        f"SciPy {data['scipy']}\n"
        f"# scenarios {suite_hash}\n"
        f"# configuration before {config_hash}\n"
        f"{section}"
    )
