"""Camera latency: detections come late, the world goes on (paper, section 4.7).

The state of a frame is compared with the truth of that frame, not of the capture time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bikeped.config.schema import DecisionConfig
from bikeped.lab.experiments.deterministic import METRIC_COLUMNS
from bikeped.lab.experiments.trials import (
    TRIALS,
    LossModel,
    measure_repetitions,
    run_trials,
    sorted_suite,
    summarize_metrics,
)
from bikeped.lab.process_pool import ProgressCallback, no_progress
from bikeped.lab.result_tables import ExperimentResult, ResultTable, cells
from bikeped.lab.simulation.perception import RecallModel
from bikeped.lab.simulation.simulate import FPS, track
from bikeped.lab.simulation.suite import Suite

#: 0 to 500 ms in steps of one frame.
DELAYS_MS = tuple(range(0, 500, 33))
#: The coarser steps at which latency is combined with loss.
LOSS_DELAYS_MS = (0, 66, 132, 198, 330, 495)
PREDICTORS = {"none": 0, "first": 1, "second": 2}
#: The figures of the sweep's lists, over `delay_ms`.
FIGURES = (
    "sensitivity",
    "specificity",
    "sev_fn",
    "fatigue",
    "mean_warning_budget_s",
    "contact_sensitivity",
    "mean_alert_latency_s",
    "adequate_share",
)


def delay_frames(delay_ms: float) -> int:
    """Whole frames of a latency (definitions, section 7)."""
    return round(delay_ms * FPS / 1000)


def sweep(
    suite: Suite, decision: DecisionConfig, delays_ms: Sequence[float] = DELAYS_MS
) -> ExperimentResult:
    """Every latency with every predictor, without misses: all in one batch of the tracker."""
    scenes = [
        s for ms in delays_ms for s in suite.detection_sequences(delay_frames=delay_frames(ms))
    ]
    tracked = track(scenes, suite.tracker)
    data: dict[str, Any] = {"delay_ms": list(delays_ms)}
    for name, order in PREDICTORS.items():
        found = measure_repetitions(
            tracked, order, suite.truth_frames, {"": decision}, suite.tracker
        )[""]
        rows = [metrics.as_dict() for metrics in found]
        data[name] = {figure: [row[figure] for row in rows] for figure in FIGURES}
    return ExperimentResult("latency", data, (_table(data, "latency", "Camera latency"),))


def _table(data: Mapping[str, Any], name: str, title: str) -> ResultTable:
    return ResultTable(
        name,
        title,
        ("predictor", "delay, ms", *METRIC_COLUMNS),
        [
            (predictor, ms, *cells({k: values[i] for k, values in lists.items()}, METRIC_COLUMNS))
            for predictor in PREDICTORS
            for lists in (data[predictor],)
            for i, ms in enumerate(data["delay_ms"])
        ],
        "predictor: how tracks are moved ahead by the latency (none, velocity, acceleration)",
    )


def sweep_with_loss(
    suite: Suite,
    decision: DecisionConfig,
    delays_ms: Sequence[float] = LOSS_DELAYS_MS,
    recall: RecallModel | None = None,
    burst: float | None = None,
    trials: int = TRIALS,
    seed: int = 0,
    processes: int = 1,
    progress: ProgressCallback = no_progress,
) -> ExperimentResult:
    """Latency and missed detections together; by default recall by size, independent misses."""
    model = recall or RecallModel("size")
    cases = [(delay_frames(ms), order) for ms in delays_ms for order in PREDICTORS.values()]
    loss = LossModel(model, burst, tuple(dict.fromkeys(cases)))
    found = run_trials(
        sorted_suite(suite), [loss], {"": decision}, trials, seed, processes, progress
    )[0]
    predictors: dict[str, Any] = {}
    for name, order in PREDICTORS.items():
        by_delay = [summarize_metrics(found[delay_frames(ms), order][""]) for ms in delays_ms]
        predictors[name] = {
            figure: {
                key: [row[figure][key] for row in by_delay]
                for key in ("mean", "low", "high", "sd", "p2_5", "p97_5")
            }
            for figure in FIGURES
        }
    data = {
        "delay_ms": list(delays_ms),
        "trials": trials,
        "seed": seed,
        "recall": model.mode,
        "loss": "independent" if burst is None else "burst",
        "burst": burst,
        "predictors": predictors,
    }
    means = {
        "delay_ms": data["delay_ms"],
        **{
            name: {figure: values["mean"] for figure, values in figures.items()}
            for name, figures in predictors.items()
        },
    }
    table = _table(means, "latency_loss", f"Camera latency with loss, mean of {trials} trials")
    return ExperimentResult("latency_loss", data, (table,))
