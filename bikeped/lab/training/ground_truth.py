"""Ground truth of a data set as arrays: boxes by class, or as road users.

Road users are as deployed: a person on a bicycle and the bicycle are one cyclist, joined by the
function that joins the detector's boxes.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from bikeped.config.schema import DetectionConfig
from bikeped.detection.model_metadata import WITH_RIDER
from bikeped.detection.person_boxes import join_riders
from bikeped.lab.training.coco import CocoData, CocoImage, CocoObject
from bikeped.lab.training.measures import GroundTruth
from bikeped.types import Detections, FloatArray, Kind

#: Side of the network input that areas are measured at (definitions, section 3).
INPUT_PX = 1280
_Row = tuple[int, int, bool, float, FloatArray]


def kinds_by_name(names: Mapping[int, str], detection: DetectionConfig) -> dict[int, Kind]:
    """Which of the named classes are which kind of road user."""
    wanted = {
        plain_name(name): kind
        for kind, given in (
            (Kind.PEDESTRIAN, detection.pedestrian),
            (Kind.CYCLIST, detection.cyclist),
            (Kind.VEHICLE, detection.vehicle),
        )
        for name in given
    }
    return {i: wanted[plain_name(name)] for i, name in names.items() if plain_name(name) in wanted}


def category_truth(data: CocoData, group_of: Mapping[int, int]) -> GroundTruth:
    """Boxes with their categories mapped by `group_of`; others are left out."""
    return _truth(
        [
            _row(number, picture, group_of[thing.category_id], thing)
            for number, picture in enumerate(data.images)
            for thing in data.objects[picture.id]
            if thing.category_id in group_of
        ]
    )


def road_user_truth(
    data: CocoData, kind_of: Mapping[int, Kind], detection: DetectionConfig
) -> GroundTruth:
    """Road users by kind, riders joined to their cycles."""
    rows: list[_Row] = []
    bare = {
        i
        for i, kind in kind_of.items()
        if kind is Kind.CYCLIST and plain_name(data.categories[i]) not in WITH_RIDER
    }
    people = {i for i, kind in kind_of.items() if kind is Kind.PEDESTRIAN}
    for number, picture in enumerate(data.images):
        things = [t for t in data.objects[picture.id] if t.category_id in kind_of]
        parts: list[CocoObject] = []
        if any(t.category_id in bare and not t.crowd for t in things):
            parts = [t for t in things if t.category_id in bare | people and not t.crowd]
        rows += [
            _row(number, picture, int(kind_of[t.category_id]), t) for t in things if t not in parts
        ]
        joined = join_riders(
            Detections(
                np.array([kind_of[t.category_id] for t in parts], np.int8),
                np.ones(len(parts), np.float32),
                np.array([t.box_px for t in parts], np.float32).reshape(-1, 4),
            ),
            detection.rider_overlap,
            detection.confidence,
        )
        for kind, box in zip(joined.kind.tolist(), joined.box_px.tolist(), strict=True):
            rows.append(_row(number, picture, kind, CocoObject(0, picture.id, 0, tuple(box))))
    return _truth(rows)


def _row(number: int, picture: CocoImage, group: int, thing: CocoObject) -> _Row:
    """One object of picture `number`, its box in pixels at the network's input."""
    scale = INPUT_PX / max(picture.width, picture.height)
    distance_m = np.nan if thing.distance_m is None else thing.distance_m
    return number, group, thing.crowd, distance_m, np.multiply(thing.box_px, scale)


def _truth(rows: list[_Row]) -> GroundTruth:
    number, group, crowd, distance_m, box = zip(*rows, strict=True) if rows else [()] * 5
    return GroundTruth(
        np.array(number, np.int64),
        np.array(group, np.int64),
        np.array(box, np.float64).reshape(-1, 4),
        np.array(crowd, np.bool_),
        np.array(distance_m, np.float64),
    )


def plain_name(name: str) -> str:
    """A class name for comparison: lower case, without outer blanks."""
    return name.strip().lower()
