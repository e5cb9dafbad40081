"""Riders and cycles: what becomes one cyclist, and who stays a pedestrian."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.detection.person_boxes import join_riders
from bikeped.types import Detections, Kind

P, C, V = Kind.PEDESTRIAN, Kind.CYCLIST, Kind.VEHICLE

# A bicycle seen from the side, 1 m high and 1.8 m long at 100 pixels a metre, wheels on v = 400.
BICYCLE = (300, 300, 480, 400)
RIDER = (365, 215, 415, 390)  # head to pedals


def found(*rows):
    kind = np.array([r[0] for r in rows], np.int8)
    confidence = np.array([r[1] for r in rows], np.float32)
    box = np.array([r[2] for r in rows], np.float32).reshape(-1, 4)
    return Detections(kind, confidence, box)


def join(*rows, overlap=0.4, confidence=0.1):
    out = join_riders(found(*rows), overlap, confidence)
    return [
        (Kind(k), pytest.approx(float(c)), tuple(b.tolist()))
        for k, c, b in zip(out.kind, out.confidence, out.box_px, strict=True)
    ]


def moved(box, dx=0, dy=0, scale=1.0):
    """`box` moved, and scaled about the middle of its lower edge."""
    middle = (box[0] + box[2]) / 2
    half, high = (box[2] - box[0]) / 2 * scale, (box[3] - box[1]) * scale
    return (middle - half + dx, box[3] - high + dy, middle + half + dx, box[3] + dy)


def test_rider_and_bicycle_are_one_cyclist_on_the_wheel_line():
    out = join((P, 0.8, RIDER), (C, 0.3, BICYCLE))
    assert out == [(C, 0.3, (300, 215, 480, 400))]  # as sure as its bicycle


def test_a_rider_seen_from_the_front():
    out = join((P, 0.6, (330, 225, 380, 385)), (C, 0.7, (335, 300, 375, 400)))
    assert out == [(C, 0.7, (330, 225, 380, 400))]


def test_a_rider_cut_where_the_bicycle_hides_the_legs():
    assert [k for k, *_ in join((P, 0.6, (365, 250, 415, 335)), (C, 0.6, BICYCLE))] == [C]


def test_a_box_of_a_cyclist_takes_in_its_own_rider():
    # Models with a class `cyclist` box both together; the person may be found as well.
    assert join((C, 0.9, (300, 215, 480, 400)), (P, 0.5, RIDER)) == [(C, 0.9, (300, 215, 480, 400))]


@pytest.mark.parametrize(
    ("why", "person"),
    [
        ("beside it", moved(RIDER, dx=150, dy=5)),
        ("beside it, partly before a wheel", moved(RIDER, dx=105)),
        ("in front of it, nearer", moved(RIDER, dy=60, scale=1.2)),
        ("behind it, feet at the middle of the wheels", moved(RIDER, dy=-50, scale=0.95)),
        ("far behind it", moved(RIDER, dy=-85, scale=0.6)),
        ("above it", moved(RIDER, dy=-200)),
        ("far larger", moved(RIDER, scale=2.5)),
        ("far smaller", moved(RIDER, scale=0.2)),
    ],
)
def test_others_stay_pedestrians(why, person):
    out = join((P, 0.8, person), (C, 0.7, BICYCLE))
    assert [k for k, *_ in out] == [P, C], why
    assert out[1][2] == BICYCLE


def test_a_pedestrian_close_to_a_rider_stays():
    walker = moved(RIDER, dx=120, dy=8)
    out = join((P, 0.9, walker), (P, 0.8, RIDER), (C, 0.5, BICYCLE))
    assert [(k, b) for k, _, b in out] == [(P, walker), (C, (300, 215, 480, 400))]


def test_two_riders_abreast_keep_their_own_cycles():
    other, his = moved(BICYCLE, dx=60, dy=10), moved(RIDER, dx=60, dy=10)
    out = join((P, 0.9, RIDER), (P, 0.8, his), (C, 0.7, BICYCLE), (C, 0.6, other))
    assert [(k, b) for k, _, b in out] == [(C, (300, 215, 480, 400)), (C, (360, 225, 540, 410))]


def test_one_cycle_has_one_rider():
    out = join((P, 0.9, RIDER), (P, 0.8, moved(RIDER, dx=60)), (C, 0.7, BICYCLE))
    assert sorted(k for k, *_ in out) == [P, C]


def test_a_rider_seen_twice_is_no_pedestrian():
    head_and_shoulders = (368, 216, 412, 330)
    out = join((P, 0.9, RIDER), (P, 0.8, head_and_shoulders), (C, 0.7, BICYCLE))
    assert [k for k, *_ in out] == [C]


def test_a_wheel_of_the_same_cycle_is_no_second_cyclist():
    wheel = (300, 330, 370, 405)
    assert len(join((P, 0.9, RIDER), (C, 0.7, BICYCLE), (C, 0.4, wheel))) == 1
    # Nobody rides: nothing says what is part of what, and suppression has had its say.
    assert len(join((C, 0.7, BICYCLE), (C, 0.4, wheel))) == 2


def test_a_cycle_that_nobody_rides_stays_a_cyclist():
    assert join((C, 0.7, BICYCLE)) == [(C, 0.7, BICYCLE)]


def test_a_faint_cycle_counts_only_under_a_rider():
    assert join((P, 0.5, RIDER), (C, 0.06, BICYCLE)) == [(C, 0.06, (300, 215, 480, 400))]
    assert join((C, 0.06, BICYCLE)) == []
    assert [k for k, *_ in join((P, 0.5, moved(RIDER, dx=300)), (C, 0.06, BICYCLE))] == [P]


def test_an_overlap_of_one_joins_nothing():
    out = join((P, 0.8, RIDER), (C, 0.7, BICYCLE), overlap=1)
    assert [k for k, *_ in out] == [P, C]


def test_the_overlap_is_the_persons_lower_half():
    # Half of the person's width from the waist down lies over the cycle: cover 0.5.
    rows = (P, 0.8, (460, 215, 500, 400)), (C, 0.7, (300, 300, 480, 400))
    half = (P, 0.8, (460, 200, 500, 400)), (C, 0.7, (300, 300, 480, 400))
    assert [k for k, *_ in join(*half, overlap=0.45)] == [C]
    assert [k for k, *_ in join(*half, overlap=0.55)] == [P, C]
    assert [k for k, *_ in join(*rows, overlap=0.45)] == [C]


def test_the_middle_of_the_person_lies_over_the_cycle():
    # Covered by 0.44 and by 0.56 of the width: only in the second the middle is over the cycle.
    assert [
        k for k, *_ in join((P, 0.8, (458, 215, 508, 390)), (C, 0.7, BICYCLE), overlap=0.3)
    ] == [P, C]
    assert [
        k for k, *_ in join((P, 0.8, (452, 215, 502, 390)), (C, 0.7, BICYCLE), overlap=0.3)
    ] == [C]


def test_vehicles_are_left_alone():
    car = (V, 0.95, (280, 200, 500, 400))
    assert [k for k, *_ in join(car, (P, 0.8, RIDER), (C, 0.7, BICYCLE))] == [V, C]


boxes = st.tuples(*[st.integers(0, 300)] * 2, *[st.integers(1, 200)] * 2).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)
rows = st.lists(st.tuples(st.sampled_from([P, C, V]), st.floats(0.1, 1), boxes), max_size=8)


@settings(deadline=None)
@given(rows, st.floats(0, 1))
def test_never_more_objects_than_before_and_the_outer_edges_stay(scene, overlap):
    scene = sorted(scene, key=lambda row: -row[1])
    before, out = found(*scene), join_riders(found(*scene), overlap, 0.1)
    assert len(out) <= len(before)
    assert (np.diff(out.confidence) <= 0).all()
    assert (out.kind == V).sum() == (before.kind == V).sum()
    # A pedestrian can only vanish into a cyclist, and no cyclist vanishes without another.
    assert ((out.kind == C).sum() > 0) == ((before.kind == C).sum() > 0)
    gone = (before.kind == P).sum() - (out.kind == P).sum()
    assert gone == 0 or (out.kind == C).any()
    for box in out.box_px:
        assert (box[:2] >= before.box_px[:, :2].min(axis=0)).all()
        assert (box[2:] <= before.box_px[:, 2:].max(axis=0)).all()
