"""The figures of a run (definitions, section 6), from states and truth. Pure.

Everything is counted over flat arrays of frames, scenario after scenario, so that the optimiser can
ask thousands of times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.decision.episodes import onsets
from bikeped.lab.simulation.simulate import FPS
from bikeped.lab.simulation.truth import PEDESTRIAN_PRT_S, GroundTruth
from bikeped.types import BoolArray, FloatArray, IntArray, State

#: An episode in which a cyclist and a pedestrian came this near is a nuisance, not a false alarm.
NUISANCE_M = 5.0
NO_ALERT_LATENCY_S = 5.0


@dataclass(frozen=True)
class GroundTruthFrames:
    """The truths of several scenarios (or trials), frame after frame."""

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
    count: int = field(default=0)

    @staticmethod
    def join(truths: Sequence[GroundTruth]) -> GroundTruthFrames:
        lengths = np.asarray([len(t.time_s) for t in truths])
        closest = [
            float(t.time_s[int(np.argmin(t.nearest_m))])
            if np.isfinite(t.nearest_m).any()
            else np.nan
            for t in truths
        ]
        return GroundTruthFrames(
            start=np.concatenate([[0], np.cumsum(lengths)[:-1]]),
            scenario=np.repeat(np.arange(len(truths)), lengths),
            time_s=np.concatenate([t.time_s for t in truths]),
            danger=np.concatenate([t.danger for t in truths]),
            actionable=np.concatenate([t.actionable for t in truths]),
            contact=np.concatenate([t.actionable & np.isfinite(t.ttc_s) for t in truths]),
            severity=np.concatenate([t.severity for t in truths]),
            budget_s=np.concatenate([t.budget_s for t in truths]),
            nearest_m=np.concatenate([t.nearest_m for t in truths]),
            closest_s=np.asarray(closest),
            count=len(truths),
        )


@dataclass(frozen=True)
class Metrics:
    """Totals and per-scenario figures; a figure that has nothing to count is NaN.

    Per scenario [n]: `sev_fn` (NaN without actionable frames), `fatigue`, `alert_latency_s`
    (infinite when no ALERT follows, NaN without actionable frames), `mean_budget_s` and
    `min_budget_s` (NaN without an onset), `first_onset_lead_s` (NaN without an ALERT).
    """

    true_positive: int
    false_positive: int
    false_negative: int
    true_negative: int
    sensitivity: float
    specificity: float
    contact_sensitivity: float
    sev_fn: float
    fatigue: float
    mean_alert_latency_s: float
    mean_warning_budget_s: float
    adequate_share: float
    false_episodes_per_hour: float
    nuisance_episodes_per_hour: float
    scenario_sensitivity: FloatArray
    scenario_specificity: FloatArray
    scenario_sev_fn: FloatArray
    scenario_fatigue: FloatArray
    scenario_alert_latency_s: FloatArray
    scenario_mean_budget_s: FloatArray
    scenario_min_budget_s: FloatArray
    scenario_first_onset_lead_s: FloatArray

    def as_dict(self) -> dict[str, Any]:
        """The totals for JSON; a figure that is not there is null."""
        return {
            "sensitivity": finite_or_none(self.sensitivity),
            "specificity": finite_or_none(self.specificity),
            "contact_sensitivity": finite_or_none(self.contact_sensitivity),
            "sev_fn": finite_or_none(self.sev_fn),
            "fatigue": finite_or_none(self.fatigue),
            "mean_alert_latency_s": finite_or_none(self.mean_alert_latency_s),
            "mean_warning_budget_s": finite_or_none(self.mean_warning_budget_s),
            "adequate_share": finite_or_none(self.adequate_share),
            "false_episodes_per_hour": finite_or_none(self.false_episodes_per_hour),
            "nuisance_episodes_per_hour": finite_or_none(self.nuisance_episodes_per_hour),
            "true_positive": self.true_positive,
            "false_positive": self.false_positive,
            "false_negative": self.false_negative,
            "true_negative": self.true_negative,
        }

    def scenario_dict(self, index: int) -> dict[str, Any]:
        """One scenario's figures for JSON."""
        return {
            "sensitivity": finite_or_none(self.scenario_sensitivity[index]),
            "specificity": finite_or_none(self.scenario_specificity[index]),
            "sev_fn": finite_or_none(self.scenario_sev_fn[index]),
            "fatigue": finite_or_none(self.scenario_fatigue[index]),
            "alert_latency_s": finite_or_none(self.scenario_alert_latency_s[index]),
            "mean_warning_budget_s": finite_or_none(self.scenario_mean_budget_s[index]),
            "min_warning_budget_s": finite_or_none(self.scenario_min_budget_s[index]),
            "first_onset_lead_s": finite_or_none(self.scenario_first_onset_lead_s[index]),
        }


def finite_or_none(value: float) -> float | None:
    """A figure for JSON: null where there is none."""
    return float(value) if np.isfinite(value) else None


def measure(truth: GroundTruthFrames, states: npt.NDArray[np.int8]) -> Metrics:
    """All figures of states [f] against the truth of the same frames."""
    alert = states == int(State.ALERT)
    n, scenario = truth.count, truth.scenario

    def per(mask: BoolArray, weights: FloatArray | None = None) -> FloatArray:
        """Frames in `mask`, or the sum of their weights, by scenario."""
        part = None if weights is None else weights[mask]
        return np.bincount(scenario[mask], part, minlength=n).astype(np.float64)

    hit, missed = alert & truth.actionable, ~alert & truth.actionable
    tp, fn = per(hit), per(missed)
    fp, tn = per(alert & ~truth.danger), per(~alert & ~truth.danger)
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
    false, nuisance = _episodes(truth, alert, onset)
    hours = len(alert) / FPS / 3600
    contact_hit = int((hit & truth.contact).sum())
    return Metrics(
        true_positive=int(tp.sum()),
        false_positive=int(fp.sum()),
        false_negative=int(fn.sum()),
        true_negative=int(tn.sum()),
        sensitivity=_share(tp.sum(), fn.sum()),
        specificity=_share(tn.sum(), fp.sum()),
        contact_sensitivity=_share(contact_hit, int(truth.contact.sum()) - contact_hit),
        sev_fn=_mean(sev_fn),
        fatigue=float(fatigue.mean()),
        mean_alert_latency_s=_mean(np.where(np.isinf(latency), NO_ALERT_LATENCY_S, latency)),
        mean_warning_budget_s=_mean(mean_budget),
        adequate_share=_share(
            int((budgets > PEDESTRIAN_PRT_S).sum()), int((budgets <= PEDESTRIAN_PRT_S).sum())
        ),
        false_episodes_per_hour=false / hours,
        nuisance_episodes_per_hour=nuisance / hours,
        scenario_sensitivity=_ratio(tp, tp + fn),
        scenario_specificity=_ratio(tn, tn + fp),
        scenario_sev_fn=sev_fn,
        scenario_fatigue=fatigue,
        scenario_alert_latency_s=latency,
        scenario_mean_budget_s=mean_budget,
        scenario_min_budget_s=min_budget,
        scenario_first_onset_lead_s=np.where(
            np.isfinite(first_alert), truth.closest_s - first_alert, np.nan
        ),
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


def _episodes(truth: GroundTruthFrames, alert: BoolArray, onset: BoolArray) -> tuple[int, int]:
    """ALERT episodes without a danger frame: false ones, and nuisances (a pair came near)."""
    if not alert.any():
        return 0, 0
    episode = np.cumsum(onset) - 1
    count = int(onset.sum())
    dangerous = np.bincount(episode[alert], truth.danger[alert], minlength=count) > 0
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, episode[alert], truth.nearest_m[alert])
    harmless = ~dangerous
    near = nearest <= NUISANCE_M
    return int((harmless & ~near).sum()), int((harmless & near).sum())


def _share(part: float, rest: float) -> float:
    return float(part / (part + rest)) if part + rest else float("nan")


def _ratio(part: FloatArray, whole: FloatArray) -> FloatArray:
    return np.where(whole > 0, part / np.where(whole > 0, whole, 1.0), np.nan)


def _mean(values: FloatArray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")
