"""COCO's measures on cases that are worked out by hand, and the recall curve."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.errors import BikepedError, DataSetError
from bikeped.lab.simulation.perception import RecallModel, load_recall_curve
from bikeped.lab.training.evaluate import write_curve
from bikeped.lab.training.measures import (
    DetectionSet,
    GroundTruth,
    RecallCurve,
    measure,
    recall_by_distance,
    recall_curve,
)
from bikeped.types import Kind

NAMES = ("one", "two")


def truth(*rows):
    """Rows of image, category, box, and crowd where it is one."""
    return GroundTruth(
        np.array([r[0] for r in rows], np.int64),
        np.array([r[1] for r in rows], np.int64),
        np.array([r[2] for r in rows], np.float64).reshape(-1, 4),
        np.array([len(r) > 3 and r[3] for r in rows], np.bool_),
        np.array([r[4] if len(r) > 4 else np.nan for r in rows], np.float64),
    )


def found(*rows):
    """Rows of image, category, box, score."""
    return DetectionSet(
        np.array([r[0] for r in rows], np.int64),
        np.array([r[1] for r in rows], np.int64),
        np.array([r[2] for r in rows], np.float64).reshape(-1, 4),
        np.array([r[3] for r in rows], np.float32),
    )


BOX, FAR = [0, 0, 100, 100], [300, 300, 400, 400]


def test_what_is_found_exactly_scores_one(capsys):
    boxes = [(0, 0, BOX), (0, 1, FAR), (1, 0, FAR), (1, 0, [0, 0, 20, 20])]
    given_ = measure(truth(*boxes), found(*((*box, 0.9) for box in boxes)), NAMES, 2)
    for row in (*given_.rows, given_.overall):
        assert (row.ap, row.ap50, row.ar) == (pytest.approx(1), pytest.approx(1), pytest.approx(1))
    assert [row.objects for row in given_.rows] == [3, 1]
    assert given_.rows[0].objects_by_size == (1, 0, 2)
    assert given_.rows[0].ar_by_size == (pytest.approx(1), None, pytest.approx(1))
    assert given_.hits.all()
    assert capsys.readouterr().out == ""  # standard output may be JSON's


def test_a_shifted_box_counts_up_to_its_overlap():
    # 100 x 100 shifted by 20: 80 * 100 shared of 120 * 100: IoU 2/3, enough for 0.50 .. 0.65.
    result = measure(truth((0, 0, BOX)), found((0, 0, [20, 0, 120, 100], 0.9)), NAMES, 1)
    row = result.rows[0]
    assert (row.ap, row.ap50, row.ar) == (pytest.approx(0.4), pytest.approx(1), pytest.approx(0.4))
    assert result.hits.tolist() == [[True] * 4 + [False] * 6]
    assert result.rows[1].ap is None  # no object of class two
    assert result.overall.ap == pytest.approx(0.4)


def test_a_false_alarm_costs_precision_by_its_rank():
    things = truth((0, 0, BOX), (0, 0, FAR))
    right = [(0, 0, BOX, 0.9), (0, 0, FAR, 0.3)]
    wrong = (0, 0, [600, 0, 700, 100])
    after = measure(things, found(*right, (*wrong, 0.1)), NAMES, 1).rows[0]
    assert after.ap == pytest.approx(1)
    # Between the two: precision 1 up to recall 0.5, then 2/3. Of the 101 recalls 51 are to 0.5.
    between = measure(things, found(*right, (*wrong, 0.5)), NAMES, 1).rows[0]
    assert between.ap == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert between.ar == pytest.approx(1)
    first = measure(things, found(*right, (*wrong, 0.99)), NAMES, 1).rows[0]
    assert first.ap == pytest.approx(2 / 3)  # the best precision at any recall: 2 of 3


def test_a_missed_object_costs_recall():
    row = measure(truth((0, 0, BOX), (1, 0, BOX)), found((0, 0, BOX, 0.5)), NAMES, 2).rows[0]
    assert row.ar == pytest.approx(0.5)
    assert row.ap == pytest.approx(51 / 101)


def test_other_pictures_and_other_classes_do_not_count():
    given_ = measure(truth((0, 0, BOX)), found((1, 0, BOX, 0.9), (0, 1, BOX, 0.9)), NAMES, 2)
    assert (given_.rows[0].ap, given_.rows[0].ar) == (0, 0)
    assert not given_.hits.any()


def test_a_crowd_neither_counts_nor_harms():
    things = truth((0, 0, BOX), (0, 0, FAR, True))
    answers = found((0, 0, BOX, 0.5), (0, 0, [310, 310, 330, 330], 0.9), (0, 0, FAR, 0.8))
    row = measure(things, answers, NAMES, 1).rows[0]
    assert (row.ap, row.objects) == (pytest.approx(1), 1)
    assert measure(things, answers, NAMES, 1).false == (0, 0)
    assert recall_curve(things, measure(things, answers, NAMES, 1).hits, 1).objects == (1,)


def test_nothing_found_and_nothing_there():
    row = measure(truth((0, 0, BOX)), found(), NAMES, 1).rows[0]
    assert (row.ap, row.ap50, row.ar) == (0, 0, 0)
    none = measure(truth(), found((0, 0, BOX, 0.5)), NAMES, 1)
    assert (none.overall.ap, none.overall.ar, none.overall.objects) == (None, None, 0)
    assert recall_curve(truth(), none.hits, 1) == RecallCurve((), (), (), ())


def test_false_alarms_are_counted_by_class():
    answers = found(
        (0, 0, BOX, 0.9),
        (0, 0, [60, 0, 160, 100], 0.8),  # IoU 0.25 with the object
        (1, 0, BOX, 0.7),  # in the other picture
        (0, 1, BOX, 0.6),  # as the other class
        (0, 0, [1, 0, 100, 100], 0.5),  # the object again
    )
    assert measure(truth((0, 0, BOX)), answers, NAMES, 2).false == (3, 1)


def test_recall_by_distance():
    boxes = [[200 * n, 0, 200 * n + 100, 100] for n in range(5)]
    metres = (0.5, 4.9, 5.0, 40.0, np.nan)
    things = truth(
        *((0, 0, box, False, m) for box, m in zip(boxes, metres, strict=True)),
        (0, 0, [0, 500, 100, 600], True, 3.0),
        (0, 1, [0, 700, 100, 800], False, 3.0),
    )
    hits = measure(things, found((0, 0, boxes[0], 0.9), (0, 0, boxes[3], 0.9)), NAMES, 1).hits
    near, five, far = recall_by_distance(things, hits, 0)
    assert near == {"from_m": 0, "to_m": 5, "objects": 2, "found": 1, "recall50": 0.5}
    assert (five["from_m"], five["objects"], five["found"]) == (5, 1, 0)
    assert far == {"from_m": 25, "to_m": None, "objects": 1, "found": 1, "recall50": 1.0}


def test_the_curve_is_recall_by_bin():
    things = truth(
        *((n, 0, [0, 0, 10, 10]) for n in range(4)),  # 100 px^2: from 8^2 to 12^2
        *((n, 1, [50, 50, 90, 90]) for n in range(4)),  # 1600 px^2: from 32^2 to 48^2
    )
    answers = found(
        (0, 0, [0, 0, 10, 10], 0.9),
        (1, 0, [2, 0, 12, 10], 0.9),  # IoU 2/3
        *((n, 1, [50, 50, 90, 90], 0.9) for n in range(3)),
    )
    hits = measure(things, answers, NAMES, 4).hits
    curve = recall_curve(things, hits, 2)
    assert curve.area_px2 == (100, 1600)
    assert curve.recall == (pytest.approx((1 + 0.4) / 4), 0.75)
    assert curve.recall50 == (0.5, 0.75)
    assert curve.objects == (4, 4)
    assert recall_curve(things, hits, 2, category=1).area_px2 == (1600,)
    assert recall_curve(things, hits, 5).objects == (8,)  # too few for two bins


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(1, 1e6), min_size=1, max_size=60), st.integers(1, 20))
def test_the_bins_hold_every_object_once_and_rise(areas, least):
    boxes = [(0, 0, [0, 0, area**0.5, area**0.5]) for area in areas]
    things = truth(*boxes)
    curve = recall_curve(things, np.ones((len(areas), 10), np.bool_), least)
    assert sum(curve.objects) == len(areas)
    assert (np.diff(curve.area_px2) > 0).all()
    assert all(count >= least for count in curve.objects) or len(curve.objects) == 1
    assert set(curve.recall) == {1.0}


@pytest.mark.parametrize("name", ["curve.csv", "curve.json", "curve"])
def test_the_simulation_reads_the_curve_that_is_written(tmp_path, name):
    curve = RecallCurve((80.123456789, 1234.5), (1 / 3, 0.75), (0.5, 0.875), (20, 30))
    write_curve(tmp_path / name, curve)
    read = load_recall_curve(tmp_path / name)
    assert read == (curve.area_px2, curve.recall)
    model = RecallModel("curve", read)
    kinds = np.array([Kind.CYCLIST] * 3, np.int8)
    middle = (80.123456789 + 1234.5) / 2
    assert model.recall(kinds, np.array([1.0, middle, 1e6])) == pytest.approx(
        [1 / 3, (1 / 3 + 0.75) / 2, 0.75]
    )
    write_curve(tmp_path / name, curve, at_iou_50=True)
    assert load_recall_curve(tmp_path / name)[1] == curve.recall50


def test_one_bin_is_no_curve(tmp_path):
    with pytest.raises(DataSetError, match="too few road users"):
        write_curve(tmp_path / "c.csv", RecallCurve((5.0,), (1.0,), (1.0,), (3,)))
    assert not (tmp_path / "c.csv").exists()


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pycocotools", None)
    with pytest.raises(BikepedError, match=r"bikeped\[evaluate\]"):
        measure(truth((0, 0, BOX)), found(), NAMES, 1)
