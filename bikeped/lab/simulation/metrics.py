"""Metrics of decisions against ground truth (definitions, section 6). Pure.

Everything is counted over flat arrays of frames, scenario after scenario: the optimiser evaluates
thousands of times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.decision.episodes import onsets
from bikeped.lab.simulation.simulate import FPS
from bikeped.lab.simulation.truth import PEDESTRIAN_PRT_S, GroundTruth
from bikeped.types import BoolArray, FloatArray, IntArray, State

#: An ALERT episode in which a pair came this near is a nuisance, not a false alarm.
NUISANCE_M = 5.0
NO_ALERT_LATENCY_S = 5.0
_JOINED = ("time_s", "danger", "actionable", "severity", "budget_s", "nearest_m")


@dataclass(frozen=True)
class GroundTruthFrames:
    """The ground truth of several scenarios (or trials), frame after frame."""

    start: IntArray
    scenario: IntArray  #: [f] which scenario a frame belongs to
    time_s: FloatArray
    danger: BoolArray
    actionable: BoolArray
    contact: BoolArray  #: actionable with a contact ahead within 5 s
    severity: FloatArray
    budget_s: FloatArray
    nearest_m: FloatArray
    closest_s: FloatArray  #: [scenario] time of the closest approach; NaN without a pair
    count: int

    @staticmethod
    def join(truths: Sequence[GroundTruth]) -> GroundTruthFrames:
        lengths = np.asarray([len(t.time_s) for t in truths])

        def joined(name: str) -> Any:
            return np.concatenate([getattr(truth, name) for truth in truths])

        closest = [
            t.time_s[np.argmin(t.nearest_m)] if np.isfinite(t.nearest_m).any() else np.nan
            for t in truths
        ]
        return GroundTruthFrames(
            start=np.concatenate([[0], np.cumsum(lengths)[:-1]]),
            scenario=np.repeat(np.arange(len(truths)), lengths),
            **{name: joined(name) for name in _JOINED},
            contact=joined("actionable") & np.isfinite(joined("ttc_s")),
            closest_s=np.asarray(closest),
            count=len(truths),
        )


@dataclass(frozen=True)
class Metrics:
    """Totals and metrics by scenario; NaN where there is nothing to count (definitions, 6 and 14).

    All are of the shown state, but for `specificity` with its counts and `contact_sensitivity_raw`,
    which are of the raw one. `specificity_shown` leaves held frames out of both counts,
    `specificity_strict` counts those without danger as false.

    `by_scenario` holds arrays [n] by their JSON key: `sensitivity`, `specificity`, `sev_fn` (NaN
    without actionable frames), `fatigue`, `alert_latency_s` (infinite when no ALERT follows, NaN
    without actionable frames), `mean_warning_budget_s` and `min_warning_budget_s` (NaN without an
    onset), `first_onset_lead_s` (NaN without an ALERT).
    """

    true_positive: int
    false_positive: int
    false_negative: int
    true_negative: int
    held_frames: int
    sensitivity: float
    specificity: float
    specificity_shown: float
    specificity_strict: float
    contact_sensitivity: float
    contact_sensitivity_raw: float
    sev_fn: float
    fatigue: float
    mean_alert_latency_s: float
    mean_warning_budget_s: float
    adequate_share: float
    false_episodes_per_hour: float
    nuisance_episodes_per_hour: float
    alerts_with_danger: float
    first_onset_lead_s: float
    by_scenario: Mapping[str, FloatArray]

    def as_dict(self) -> dict[str, Any]:
        """The totals for JSON: metrics (null: nothing to count), then frame counts."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "by_scenario"}
        counts = {name: values.pop(name) for name in _COUNTS}
        return {**{name: finite_or_none(value) for name, value in values.items()}, **counts}

    def scenario_dict(self, index: int) -> dict[str, Any]:
        """One scenario's metrics for JSON."""
        return {key: finite_or_none(values[index]) for key, values in self.by_scenario.items()}


_COUNTS = ("true_positive", "false_positive", "false_negative", "true_negative", "held_frames")


def finite_or_none(value: float) -> float | None:
    """A number for JSON: null for NaN and infinity."""
    return float(value) if np.isfinite(value) else None


def measure(
    truth: GroundTruthFrames, states: npt.NDArray[np.int8], raw: npt.NDArray[np.int8] | None = None
) -> Metrics:
    """All metrics of shown states [f] against the ground truth of the same frames.

    `raw` [f] are the rule's own states; None: those that are shown.
    """
    alert = states == int(State.ALERT)
    raw_alert = alert if raw is None else raw == int(State.ALERT)
    held = alert & ~raw_alert
    n, scenario = truth.count, truth.scenario

    def per(mask: BoolArray, weights: FloatArray | None = None) -> FloatArray:
        """Frames in `mask`, or the sum of their weights, by scenario."""
        part = None if weights is None else weights[mask]
        return np.bincount(scenario[mask], part, minlength=n).astype(np.float64)

    hit, missed = alert & truth.actionable, ~alert & truth.actionable
    tp, fn = per(hit), per(missed)
    fp, tn = per(raw_alert & ~truth.danger), per(~raw_alert & ~truth.danger)
    calm, fresh = ~truth.danger, ~truth.danger & ~held
    frames = np.bincount(scenario, minlength=n)
    weight = per(truth.actionable, truth.severity)
    sev_fn = _ratio(per(missed, truth.severity), weight)
    sev_fn = np.where((tp + fn > 0) & np.isnan(sev_fn), 0.0, sev_fn)  # actionable at speed 0
    fatigue = per(alert) / frames
    onset = onsets(alert, truth.start)
    counted = onset & np.isfinite(truth.budget_s)
    budgets = truth.budget_s[counted]
    budget_count = per(counted)
    mean_budget = _ratio(per(counted, truth.budget_s), budget_count)
    min_budget: FloatArray = np.full(n, np.inf)
    np.minimum.at(min_budget, scenario[counted], budgets)
    min_budget = np.where(budget_count > 0, min_budget, np.nan)
    latency = _alert_latency(truth, alert)
    first_alert = np.full(n, np.inf)
    np.minimum.at(first_alert, scenario[alert], truth.time_s[alert])
    false, nuisance, justified = _episodes(truth, alert, onset)
    hours = len(alert) / FPS / 3600
    lead_s = np.where(np.isfinite(first_alert), truth.closest_s - first_alert, np.nan)
    return Metrics(
        true_positive=int(tp.sum()),
        false_positive=int(fp.sum()),
        false_negative=int(fn.sum()),
        true_negative=int(tn.sum()),
        held_frames=int(held.sum()),
        sensitivity=_share(tp.sum(), fn.sum()),
        specificity=_share(tn.sum(), fp.sum()),
        specificity_shown=_share((fresh & ~alert).sum(), (fresh & alert).sum()),
        specificity_strict=_share((calm & ~alert).sum(), (calm & alert).sum()),
        contact_sensitivity=_share((truth.contact & alert).sum(), (truth.contact & ~alert).sum()),
        contact_sensitivity_raw=_share(
            (truth.contact & raw_alert).sum(), (truth.contact & ~raw_alert).sum()
        ),
        sev_fn=mean_known(sev_fn),
        fatigue=float(fatigue.mean()),
        mean_alert_latency_s=mean_known(np.where(np.isinf(latency), NO_ALERT_LATENCY_S, latency)),
        mean_warning_budget_s=mean_known(mean_budget),
        adequate_share=_share(
            int((budgets > PEDESTRIAN_PRT_S).sum()), int((budgets <= PEDESTRIAN_PRT_S).sum())
        ),
        false_episodes_per_hour=false / hours,
        nuisance_episodes_per_hour=nuisance / hours,
        alerts_with_danger=_share(justified, false + nuisance),
        first_onset_lead_s=mean_known(lead_s),
        by_scenario={
            "sensitivity": _ratio(tp, tp + fn),
            "specificity": _ratio(tn, tn + fp),
            "sev_fn": sev_fn,
            "fatigue": fatigue,
            "alert_latency_s": latency,
            "mean_warning_budget_s": mean_budget,
            "min_warning_budget_s": min_budget,
            "first_onset_lead_s": lead_s,
        },
    )


def _alert_latency(truth: GroundTruthFrames, alert: BoolArray) -> FloatArray:
    """By scenario: from the first actionable frame to the next ALERT frame."""
    n = truth.count
    first = np.full(n, np.inf)
    at = truth.actionable
    np.minimum.at(first, truth.scenario[at], truth.time_s[at])
    later = alert & (truth.time_s >= first[truth.scenario])
    answered = np.full(n, np.inf)
    np.minimum.at(answered, truth.scenario[later], truth.time_s[later])
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(first), answered - first, np.nan)


def _episodes(truth: GroundTruthFrames, alert: BoolArray, onset: BoolArray) -> tuple[int, int, int]:
    """ALERT episodes without a danger frame: false alarms, nuisances; and those with one."""
    if not alert.any():
        return 0, 0, 0
    episode = np.cumsum(onset) - 1
    count = int(onset.sum())
    dangerous = np.bincount(episode[alert], truth.danger[alert], minlength=count) > 0
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, episode[alert], truth.nearest_m[alert])
    harmless = ~dangerous
    near = nearest <= NUISANCE_M
    return int((harmless & ~near).sum()), int((harmless & near).sum()), int(dangerous.sum())


def _share(part: float, rest: float) -> float:
    return float(part / (part + rest)) if part + rest else float("nan")


def _ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    return np.where(whole > 0, part / np.where(whole > 0, whole, 1.0), np.nan)


def mean_known(values: FloatArray) -> float:
    """The mean of those that are not NaN; NaN where all are."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")
