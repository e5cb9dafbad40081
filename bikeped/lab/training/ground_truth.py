"""Ground truth of a data set as arrays: boxes by class, or as road users.

Road users are as deployed: a person on a bicycle and the bicycle are one cyclist, joined by the
function that joins the detector's boxes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bikeped.config.schema.inputs import DetectionConfig
from bikeped.detection.classes import WITH_RIDER
from bikeped.detection.riders import join_riders
from bikeped.lab.training.coco import CocoData, CocoImage, CocoObject
from bikeped.lab.training.measures import GroundTruth
from bikeped.types import Detections, Kind

#: Side of the network input that areas are measured at (definitions, section 3).
INPUT_PX = 1280


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
    rows = _TruthBuilder()
    for number, picture in enumerate(data.images):
        for thing in data.objects[picture.id]:
            if thing.category_id in group_of:
                rows.add(number, picture, group_of[thing.category_id], thing)
    return rows.truth()


def road_user_truth(
    data: CocoData, kind_of: Mapping[int, Kind], detection: DetectionConfig
) -> GroundTruth:
    """Road users by kind, riders joined to their cycles."""
    rows = _TruthBuilder()
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
        for thing in things:
            if thing not in parts:
                rows.add(number, picture, int(kind_of[thing.category_id]), thing)
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
            rows.add(number, picture, kind, CocoObject(0, picture.id, 0, tuple(box)))
    return rows.truth()


class _TruthBuilder:
    """Objects gathered for a `GroundTruth`, boxes in pixels at the network's input."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, bool, float]] = []
        self._boxes: list[Any] = []

    def add(self, number: int, picture: CocoImage, group: int, thing: CocoObject) -> None:
        """One object of picture `number`."""
        scale = INPUT_PX / max(picture.width, picture.height)
        distance_m = np.nan if thing.distance_m is None else thing.distance_m
        self._rows.append((number, group, thing.crowd, distance_m))
        self._boxes.append(np.multiply(thing.box_px, scale))

    def truth(self) -> GroundTruth:
        """All of them."""
        rows = self._rows
        return GroundTruth(
            np.array([row[0] for row in rows], np.int64),
            np.array([row[1] for row in rows], np.int64),
            np.array(self._boxes, np.float64).reshape(-1, 4),
            np.array([row[2] for row in rows], np.bool_),
            np.array([row[3] for row in rows], np.float64),
        )


def plain_name(name: str) -> str:
    """A class name for comparison: lower case, without outer blanks."""
    return name.strip().lower()
