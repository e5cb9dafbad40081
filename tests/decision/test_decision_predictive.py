"""The own rule by hand-made courses, and its memory of what was on."""

from dataclasses import replace

import numpy as np
import pytest

from bikeped.decision.decider import Decider
from bikeped.decision.predictive import courses
from bikeped.decision.rules import RuleSettings
from bikeped.decision.shown import AS_RAW
from bikeped.decision.track_rows import TrackRows, pair_rows
from bikeped.types import State

P, C = 0, 1
RULE = RuleSettings(rule="predictive", shown=AS_RAW)


def decide(decider, t, cyclist, pedestrian):
    """`cyclist` and `pedestrian` are (x, y, vx, vy) in metres and m/s."""
    both = np.array([cyclist, pedestrian], np.float64)
    return decider.decide(t, np.array([1, 2]), np.array([C, P], np.int8), both[:, :2], both[:, 2:])


def state(cyclist, pedestrian, rule=RULE):
    return decide(Decider(rule), 0.0, cyclist, pedestrian).raw


def rows_of(cyclist, pedestrian):
    both = np.array([cyclist, pedestrian], np.float64)
    zero = np.zeros(2, np.intp)
    return TrackRows(
        zero, np.zeros(2), np.array([1, 2]), np.array([C, P], np.int8), both[:, :2], both[:, 2:],
        np.ones(2, np.bool_), np.full(2, -1),
    )  # fmt: skip


def test_courses_of_a_crossing():
    rows = rows_of((0, 0, 5, 0), (20, -4, 0, 1))  # both at (20, 0) after 4 s
    found = courses(rows, pair_rows(rows))
    assert found.pass_m[0] == pytest.approx(0.0, abs=1e-9)
    assert found.pass_s[0] == pytest.approx(4.0)
    distance = np.hypot(20, 4)
    assert found.closing_mps[0] == pytest.approx(distance / 4)
    assert found.contact_s[0] == pytest.approx((distance - 1) / (distance / 4))
    assert found.cyclist_mps[0] == pytest.approx(5.0)


def test_courses_end_at_the_horizon_and_apart_is_never():
    rows = rows_of((0, 0, 1, 0), (20, 0, 0, 0))
    found = courses(rows, pair_rows(rows))
    assert (found.pass_s[0], found.pass_m[0]) == (5.0, 15.0)
    rows = rows_of((0, 0, -1, 0), (20, 0, 0, 0))
    found = courses(rows, pair_rows(rows))
    assert (found.pass_s[0], found.pass_m[0], found.contact_s[0]) == (0.0, 20.0, np.inf)


def test_a_course_towards_one_another_alerts_whatever_the_distance():
    for distance in (3.0, 8.0, 20.0):
        assert state((distance, 3, -5, 0), (0, 3, 0, 0)) is State.ALERT


@pytest.mark.parametrize(
    ("cyclist", "pedestrian"),
    [
        ((10, 3, 5, 0), (0, 3, 0, 0)),  # rides away
        ((10, 3, -1.5, 0), (0, 3, 0, 0)),  # walks the bicycle
        ((10, 3, -5, 0), (0, 3, -5, 0)),  # at a constant gap
        ((20, 16, -5, 0), (0, 3, 0, 0)),  # passes 13 m away
        ((18, 3, -2, 0), (0, 3, 0, 0)),  # is seconds away and can stop
        ((1.2, 3, -5, 0), (0, 3, 0, 0)),  # too late to warn: the hold covers it
        ((30, 3, -5, 0), (2, 3, 0, 0)),  # beyond the range of the camera
    ],
)
def test_other_courses_do_not(cyclist, pedestrian):
    assert state(cyclist, pedestrian) is State.WARNING


def test_an_alert_stays_on_within_the_margin_and_does_not_begin_there():
    settings = replace(RULE, predictive=replace(RULE.predictive, stay_margin=0.5))
    begins = (10, 3, -5, 0)
    # Passes 9 m away: over the limit of a beginning, under that of one that lasts.
    wide = (10, 13.0, -5, 0)
    decider = Decider(settings)
    walker = (0, 3, 0, 0)
    assert decide(decider, 0.0, wide, walker).raw is State.WARNING
    assert decide(decider, 1 / 30, begins, walker).raw is State.ALERT
    assert decide(decider, 2 / 30, wide, walker).raw is State.ALERT
    assert decide(decider, 3 / 30, (10, 3, 5, 0), walker).raw is State.WARNING
    assert decide(decider, 4 / 30, wide, walker).raw is State.WARNING
