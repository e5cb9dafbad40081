"""Monte Carlo: a suite with missed detections, many trials side by side in one tracker.

Every trial of every scenario draws from its own generator, seeded by seed, scenario name and trial
number (`perception.trial_generator`). So results depend neither on the order of the scenarios nor
on how the trials are spread over processes, and all loss models share their draws.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bikeped.config.schema import DecisionConfig
from bikeped.lab.plotting import to_floats
from bikeped.lab.process_pool import ProgressCallback, no_progress, run_jobs
from bikeped.lab.result_tables import ExperimentResult, ResultTable
from bikeped.lab.simulation.metrics import GroundTruthFrames, Metrics, measure
from bikeped.lab.simulation.perception import (
    PerceptionResult,
    RecallCurve,
    RecallModel,
    missed_detections,
    recall_models,
    trial_generator,
)
from bikeped.lab.simulation.simulate import (
    DetectionSequence,
    RuleInput,
    SimulatedTracker,
    TrackHistory,
    build_rule_input,
    delay_history,
    outcome,
    track,
)
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite
from bikeped.types import BoolArray, FloatArray, KindArray

TRIALS = 50
#: Bytes that the tracker's history of one batch may take; about three times as much is in use while
#: it is turned into rows. Larger batches are slower: they leave the cache.
BATCH_BYTES = 60_000_000
#: Reported, id, kind, parked, time, and three vectors, of one slot in one frame.
_SLOT_BYTES = 1 + 8 + 1 + 1 + 8 + 3 * 16

#: Delay in frames, order of the predictor.
Case = tuple[int, int]
#: Configuration's name to the metrics of each trial.
TrialMetrics = dict[str, list[Metrics]]


@dataclass(frozen=True)
class DetectableObjects:
    """What can be detected in one scenario: arrays over frames and agents [f, a].

    `xy_m` [f, a, 2] in the camera ground frame; `kind` [a]; `name` seeds the draws.
    """

    name: str
    xy_m: FloatArray
    recall: FloatArray
    present: BoolArray
    kind: KindArray

    @staticmethod
    def of(name: str, seen: PerceptionResult, recall: RecallModel) -> DetectableObjects:
        return DetectableObjects(
            name, seen.observed_m, seen.recall(recall), seen.present, seen.kind
        )

    def trials(
        self, trials: Sequence[int], seed: int, burst: float | None
    ) -> list[DetectionSequence]:
        """The detections of each trial."""
        draw = np.stack(
            [trial_generator(seed, self.name, t).random(self.recall.shape) for t in trials], axis=1
        )
        missed = missed_detections(draw, self.recall[:, None], self.present[:, None], burst)
        return [
            DetectionSequence(self.xy_m, self.present & ~missed[:, i], self.kind)
            for i in range(len(trials))
        ]


@dataclass(frozen=True)
class LossModel:
    """How detections are missed: recall, and the mean length of a burst in frames (None:
    independent). `cases` are the delays in frames and the predictors' orders (0: none) that are
    measured with the same misses."""

    recall: RecallModel
    burst: float | None
    cases: tuple[Case, ...] = ((0, 0),)


def simulate_trials(
    observed: Sequence[DetectableObjects],
    truth: GroundTruthFrames,
    loss: LossModel,
    configurations: Mapping[str, DecisionConfig],
    trials: Sequence[int],
    seed: int,
    tracker: SimulatedTracker,
) -> dict[Case, TrialMetrics]:
    """Metrics of every trial by case and configuration; `truth` joins the scenarios of
    `observed` in their order."""
    return simulate_views([observed], truth, loss, configurations, trials, seed, tracker)[0]


def simulate_views(
    views: Sequence[Sequence[DetectableObjects]],
    truth: GroundTruthFrames,
    loss: LossModel,
    configurations: Mapping[str, DecisionConfig],
    trials: Sequence[int],
    seed: int,
    tracker: SimulatedTracker,
) -> list[dict[Case, TrialMetrics]]:
    """`simulate_trials` for several views (other cameras) of the same scenarios, in one tracker."""
    every = [o for view in views for o in view]
    frames = max(len(o.xy_m) for o in every)
    slots = max(2 * max(o.xy_m.shape[1] for o in every), 4)
    size = max(1, BATCH_BYTES // (truth.count * frames * slots * _SLOT_BYTES))
    units = [(view, trial) for view in range(len(views)) for trial in trials]
    found: list[dict[Case, TrialMetrics]] = [
        {case: {name: [] for name in configurations} for case in loss.cases} for _ in views
    ]
    for begin in range(0, len(units), size):
        part = units[begin : begin + size]
        scenes: list[DetectionSequence] = []
        for view in dict.fromkeys(v for v, _ in part):
            mine = [trial for v, trial in part if v == view]
            by_scenario = [o.trials(mine, seed, loss.burst) for o in views[view]]
            # Trial after trial, and in each the scenarios in their order: as `truth` has them.
            scenes += [sequences[i] for i in range(len(mine)) for sequences in by_scenario]
        tracked = track(scenes, tracker)
        for delay in dict.fromkeys(delay for delay, _ in loss.cases):
            late = delay_history(tracked, delay)
            for case in (c for c in loss.cases if c[0] == delay):
                by_name = measure_repetitions(late, case[1], truth, configurations, tracker)
                for name, metrics in by_name.items():
                    for (view, _), one in zip(part, metrics, strict=True):
                        found[view][case][name].append(one)
    return found


def measure_repetitions(
    tracked: TrackHistory,
    order: int,
    truth: GroundTruthFrames,
    configurations: Mapping[str, DecisionConfig],
    tracker: SimulatedTracker,
) -> TrialMetrics:
    """Metrics of every repetition of the suite in the batch, by configuration."""
    repeats = len(tracked.frames) // truth.count
    runs: dict[float, RuleInput] = {}  # who counts is the same for most configurations
    metrics: TrialMetrics = {}
    for name, decision in configurations.items():
        settings = tracker.rule(decision)
        if settings.max_unseen_s not in runs:
            runs[settings.max_unseen_s] = build_rule_input(tracked, order, settings)
        found = outcome(runs[settings.max_unseen_s], settings)
        parts = zip(found.states.reshape(repeats, -1), found.raw.reshape(repeats, -1), strict=True)
        metrics[name] = [measure(truth, *part) for part in parts]
    return metrics


def sorted_suite(suite: Suite) -> Suite:
    """The suite in order of names: sums of floats depend on their order, results must not."""
    return replace(suite, scenarios=tuple(sorted(suite.scenarios, key=lambda s: s.name)))


def simulate_suite_trials(
    suite: Suite,
    loss: LossModel,
    configurations: Mapping[str, DecisionConfig],
    trials: Sequence[int],
    seed: int,
) -> dict[Case, TrialMetrics]:
    """`simulate_trials` of a suite (in order of names), one job of a process."""
    observed = [
        DetectableObjects.of(s.name, seen, loss.recall)
        for s, seen in zip(suite.scenarios, suite.perception_results, strict=True)
    ]
    return simulate_trials(
        observed, suite.truth_frames, loss, configurations, trials, seed, suite.tracker
    )


def run_trials(
    suite: Suite,
    losses: Sequence[LossModel],
    configurations: Mapping[str, DecisionConfig],
    trials: int,
    seed: int,
    processes: int = 1,
    progress: ProgressCallback = no_progress,
) -> list[dict[Case, TrialMetrics]]:
    """All loss models over all trials; `suite` in order of names. Progress counts `trial_jobs`."""
    step = _parts(trials)
    jobs = [
        (suite, loss, configurations, range(trials)[part::step], seed)
        for loss in losses
        for part in range(step)
    ]
    done = run_jobs(simulate_suite_trials, jobs, processes, progress)
    return [
        {
            case: {
                name: [done[i * step + t % step][case][name][t // step] for t in range(trials)]
                for name in configurations
            }
            for case in loss.cases
        }
        for i, loss in enumerate(losses)
    ]


def trial_jobs(losses: int, trials: int) -> int:
    """How far the progress of `run_trials` counts."""
    return losses * _parts(trials)


def _parts(trials: int) -> int:
    """Number of jobs that the trials are cut into: enough for a progress bar and all cores."""
    return min(trials, max(8, trials // 50))


def summarize(values: Iterable[float], most: float = float("inf")) -> dict[str, float | int | None]:
    """Mean over trials with its 95 % confidence interval (Student), and the trials' own spread.

    No figure lies below 0 or above `most` (1 for a share), so the interval ends there. Trials
    without the figure (NaN) are left out; null without any, no interval from one alone.
    """
    from scipy.special import stdtrit

    known = np.asarray([v for v in values if np.isfinite(v)], np.float64)
    count = len(known)
    if count == 0:
        empty = dict.fromkeys(("mean", "low", "high", "sd", "p2_5", "p97_5"))
        return {**empty, "trials": 0}
    mean, low_share, high_share = known.mean(), *np.percentile(known, [2.5, 97.5])
    sd = float(known.std(ddof=1)) if count > 1 else None
    half = None if sd is None else float(stdtrit(count - 1, 0.975)) * sd / float(np.sqrt(count))
    return {
        "mean": float(mean),
        "low": None if half is None else max(0.0, float(mean - half)),
        "high": None if half is None else min(most, float(mean + half)),
        "sd": sd,
        "p2_5": float(low_share),
        "p97_5": float(high_share),
        "trials": count,
    }


#: Metrics that are shares, at most 1.
_SHARES = frozenset(
    {"sensitivity", "specificity", "contact_sensitivity", "sev_fn", "fatigue", "adequate_share"}
)


def summarize_metrics(metrics: Sequence[Metrics]) -> dict[str, Any]:
    """`summarize` of every key of a metrics dictionary over trials."""
    return _summarize_rows([m.as_dict() for m in metrics])


def summarize_scenario(metrics: Sequence[Metrics], index: int) -> dict[str, Any]:
    """`summarize` of every key of one scenario's metrics over trials."""
    return _summarize_rows([m.scenario_dict(index) for m in metrics])


def _summarize_rows(rows: Sequence[Mapping[str, float | None]]) -> dict[str, Any]:
    return {
        key: summarize(to_floats(row[key] for row in rows), 1.0 if key in _SHARES else np.inf)
        for key in rows[0]
    }


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
