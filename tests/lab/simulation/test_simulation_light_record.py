"""The figures of a light against their definitions (sections 14, 15), frame by frame."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.lab.simulation.light_record import Conflicts, LightRecord, light_figures
from bikeped.lab.simulation.truth import GroundTruth
from bikeped.types import State

QUICK = settings(derandomize=True, deadline=None, max_examples=60)
ALERT, WARNING = int(State.ALERT), int(State.WARNING)


def record(raw, shown, danger, both, conflict_s=(), in_view_s=None, nearest_m=3.0):
    n = len(raw)
    danger = np.asarray(danger, bool)
    infinite = np.full(n, np.inf)
    truth = GroundTruth(
        time_s=np.arange(n) / 30,
        danger=danger,
        actionable=danger,
        severity=danger * 0.5,
        ttc_s=np.where(danger, 3.0, np.inf),
        d_min_m=infinite,
        budget_s=infinite,
        distance_m=infinite,
        cyclist=np.full(n, -1),
        pedestrian=np.full(n, -1),
        nearest_m=np.broadcast_to(nearest_m, n).astype(float),
    )
    at = np.asarray(conflict_s, float)
    known = at if in_view_s is None else np.asarray(in_view_s, float)
    conflicts = Conflicts(at, known, np.zeros((len(at), 2), np.int64))
    codes = np.where(np.asarray(raw, bool), ALERT, WARNING).astype(np.int8)
    return LightRecord(truth, np.asarray(both, bool), conflicts, codes, np.asarray(shown, bool))


def spans(*parts):
    """Flags from lengths and values: spans((3, 0), (2, 1)) is 0 0 0 1 1."""
    return [bool(value) for count, value in parts for _ in range(count)]


def test_episodes_and_shares_of_a_written_example():
    """Four minutes: an alert of 10 frames with danger, one of 60 without, 30 frames later."""
    n = 7200
    shown = spans((100, 0), (10, 1), (30, 0), (60, 1), (n - 200, 0))
    danger = spans((109, 0), (1, 1), (n - 110, 0))
    both = spans((120, 1), (n - 120, 0))
    nearest = np.where(np.arange(n) < 150, 3.0, np.where(np.arange(n) < 170, 12.0, np.inf))
    found = light_figures([record(shown, shown, danger, both, nearest_m=nearest)])
    assert found["alerts_per_hour"] == pytest.approx(2 / (4 / 60))
    assert found["alerts_per_hour_both_in_view"] == pytest.approx(1 / (4 / 3600))
    assert found["red_share"] == pytest.approx(70 / n)
    assert found["alerts_with_danger"] == 0.5
    assert found["alerts_with_real_conflict"] == 0
    assert found["episodes_under_500ms"] == 0.5
    assert found["changes_per_minute"] == pytest.approx(4 / 4)
    assert found["red_off_red_per_hour"] == pytest.approx(1 / (4 / 60))
    assert found["red_without_danger"] == pytest.approx(69 / 70)
    assert found["red_nearest_pair_far"] == pytest.approx(20 / 70)
    assert found["red_without_pair"] == pytest.approx(30 / 70)


@pytest.mark.parametrize(
    ("conflict_s", "belongs"),
    [(2.7, False), (2.85, True), (3.5, True), (4.9, True), (6.9, True), (7.1, False)],
)
def test_a_conflict_belongs_to_an_alert_from_a_fifth_before_to_three_seconds_after(
    conflict_s, belongs
):
    """The alert is shown from 3 s to 3.97 s."""
    shown = spans((90, 0), (30, 1), (180, 0))
    light = record(shown, shown, [False] * 300, [True] * 300, [conflict_s])
    assert light_figures([light])["alerts_with_danger"] == belongs
    assert light_figures([light])["alerts_with_real_conflict"] == belongs


@pytest.mark.parametrize(
    ("shown_s", "missed", "late"),
    [
        ((2.9, 2.95), True, False),  # over 5 s before
        ((3.1, 3.2), False, False),
        ((6.0, 6.1), False, False),
        ((6.2, 9.0), False, True),  # none earlier than 1.87 s before
        ((8.1, 9.0), True, False),  # only after
    ],
)
def test_missed_and_late(shown_s, missed, late):
    """A conflict at 8 s."""
    t = np.arange(300) / 30
    shown = (t >= shown_s[0]) & (t <= shown_s[1])
    light = record(shown, shown, [False] * 300, [True] * 300, [8.0], [2.1])
    found = light_figures([light])
    assert (found["missed"], found["late"]) == (missed, late)
    assert (found["real_conflicts"], found["fair_conflicts"], found["fair_missed"]) == (1, 0, 0)
    fair = light_figures([record(shown, shown, [False] * 300, [True] * 300, [8.0], [2.2])])
    assert (fair["fair_missed"], fair["fair_late"]) == (missed, late)


flags = st.lists(st.booleans(), min_size=30, max_size=30)


@QUICK
@given(flags, flags, flags)
def test_counts_of_random_frames(raw, shown, danger):
    """Specificity raw, shown (held frames in neither count) and strict, by counting frames."""
    found = light_figures([record(raw, shown, danger, [True] * 30)])
    frames = list(zip(raw, shown, danger, strict=True))
    calm = [(r, s) for r, s, d in frames if not d]

    def share(part, whole):
        return part / whole if whole else None

    assert found["specificity"] == share(sum(not r for r, _ in calm), len(calm))
    free = [s for r, s in calm if not (s and not r)]
    assert found["specificity_shown"] == share(sum(not s for s in free), len(free))
    assert found["specificity_strict"] == share(sum(not s for _, s in calm), len(calm))
    assert found["held_frames"] == sum(s and not r for r, s, _ in frames)
    dangers = [s for _, s, d in frames if d]
    assert found["sensitivity"] == share(sum(dangers), len(dangers))
    episodes = [list(g) for on, g in itertools.groupby(frames, key=lambda f: f[1]) if on]
    assert found["alerts_per_hour"] == pytest.approx(len(episodes) * 3600)
    with_danger = sum(any(d for _, _, d in episode) for episode in episodes)
    assert found["alerts_with_danger"] == share(with_danger, len(episodes))


@QUICK
@given(flags, flags)
def test_scenes_add_up(one, other):
    """Counts over two scenes are the sums; an alert never spans two scenes."""
    a, b = (record(shown, shown, shown, [True] * 30, [0.5]) for shown in (one, other))
    together, alone = light_figures([a, b]), [light_figures([x]) for x in (a, b)]
    for key in ("alerts_per_hour", "red_share", "changes_per_minute", "red_off_red_per_hour"):
        assert together[key] == pytest.approx(sum(x[key] for x in alone) / 2)
    for key in ("real_conflicts", "missed", "late"):
        assert together[key] == sum(x[key] for x in alone)
    assert math.isclose(together["alerts_per_hour_both_in_view"], together["alerts_per_hour"])
