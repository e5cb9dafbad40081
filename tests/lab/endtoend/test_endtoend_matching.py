"""Which detection is which object."""

from __future__ import annotations

from endtoend_fakes import drawn, found

from bikeped.lab.endtoend.measures import match_detections
from bikeped.types import Detections, Kind

WALKER, RIDER = Kind.PEDESTRIAN, Kind.CYCLIST
BOX = (10.0, 10.0, 20.0, 40.0)


def test_the_best_overlap_wins_and_nobody_is_matched_twice() -> None:
    objects = [drawn(1, WALKER, BOX), drawn(2, WALKER, (14, 10, 24, 40))]
    detections = found((WALKER, (11, 10, 21, 40)), (WALKER, BOX), (WALKER, (80, 80, 90, 99)))
    matched = match_detections(detections, objects)
    assert matched.object.tolist() == [1, 0, -1]
    assert matched.found.tolist() == [1, 0]


def test_the_right_kind_comes_first_and_a_wrong_one_still_counts_as_found() -> None:
    objects = [drawn(1, WALKER, BOX)]
    both = found((RIDER, BOX), (WALKER, (11, 11, 21, 41)))
    assert match_detections(both, objects).object.tolist() == [-1, 0]
    assert match_detections(found((RIDER, BOX)), objects).object.tolist() == [0]


def test_touching_is_not_matching() -> None:
    assert match_detections(
        found((WALKER, (20, 10, 30, 40))), [drawn(1, WALKER, BOX)]
    ).found.tolist() == [-1]


def test_nothing_matches_nothing() -> None:
    assert match_detections(Detections.empty(), [drawn(1, WALKER, BOX)]).found.tolist() == [-1]
    assert match_detections(found((WALKER, BOX)), []).object.tolist() == [-1]
