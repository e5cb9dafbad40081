"""Head and shoulders beside the whole person are one pedestrian."""

from __future__ import annotations

import numpy as np
import pytest

from bikeped.detection.person_boxes import suppress_partial_person_boxes
from bikeped.types import Detections, Kind


def found(*rows: tuple[Kind, float, tuple[float, float, float, float]]) -> Detections:
    return Detections(
        np.asarray([r[0] for r in rows], np.int8),
        np.asarray([r[1] for r in rows], np.float32),
        np.asarray([r[2] for r in rows], np.float32).reshape(-1, 4),
    )


WHOLE = (594, 10, 625, 84)
HALF = (598, 11, 620, 47)


def test_the_whole_stays_and_takes_the_greater_confidence():
    left = suppress_partial_person_boxes(
        found((Kind.PEDESTRIAN, 0.4, HALF), (Kind.PEDESTRIAN, 0.17, WHOLE))
    )
    assert left.box_px.tolist() == [list(WHOLE)]
    assert left.confidence.tolist() == pytest.approx([0.4])


@pytest.mark.parametrize(
    "other",
    [
        pytest.param((598, 40, 620, 84), id="a child before an adult starts lower"),
        pytest.param((640, 11, 662, 47), id="someone beside"),
        pytest.param((595, 11, 624, 82), id="as tall: suppression is the judge"),
        pytest.param((598, 11, 606, 47), id="a narrow one within a group's box"),
    ],
)
def test_others_stay(other):
    both = found((Kind.PEDESTRIAN, 0.4, other), (Kind.PEDESTRIAN, 0.17, WHOLE))
    assert len(suppress_partial_person_boxes(both)) == 2


def test_other_kinds_are_left_alone():
    both = found((Kind.VEHICLE, 0.4, HALF), (Kind.PEDESTRIAN, 0.17, WHOLE))
    assert suppress_partial_person_boxes(both) is both
