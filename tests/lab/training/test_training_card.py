"""The card's numbers, from sights whose answer is known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bikeped.config.load import load_config
from bikeped.config.schema import DetectionConfig
from bikeped.lab.rendering import DrawnObject, scene_camera
from bikeped.lab.training.model_card import (
    DetectionRecord,
    DrawnTest,
    bootstrap_spread,
    choose_confidence,
    drawn_test,
    match_detections,
    summary,
    summary_by_light,
    sweep,
)
from bikeped.models import BUNDLED_FILE
from bikeped.types import Detections, Kind

NAN = math.nan
PED, CYC = Kind.PEDESTRIAN, Kind.CYCLIST


@pytest.fixture(scope="module")
def view():
    return scene_camera(load_config(None), (960, 540))


def thing(box, kind=PED, visible=1.0, xy=(8.0, 0.0)):
    return DrawnObject(1, kind.label, kind, box, box, visible, xy, xy, 0.0)


def found(*rows):
    kind, confidence, box = zip(*rows, strict=True) if rows else ((), (), ())
    return Detections(
        np.array(kind, np.int8),
        np.array(confidence, np.float32),
        np.array(box, np.float32).reshape(-1, 4),
    )


BOX = (400.0, 300.0, 420.0, 350.0)


def test_somebody_found_and_how_far_off_on_the_ground(view):
    uv, valid = view.camera.project(np.array([[8.0, 1.0, 0.0]]))
    assert valid.all()
    u, v = view.framing.crop_to_frame(uv)[0]
    box = (u - 10, v - 40, u + 10, v)
    (sight,) = match_detections(found((PED, 0.7, box)), [thing(box, xy=(8.0, 1.0))], view)
    assert sight.found
    assert sight.error_m == pytest.approx(0, abs=1e-3)
    assert sight.confidence == pytest.approx(0.7)
    assert sight.distance_m == pytest.approx(math.hypot(8, 1))


def test_misses_wrong_kinds_and_doubles(view):
    (miss,) = match_detections(found(), [thing(BOX)], view)
    assert not miss.found
    rows = match_detections(found((CYC, 0.9, BOX)), [thing(BOX)], view)
    assert [(s.kind, s.found) for s in rows] == [(CYC, False), (PED, False)]
    assert math.isnan(rows[0].distance_m)
    assert rows[0].on_other
    (nobody, _) = match_detections(found((CYC, 0.9, (10, 300, 30, 350))), [thing(BOX)], view)
    assert not nobody.on_other
    # Moved by shares of his width: overlaps of 0.43, 0.18 and 0.05.
    for shift, loose in ((0.4, True), (0.7, True), (0.9, False)):
        u1, v1, u2, v2 = BOX
        beside = (u1 + shift * (u2 - u1), v1, u2 + shift * (u2 - u1), v2)
        rows = match_detections(found((PED, 0.9, beside)), [thing(BOX)], view)
        assert [(s.found, s.loose, s.on_other) for s in rows] == [
            (False, loose, False),
            (False, False, False),
        ]
    rows = match_detections(found((PED, 0.9, BOX), (PED, 0.8, BOX)), [thing(BOX)], view)
    assert [(s.found, math.isnan(s.distance_m)) for s in rows] == [(False, True), (True, False)]
    assert not rows[0].on_other


def test_nobody_is_asked_for_who_cannot_be_seen(view):
    hidden = thing(BOX, visible=0.1)
    assert match_detections(found(), [hidden], view) == []
    assert match_detections(found((PED, 0.9, BOX)), [hidden], view) == []
    assert match_detections(found((CYC, 0.9, BOX)), [hidden], view) == []
    tiny = thing((400, 300, 403, 310))
    far = thing(BOX, xy=(40.0, 0.0))
    assert match_detections(found(), [tiny, far], view) == []


def sights():
    near = [DetectionRecord(PED, 5.0, True, 0.5, 0.1), DetectionRecord(PED, 14.0, True, 0.2, 0.3)]
    far = [DetectionRecord(PED, 18.0, False, 0.0, NAN), DetectionRecord(CYC, 3.0, True, 0.9, NAN)]
    return [
        near,
        [
            *far,
            DetectionRecord(CYC, NAN, False, 0.3, NAN),
            DetectionRecord(Kind.VEHICLE, NAN, False, 0.9, NAN),
            DetectionRecord(PED, NAN, False, 0.9, NAN, True),
            DetectionRecord(PED, NAN, False, 0.9, NAN, loose=True),
        ],
    ]


def test_the_summary_counts_at_a_confidence():
    numbers = summary(sights(), 0.25)
    walkers = numbers["kinds"]["pedestrian"]
    assert walkers["within_15_m"] == {
        "objects": 2,
        "recall": 0.5,
        "median_error_m": 0.1,
        "p90_error_m": 0.1,
    }
    assert [ring["objects"] for ring in walkers["rings"]] == [0, 1, 1, 1, 0, 0]
    assert numbers["kinds"]["cyclist"]["false_per_100_frames"] == 50
    assert numbers["kinds"]["cyclist"]["within_15_m"]["median_error_m"] is None
    assert numbers["false_pedestrian_or_cyclist_per_100_frames"] == 50
    assert walkers["another_kind_per_100_frames"] == 50
    assert numbers["another_kind_pedestrian_or_cyclist_per_100_frames"] == 50
    assert (walkers["loose_per_100_frames"], walkers["false_per_100_frames"]) == (50, 0)
    assert summary(sights(), 0.35)["false_pedestrian_or_cyclist_per_100_frames"] == 0
    assert summary(sights(), 0.1)["kinds"]["pedestrian"]["within_15_m"]["recall"] == 1


def test_those_who_mostly_show_are_counted_apart(view):
    half, whole = thing(BOX, visible=0.5), thing((500, 300, 520, 350))
    seen = match_detections(found((PED, 0.7, (500, 300, 520, 350))), [half, whole], view)
    walkers = summary([seen], 0.25)["kinds"]["pedestrian"]
    assert walkers["within_15_m"]["recall"] == 0.5
    assert walkers["within_15_m_mostly_visible"]["objects"] == 1
    assert walkers["within_15_m_mostly_visible"]["recall"] == 1


def test_lights_are_told_apart():
    rows = summary_by_light(sights(), ["day", "night"], 0.25)
    assert rows["day"] == {
        "frames": 1,
        "false_per_100_frames": 0,
        "pedestrian": 0.5,
        "cyclist": None,
    }
    assert rows["night"]["false_per_100_frames"] == 100


def test_the_confidence_is_the_lowest_that_keeps_the_promise():
    grid = [0.1, 0.2, 0.35, 0.5]
    assert choose_confidence(sights(), CYC, grid, 1.0) == 0.35
    assert choose_confidence(sights(), CYC, grid, 60) == 0.1
    assert choose_confidence(sights(), PED, grid, 0) == 0.1
    assert choose_confidence(sights(), CYC, [0.1], 1.0) == 0.1
    assert [row["confidence"] for row in sweep(sights(), grid)] == grid


def test_how_exact_the_figures_are_follows_from_the_streets():
    # Streets of four pictures: in half of them all are found, in the others nobody, and a false one
    # in each picture of every tenth street.
    def picture(number):
        street = number // 4
        false = [DetectionRecord(PED, NAN, False, 0.9, NAN)] if street % 10 == 0 else []
        other = [
            DetectionRecord(PED, NAN, False, 0.9, NAN, True),
            DetectionRecord(CYC, NAN, False, 0.1, NAN),
        ]
        return [DetectionRecord(PED, 5.0, street % 2 == 0, 0.8, 0.1), *false, *other]

    numbers = bootstrap_spread([picture(n) for n in range(400)], 0.5)
    low, high = numbers["pedestrian"]
    # A hundred streets, each a throw of a coin: 0.5 +- 1.96 x 0.05.
    assert (low, high) == pytest.approx((0.402, 0.598), abs=0.015)
    low, high = numbers["false_pedestrian_or_cyclist_per_100_frames"]
    # 10 +- 1.96 x 3, skewed.
    assert (low, high) == pytest.approx((5, 16), abs=1.01)
    assert numbers["cyclist"] is None
    alone = bootstrap_spread([picture(n) for n in range(400)], 0.5, a_street=1)["pedestrian"]
    assert alone == pytest.approx([0.45, 0.55], abs=0.01)
    assert bootstrap_spread(sights(), 0.25) == bootstrap_spread(sights(), 0.25)


@pytest.mark.slow
def test_the_bundled_model_is_shown_drawn_pictures():
    model = DetectionConfig(model=str(BUNDLED_FILE))
    seen = []
    test = DrawnTest(pictures=6, seed=9_700_001, part=3, processes=2)
    (rows, again), lights = drawn_test([model, model], load_config(None), test, seen.append)
    assert again == rows
    assert len(lights) == len(rows) == 6
    assert seen == [1, 2, 3, 4, 5, 6]
    near = [s for row in rows for s in row if s.distance_m < 15 and s.kind != Kind.VEHICLE]
    assert sum(s.found for s in near) >= 0.7 * len(near) > 0
