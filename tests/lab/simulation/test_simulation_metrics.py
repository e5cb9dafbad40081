"""Metrics against definitions, section 6, as a plain loop, and against traces made by hand."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.lab.simulation.metrics import GroundTruthFrames, finite_or_none, measure
from bikeped.lab.simulation.truth import GroundTruth
from bikeped.types import State

INF, NAN = math.inf, math.nan
W, A = int(State.WARNING), int(State.ALERT)

#: danger, ttc_s, severity, budget_s, nearest_m, state of one frame.
FRAME = st.tuples(
    st.booleans(),
    st.sampled_from([INF, 0.0, 1.8, 1.85, 1.9, 3.0, 4.95]),
    st.sampled_from([0.0, 0.25, 0.5, 1.0]),
    st.sampled_from([INF, 0.0, 1.85, 1.9, 2.5, 4.0]),
    st.sampled_from([INF, 0.5, 4.9, 5.0, 5.1, 30.0]),
    st.sampled_from([0, 1, W, A, A]),
)
SCENARIOS = st.lists(st.lists(FRAME, min_size=1, max_size=40), min_size=1, max_size=5)


def truth_of(frames):
    danger, ttc, severity, budget, nearest, _ = (
        np.array(v) for v in zip(*frames, strict=True)
    )  # fmt: skip
    count = len(frames)
    return GroundTruth(
        time_s=np.arange(count) / 30,
        danger=danger,
        actionable=danger & (ttc >= 1.87),
        severity=np.where(danger, severity, 0.0),
        ttc_s=ttc,
        d_min_m=nearest,
        budget_s=budget,
        distance_m=nearest,
        cyclist=np.zeros(count, np.int64),
        pedestrian=np.ones(count, np.int64),
        nearest_m=nearest,
    )


def measured(scenarios):
    states = np.array([f[5] for frames in scenarios for f in frames], np.int8)
    return measure(GroundTruthFrames.join([truth_of(f) for f in scenarios]), states)


def ratio(part, whole):
    return part / whole if whole else NAN


def mean(values):
    known = [v for v in values if not math.isnan(v)]
    return sum(known) / len(known) if known else NAN


def one_by_hand(frames):
    """The figures of one scenario, in a loop over its frames."""
    out = dict.fromkeys(("tp", "fn", "fp", "tn", "contact", "contact_hit", "alerts"), 0)
    missed = weight = 0.0
    first_actionable = answered = first_alert = None
    nearest, closest = INF, NAN
    budgets, episodes, before = [], [], False
    for i, (danger, ttc, severity, budget, near, state) in enumerate(frames):
        alert, actionable = state == A, danger and ttc >= 1.87
        if actionable:
            out["tp" if alert else "fn"] += 1
            weight += severity
            missed += 0 if alert else severity
            first_actionable = i if first_actionable is None else first_actionable
            if ttc < INF:
                out["contact"] += 1
                out["contact_hit"] += alert
        if not danger:
            out["fp" if alert else "tn"] += 1
        if alert:
            out["alerts"] += 1
            first_alert = i if first_alert is None else first_alert
            if first_actionable is not None and answered is None:
                answered = i
            if not before:
                episodes.append([])
                if budget < INF:
                    budgets.append(budget)
            episodes[-1].append((danger, near))
        if near < nearest:
            nearest, closest = near, i / 30
        before = alert
    harmless = [min(n for _, n in e) for e in episodes if not any(d for d, _ in e)]
    if not out["tp"] + out["fn"]:
        sev_fn = latency = NAN
    else:
        sev_fn = missed / weight if weight else 0.0
        latency = INF if answered is None else (answered - first_actionable) / 30
    return out | {
        "sev_fn": sev_fn,
        "latency": latency,
        "budgets": budgets,
        "fatigue": out["alerts"] / len(frames),
        "lead": NAN if first_alert is None else closest - first_alert / 30,
        "false": sum(n > 5 for n in harmless),
        "nuisance": sum(n <= 5 for n in harmless),
    }


def same(value, expected):
    assert value == pytest.approx(expected, abs=1e-12, nan_ok=True)


@settings(derandomize=True, deadline=None, max_examples=150)
@given(SCENARIOS)
def test_any_sequence_against_a_plain_loop(scenarios):
    found = measured(scenarios)
    each = [one_by_hand(f) for f in scenarios]

    def total(key):
        return sum(e[key] for e in each)

    tp, fn, fp, tn = (total(k) for k in ("tp", "fn", "fp", "tn"))
    assert (
        found.true_positive, found.false_negative, found.false_positive, found.true_negative,
    ) == (tp, fn, fp, tn)  # fmt: skip
    same(found.sensitivity, ratio(tp, tp + fn))
    same(found.specificity, ratio(tn, tn + fp))
    same(found.contact_sensitivity, ratio(total("contact_hit"), total("contact")))
    same(found.sev_fn, mean([e["sev_fn"] for e in each]))
    same(found.fatigue, mean([e["fatigue"] for e in each]))
    same(found.mean_alert_latency_s, mean([min(e["latency"], 5.0) if e["latency"] == INF
                                           else e["latency"] for e in each]))  # fmt: skip
    budgets = [b for e in each for b in e["budgets"]]
    means = [mean(e["budgets"]) for e in each]
    same(found.mean_warning_budget_s, mean(means))
    same(found.adequate_share, ratio(sum(b > 1.87 for b in budgets), len(budgets)))
    hours = sum(len(f) for f in scenarios) / 30 / 3600
    same(found.false_episodes_per_hour, total("false") / hours)
    same(found.nuisance_episodes_per_hour, total("nuisance") / hours)
    for i, e in enumerate(each):
        same(found.by_scenario["sensitivity"][i], ratio(e["tp"], e["tp"] + e["fn"]))
        same(found.by_scenario["specificity"][i], ratio(e["tn"], e["tn"] + e["fp"]))
        same(found.by_scenario["sev_fn"][i], e["sev_fn"])
        same(found.by_scenario["fatigue"][i], e["fatigue"])
        same(found.by_scenario["alert_latency_s"][i], e["latency"])
        same(found.by_scenario["mean_warning_budget_s"][i], means[i])
        same(found.by_scenario["min_warning_budget_s"][i], min(e["budgets"], default=NAN))
        same(found.by_scenario["first_onset_lead_s"][i], e["lead"])


def trace(states, danger, ttc=INF, severity=0.25, budget=3.0, nearest=4.0):
    """One scenario from strings: A is an ALERT frame, D a danger frame."""
    frames = zip(states, danger, strict=True)
    return [(d == "D", ttc, severity, budget, nearest, A if s == "A" else W) for s, d in frames]


def test_counts_of_a_trace_made_by_hand():
    found = measured([trace("..AAA.AA..", "DDDDD....."), trace("AA........", "..........")])
    assert (found.true_positive, found.false_negative) == (3, 2)
    assert (found.false_positive, found.true_negative) == (4, 11)
    assert found.sensitivity == pytest.approx(0.6)
    assert found.specificity == pytest.approx(11 / 15)
    assert found.sev_fn == pytest.approx(0.4)  # the second scenario has no actionable frame
    assert found.fatigue == pytest.approx((0.5 + 0.2) / 2)
    assert found.by_scenario["alert_latency_s"][0] == pytest.approx(2 / 30)
    assert found.mean_alert_latency_s == pytest.approx(2 / 30)


def test_imminent_frames_are_neither_missed_nor_false():
    found = measured([trace("A.", "DD", ttc=1.0)])
    assert (found.true_positive, found.false_negative, found.false_positive) == (0, 0, 0)
    assert math.isnan(found.sensitivity)
    assert math.isnan(found.specificity)


def test_episodes_end_with_their_scenario():
    """Two harmless episodes that touch across the border; one near, one far, one in danger."""
    found = measured(
        [
            trace("..AA", "....", nearest=4.0),
            trace("AA..", "....", nearest=6.0),
            trace("AAAA", "...D", nearest=9.0),
        ]
    )
    hours = 12 / 30 / 3600
    assert found.nuisance_episodes_per_hour == pytest.approx(1 / hours)
    assert found.false_episodes_per_hour == pytest.approx(1 / hours)


def test_first_onset_lead_counts_to_the_closest_approach():
    frames = trace("..AA......", "..........")
    frames = [(*f[:4], abs(i - 8) + 1.0, *f[5:]) for i, f in enumerate(frames)]
    assert measured([frames]).by_scenario["first_onset_lead_s"][0] == pytest.approx(6 / 30)


def test_contact_sensitivity_asks_only_where_a_contact_lies_ahead():
    found = measured([trace("AA..", "DDDD"), trace("A...", "DDDD", ttc=2.0)])
    assert found.sensitivity == pytest.approx(3 / 8)
    assert found.contact_sensitivity == pytest.approx(1 / 4)


def test_an_onset_without_a_finite_budget_counts_for_nothing():
    found = measured([trace("A.A.", "DDDD", budget=INF), trace("A.", "DD", budget=1.87)])
    assert math.isnan(found.by_scenario["mean_warning_budget_s"][0])
    assert found.mean_warning_budget_s == pytest.approx(1.87)
    assert found.adequate_share == 0.0  # adequate exceeds 1.87 s


def test_a_scenario_that_never_alerts_counts_five_seconds():
    found = measured([trace("....", ".DD.")])
    assert found.by_scenario["alert_latency_s"][0] == INF
    assert found.mean_alert_latency_s == 5.0
    assert math.isnan(found.by_scenario["first_onset_lead_s"][0])


def test_json_has_null_where_there_is_no_figure():
    found = measured([trace("....", "....")])
    assert found.as_dict()["sensitivity"] is None
    assert found.as_dict()["specificity"] == 1.0
    assert found.scenario_dict(0)["alert_latency_s"] is None
    assert finite_or_none(INF) is None
    assert set(found.as_dict()) >= {
        "sensitivity", "specificity", "sev_fn", "fatigue", "mean_warning_budget_s",
        "true_positive", "false_positive", "false_negative", "true_negative",
    }  # fmt: skip


def test_the_confusion_counts_cover_the_suite(suite):
    truth = suite.truth_frames
    found = measure(truth, np.full(len(truth.danger), A, np.int8))
    assert found.true_positive == truth.actionable.sum()
    assert found.false_positive == (~truth.danger).sum()
    assert found.sensitivity == 1.0
    assert found.specificity == 0.0
