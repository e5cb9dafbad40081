"""Monte Carlo: the suite with lost detections, many trials side by side in one tracker.

Every trial of every scenario draws from its own generator, seeded by seed, scenario name and trial
number (`perception.trial_generator`): results depend neither on the order of the scenarios nor on
how the trials are spread over processes, and all ways of losing detections share their draws.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bikeped.config import DecisionConfig, rule_settings
from bikeped.errors import BikepedError
from bikeped.lab.experiments.deterministic import ProgressCallback, no_progress, rounded_percent
from bikeped.lab.process_pool import worker_pool
from bikeped.lab.result_tables import ExperimentResult, ResultTable
from bikeped.lab.simulation.metrics import GroundTruthFrames, Metrics, measure
from bikeped.lab.simulation.perception import (
    PerceptionResult,
    RecallMode,
    RecallModel,
    missed_detections,
    trial_generator,
)
from bikeped.lab.simulation.simulate import (
    DetectionSequence,
    TrackHistory,
    build_rule_input,
    delay_history,
    states,
    track,
)
from bikeped.lab.simulation.suite import CONFIGURATIONS, Suite
from bikeped.types import BoolArray, FloatArray, KindArray

TRIALS = 50
BURST_FRAMES = 5.0
#: Bytes that the tracker's history of one chunk of lanes may take (some three times as much is in
#: use while it is turned into rows). Larger chunks are slower: they leave the cache.
CHUNK_BYTES = 60_000_000
#: Reported, id, kind, and three vectors, of one slot in one frame.
_SLOT_BYTES = 1 + 8 + 1 + 3 * 16

#: Delay in frames, order of the predictor.
Case = tuple[int, int]
#: Figures by trial: configuration's name to the metrics of each trial.
TrialMetrics = dict[str, list[Metrics]]


@dataclass(frozen=True)
class DetectableObjects:
    """What could be detected in one scenario: arrays over frames and agents [f, a].

    `xy_m` [f, a, 2] in the camera ground frame; `kind` [a]; `name` seeds the draws.
    """

    name: str
    xy_m: FloatArray
    recall: FloatArray
    present: BoolArray
    kind: KindArray

    @staticmethod
    def of(name: str, seen: PerceptionResult, recall: RecallModel) -> DetectableObjects:
        rate = recall.recall(np.broadcast_to(seen.kind, seen.area_px2.shape), seen.area_px2)
        return DetectableObjects(name, seen.observed_m, rate, seen.present, seen.kind)

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
    """One way of losing detections; `cases` are the delays in frames and the predictors' orders
    (0: none) under which the same losses are looked at."""

    recall: RecallModel
    burst: float | None
    cases: tuple[Case, ...] = ((0, 0),)


def simulate_trials(
    observed: Sequence[DetectableObjects],
    truth: GroundTruthFrames,
    plan: LossModel,
    configurations: Mapping[str, DecisionConfig],
    trials: Sequence[int],
    seed: int,
) -> dict[Case, TrialMetrics]:
    """Metrics of every trial by case and configuration; `truth` joins the scenarios of
    `observed` in their order."""
    return simulate_views([observed], truth, plan, configurations, trials, seed)[0]


def simulate_views(
    views: Sequence[Sequence[DetectableObjects]],
    truth: GroundTruthFrames,
    plan: LossModel,
    configurations: Mapping[str, DecisionConfig],
    trials: Sequence[int],
    seed: int,
) -> list[dict[Case, TrialMetrics]]:
    """The same of several views of the same scenarios (other cameras), in the same trackers."""
    every = [o for view in views for o in view]
    frames = max(len(o.xy_m) for o in every)
    slots = max(2 * max(o.xy_m.shape[1] for o in every), 4)
    size = max(1, CHUNK_BYTES // (truth.count * frames * slots * _SLOT_BYTES))
    units = [(view, trial) for view in range(len(views)) for trial in trials]
    found: list[dict[Case, TrialMetrics]] = [
        {case: {name: [] for name in configurations} for case in plan.cases} for _ in views
    ]
    for begin in range(0, len(units), size):
        part = units[begin : begin + size]
        scenes: list[DetectionSequence] = []
        for view in dict.fromkeys(v for v, _ in part):
            mine = [trial for v, trial in part if v == view]
            by_scenario = [o.trials(mine, seed, plan.burst) for o in views[view]]
            # Trial after trial, and in each the scenarios in their order: as `truth` has them.
            scenes += [lanes[i] for i in range(len(mine)) for lanes in by_scenario]
        tracked = track(scenes)
        for delay in dict.fromkeys(delay for delay, _ in plan.cases):
            late = delay_history(tracked, delay)
            for case in plan.cases:
                if case[0] != delay:
                    continue
                by_name = measure_repetitions(late, case[1], truth, configurations)
                for name, metrics in by_name.items():
                    for (view, _), one in zip(part, metrics, strict=True):
                        found[view][case][name].append(one)
    return found


def measure_repetitions(
    tracked: TrackHistory,
    order: int,
    truth: GroundTruthFrames,
    configurations: Mapping[str, DecisionConfig],
) -> TrialMetrics:
    """Metrics of every repetition of the suite among the lanes, by configuration."""
    run = build_rule_input(tracked, order)
    repeats = tracked.lanes // truth.count
    return {
        name: [
            measure(truth, part)
            for part in states(run, rule_settings(decision)).reshape(repeats, -1)
        ]
        for name, decision in configurations.items()
    }


def sorted_suite(suite: Suite) -> Suite:
    """The suite in order of names: sums of floats depend on their order, results must not."""
    return replace(suite, scenarios=tuple(sorted(suite.scenarios, key=lambda s: s.name)))


def simulate_suite_trials(
    suite: Suite,
    plan: LossModel,
    configurations: Mapping[str, DecisionConfig],
    trials: Sequence[int],
    seed: int,
) -> dict[Case, TrialMetrics]:
    """`simulate_trials` of a suite (in order of names), one job of a process."""
    observed = [
        DetectableObjects.of(s.name, seen, plan.recall)
        for s, seen in zip(suite.scenarios, suite.perception_results, strict=True)
    ]
    return simulate_trials(observed, suite.truth_frames, plan, configurations, trials, seed)


def run_trials(
    suite: Suite,
    plans: Sequence[LossModel],
    configurations: Mapping[str, DecisionConfig],
    trials: int,
    seed: int,
    processes: int = 1,
    progress: ProgressCallback = no_progress,
) -> list[dict[Case, TrialMetrics]]:
    """All plans over all trials; `suite` in order of names. Progress counts `trial_jobs`."""
    parts = [range(trials)[i :: _parts(trials)] for i in range(_parts(trials))]
    jobs = [(i, part) for i in range(len(plans)) for part in parts]
    done: dict[tuple[int, int], dict[Case, TrialMetrics]] = {}
    if processes > 1 and len(jobs) > 1:
        with worker_pool(min(processes, len(jobs))) as pool:
            waiting = {
                pool.submit(simulate_suite_trials, suite, plans[i], configurations, part, seed): (
                    i,
                    part,
                )
                for i, part in jobs
            }
            for count, future in enumerate(as_completed(waiting)):
                i, part = waiting[future]
                done[i, part.start] = future.result()
                progress(count + 1)
    else:
        for count, (i, part) in enumerate(jobs):
            done[i, part.start] = simulate_suite_trials(suite, plans[i], configurations, part, seed)
            progress(count + 1)
    merged = []
    for i, plan in enumerate(plans):
        whole: dict[Case, TrialMetrics] = {}
        for case in plan.cases:
            whole[case] = {}
            for name in configurations:
                row: list[Metrics | None] = [None] * trials
                for part in parts:
                    row[part.start :: len(parts)] = done[i, part.start][case][name]
                whole[case][name] = [m for m in row if m is not None]
        merged.append(whole)
    return merged


def trial_jobs(plans: int, trials: int) -> int:
    """How far the progress of `run_trials` counts."""
    return plans * _parts(trials)


def _parts(trials: int) -> int:
    """Into how many jobs the trials are cut: enough for a bar to move and for cores to share."""
    return min(trials, max(8, trials // 50))


def summarize(values: Iterable[float], most: float = float("inf")) -> dict[str, float | int | None]:
    """Mean over trials with its 95 % confidence interval (Student), and the trials' own spread.

    No figure lies below 0 or above `most` (1 for a share), so the interval ends there. Trials
    without the figure (NaN) are left out; null without any, no interval from one alone.
    """
    known = np.asarray([v for v in values if np.isfinite(v)], np.float64)
    count = len(known)
    if count == 0:
        empty = dict.fromkeys(("mean", "low", "high", "sd", "p2_5", "p97_5"))
        return {**empty, "trials": 0}
    mean, low_share, high_share = known.mean(), *np.percentile(known, [2.5, 97.5])
    sd = float(known.std(ddof=1)) if count > 1 else None
    half = None if sd is None else _student(count - 1) * sd / float(np.sqrt(count))
    return {
        "mean": float(mean),
        "low": None if half is None else max(0.0, float(mean - half)),
        "high": None if half is None else min(most, float(mean + half)),
        "sd": sd,
        "p2_5": float(low_share),
        "p97_5": float(high_share),
        "trials": count,
    }


#: Figures that are shares of something, at most 1.
_SHARES = frozenset(
    {"sensitivity", "specificity", "contact_sensitivity", "sev_fn", "fatigue", "adequate_share"}
)


def _most(figure: str) -> float:
    return 1.0 if figure in _SHARES else float("inf")


def _student(freedom: int) -> float:
    """97.5 % quantile of Student's t."""
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.975))


def summarize_metrics(metrics: Sequence[Metrics]) -> dict[str, Any]:
    """`summarize` of every figure of a metrics dictionary over trials."""
    rows = [m.as_dict() for m in metrics]
    return {key: summarize((_real(row[key]) for row in rows), _most(key)) for key in rows[0]}


def summarize_scenario(metrics: Sequence[Metrics], index: int) -> dict[str, Any]:
    """The same of one scenario's figures."""
    rows = [m.scenario_dict(index) for m in metrics]
    return {key: summarize((_real(row[key]) for row in rows), _most(key)) for key in rows[0]}


def _real(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def montecarlo(
    suite: Suite,
    configurations: Mapping[str, DecisionConfig] = CONFIGURATIONS,
    trials: int = TRIALS,
    seed: int = 0,
    burst: float = BURST_FRAMES,
    curve: tuple[tuple[float, ...], tuple[float, ...]] | None = None,
    processes: int = 1,
    progress: ProgressCallback = no_progress,
) -> ExperimentResult:
    """Independent and bursty losses, recall flat, by size and (when given) by curve.

    `by_scenario` tells the first configuration, independent losses, the finest recall given.
    """
    ordered = sorted_suite(suite)
    models = recall_models(curve)
    cases = [(loss, model) for loss in ("independent", "burst") for model in models]
    plans = [LossModel(model, burst if loss == "burst" else None) for loss, model in cases]
    found = run_trials(ordered, plans, configurations, trials, seed, processes, progress)
    rows: list[dict[str, Any]] = []
    for (loss, model), part in zip(cases, found, strict=True):
        for name, metrics in part[0, 0].items():
            case = {"loss": loss, "recall": model.mode, "configuration": name}
            rows.append({**case, "metrics": summarize_metrics(metrics)})
    detailed = len(models) - 1
    first = next(iter(configurations))
    by_scenario = {
        name: summarize_scenario(found[detailed][0, 0][first], ordered.names.index(name))
        for name in suite.names
    }
    data = {
        "trials": trials,
        "seed": seed,
        "burst": burst,
        "rows": rows,
        "by_scenario": by_scenario,
        "by_scenario_of": {
            "loss": "independent",
            "recall": models[detailed].mode,
            "configuration": first,
        },
    }
    if curve is not None:
        data["curve"] = {"area_px2": list(curve[0]), "recall": list(curve[1])}
    return ExperimentResult("montecarlo", data, tuple(_tables(data, burst, trials)))


def montecarlo_jobs(trials: int, curve: bool) -> int:
    """How far the progress of `montecarlo` counts."""
    return trial_jobs(6 if curve else 4, trials)


def _tables(data: Mapping[str, Any], burst: float, trials: int) -> Iterator[ResultTable]:
    columns = ("sens, %", "from, %", "to, %", "spec, %", "SevFN, %", "fatigue, %")
    ends = ("budget, s", "contact, %")
    note = (
        f"{trials} trials; from and to: 95 % confidence interval of the mean; bursts of {burst:g} "
        "frames on average"
    )

    def cells(metrics: Mapping[str, Any]) -> tuple[float | None, ...]:
        means = {key: value["mean"] for key, value in metrics.items()}
        budget = means["mean_warning_budget_s"]
        return (
            rounded_percent(means["sensitivity"]),
            rounded_percent(metrics["sensitivity"]["low"]),
            rounded_percent(metrics["sensitivity"]["high"]),
            rounded_percent(means["specificity"]),
            rounded_percent(means["sev_fn"]),
            rounded_percent(means["fatigue"]),
            None if budget is None else round(budget, 2),
            rounded_percent(means.get("contact_sensitivity")),
        )

    yield ResultTable(
        "montecarlo",
        "Monte Carlo",
        ("loss", "recall", "configuration", *columns, *ends),
        [(r["loss"], r["recall"], r["configuration"], *cells(r["metrics"])) for r in data["rows"]],
        note,
    )
    case = data["by_scenario_of"]
    yield ResultTable(
        "montecarlo_by_scenario",
        f"Monte Carlo by scenario: {case['configuration']}, {case['loss']}, {case['recall']}",
        ("scenario", *columns, ends[0]),
        [(name, *cells(metrics)[:-1]) for name, metrics in data["by_scenario"].items()],
        note,
    )


def recall_models(
    curve: tuple[tuple[float, ...], tuple[float, ...]] | None,
) -> list[RecallModel]:
    """From the coarsest to the finest."""
    modes: list[RecallMode] = ["flat", "size"]
    models = [RecallModel(mode) for mode in modes]
    return models if curve is None else [*models, RecallModel("curve", curve)]


def load_recall_curve(path: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Bin centres (square pixels at the network's input) and the recall of each bin.

    CSV with the two columns (a header is allowed), or JSON: a list of [centre, recall], or
    `{"area_px2": [...], "recall": [...]}`. BikepedError names the file and the mend.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BikepedError(f"{path}: cannot be read; check --recall-curve") from error
    try:
        pairs = _json_pairs(text) if path.suffix == ".json" else _csv_pairs(text)
        values = np.asarray(pairs, np.float64).reshape(-1, 2)
    except (ValueError, TypeError, KeyError, RecursionError, csv.Error) as error:
        raise BikepedError(
            f"{path}: is not a recall curve; write lines of bin centre, recall"
        ) from error
    centre, recall = values[:, 0], values[:, 1]
    if len(values) < 2 or not np.isfinite(values).all() or not (np.diff(centre) > 0).all():
        raise BikepedError(f"{path}: bin centre: needs two or more finite centres that increase")
    if centre[0] < 0 or recall.min() < 0 or recall.max() > 1:
        raise BikepedError(f"{path}: recall: expected 0 to 1 at centres from 0; correct the values")
    return tuple(centre.tolist()), tuple(recall.tolist())


def _json_pairs(text: str) -> list[Any]:
    data = json.loads(text)
    if isinstance(data, dict):
        return list(zip(data["area_px2"], data["recall"], strict=True))
    return list(data)


def _csv_pairs(text: str) -> list[list[float]]:
    lines = [line for line in csv.reader(io.StringIO(text)) if line]
    if lines:
        try:
            float(lines[0][0])
        except ValueError:
            lines = lines[1:]  # a header
    return [[float(a), float(b)] for a, b in lines]
