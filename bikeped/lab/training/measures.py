"""COCO's detection measures by pycocotools, and recall against area and distance.

Average precision is the mean over IoU 0.50, 0.55, ... 0.95 of the area under the interpolated
precision-recall curve; average recall the mean over the same of the largest recall with at most 100
boxes a picture (cocodataset.org, "Detection evaluation"). A crowd region neither counts nor harms.

The ground truth of a data set is boxes by class, or road users as deployed: a person on a bicycle
and the bicycle are one cyclist, joined by the function that joins the detector's boxes.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.config.schema import DetectionConfig
from bikeped.detection.model_metadata import WITH_RIDER
from bikeped.detection.person_boxes import join_riders
from bikeped.errors import require
from bikeped.lab.simulation.perception import SIZE_BOUNDS_PX2
from bikeped.lab.training.coco import CocoData, CocoImage, CocoObject
from bikeped.types import BoolArray, Detections, Float32Array, FloatArray, IntArray, Kind

MAX_DETECTIONS = 100  #: of one picture and class, as COCO has it
#: Edges of the area bins of the recall curve, square pixels at the network's input.
BIN_EDGES_PX2: tuple[float, ...] = tuple(
    float(side) ** 2 for side in (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 512)
)
#: Edges of the bins of recall against distance, metres.
DISTANCE_EDGES_M: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
_HUGE = 1e10
#: Side of the network input that areas are measured at (definitions, section 3).
INPUT_PX = 1280
_Row = tuple[int, int, bool, float, FloatArray]


@dataclass(frozen=True)
class GroundTruth:
    """Objects of all pictures: `image` [n], `category` [n] from 0, `box_px` [n, 4], `crowd` [n].

    `distance_m` [n] is NaN where it is not known.
    """

    image: IntArray
    category: IntArray
    box_px: FloatArray
    crowd: BoolArray
    distance_m: FloatArray

    @property
    def area_px2(self) -> FloatArray:
        """[n] of the boxes."""
        return _area(self.box_px)


@dataclass(frozen=True)
class DetectionSet:
    """Detections of all pictures: as `GroundTruth`, with `score` [n] in 0..1."""

    image: IntArray
    category: IntArray
    box_px: FloatArray
    score: Float32Array


@dataclass(frozen=True)
class ClassMeasures:
    """The measures of one class; None where there is no object to measure by."""

    name: str
    objects: int
    ap: float | None
    ap50: float | None
    ar: float | None
    ar_by_size: tuple[float | None, float | None, float | None]  #: small, medium, large
    objects_by_size: tuple[int, int, int]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        body = asdict(self)
        sizes = zip(("small", "medium", "large"), body.pop("ar_by_size"), strict=True)
        return body | {f"ar_{size}": recall for size, recall in sizes}


@dataclass(frozen=True)
class Measures:
    """`rows` a class, `overall` the mean over classes that have objects.

    `hits` [n, 10]: whether each object of the truth was found, at IoU 0.50 ... 0.95. `false` counts
    the answers of each class that are no object and no crowd at IoU 0.50.
    """

    rows: tuple[ClassMeasures, ...]
    overall: ClassMeasures
    hits: BoolArray
    false: tuple[int, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"all": self.overall.as_dict(), "rows": [row.as_dict() for row in self.rows]}


@dataclass(frozen=True)
class RecallCurve:
    """Recall against area: per bin the mean area of its objects, recall, and how many they are.

    `recall` is the mean over IoU 0.50 ... 0.95, `recall50` at 0.50.
    """

    area_px2: tuple[float, ...]
    recall: tuple[float, ...]
    recall50: tuple[float, ...]
    objects: tuple[int, ...]


def measure(truth: GroundTruth, found: DetectionSet, names: Sequence[str], images: int) -> Measures:
    """COCO's measures of detections in pictures 0 ... `images` - 1.

    Boxes are in pixels at the network's input: their areas make small, medium and large (32 and 96
    pixels squared).
    """
    evaluation = _evaluation(truth, found, len(names), images)
    precision, recall = evaluation.eval["precision"], evaluation.eval["recall"]
    bins = np.searchsorted(SIZE_BOUNDS_PX2, truth.area_px2, side="right")
    rows = []
    for index, name in enumerate(names):
        own = (truth.category == index) & ~truth.crowd
        sizes = [int(np.count_nonzero(own & (bins == size))) for size in range(3)]
        rows.append(
            ClassMeasures(
                name,
                int(np.count_nonzero(own)),
                _mean(precision[:, :, index, 0, -1]),
                _mean(precision[0, :, index, 0, -1]),
                _mean(recall[:, index, 0, -1]),
                tuple(_mean(recall[:, index, size, -1]) for size in (1, 2, 3)),  # type: ignore[arg-type]
                (sizes[0], sizes[1], sizes[2]),
            )
        )
    hits, false = _hits(evaluation, len(truth.image), len(names))
    return Measures(tuple(rows), _overall(rows), hits, false)


def recall_curve(
    truth: GroundTruth, hits: BoolArray, least_objects: int, category: int | None = None
) -> RecallCurve:
    """Recall over area bins, of all classes together or of one.

    A bin with fewer than `least_objects` objects is merged into the next larger one, the last one
    into the one before. Without objects the curve is empty.
    """
    own = ~truth.crowd
    if category is not None:
        own = own & (truth.category == category)
    area, hit = truth.area_px2[own], hits[own]
    which = np.searchsorted(BIN_EDGES_PX2, area, side="right")
    groups: list[BoolArray] = []
    open_group = np.zeros(len(area), np.bool_)
    for number in range(len(BIN_EDGES_PX2) + 1):
        open_group = open_group | (which == number)
        if np.count_nonzero(open_group) >= max(least_objects, 1):
            groups.append(open_group)
            open_group = np.zeros(len(area), np.bool_)
    if open_group.any():
        groups = [*groups[:-1], groups[-1] | open_group] if groups else [open_group]
    return RecallCurve(
        tuple(float(area[group].mean()) for group in groups),
        tuple(float(hit[group].mean()) for group in groups),
        tuple(float(hit[group, 0].mean()) for group in groups),
        tuple(int(np.count_nonzero(group)) for group in groups),
    )


def recall_by_distance(truth: GroundTruth, hits: BoolArray, category: int) -> list[dict[str, Any]]:
    """Objects and found objects (IoU 0.50) of one class by distance.

    Bins without objects and objects of unknown distance are left out.
    """
    own = (truth.category == category) & ~truth.crowd & np.isfinite(truth.distance_m)
    ends = (*DISTANCE_EDGES_M[1:], np.inf)
    rows = []
    for start, end in zip(DISTANCE_EDGES_M, ends, strict=True):
        here = own & (truth.distance_m >= start) & (truth.distance_m < end)
        if here.any():
            count, found = np.count_nonzero(here), np.count_nonzero(hits[here, 0])
            rows.append(
                {
                    "from_m": start,
                    "to_m": None if np.isinf(end) else end,
                    "objects": int(count),
                    "found": int(found),
                    "recall50": found / count,
                }
            )
    return rows


def _evaluation(truth: GroundTruth, found: DetectionSet, classes: int, images: int) -> Any:
    require("pycocotools")
    from pycocotools.cocoeval import COCOeval

    gt = _annotations(truth, "iscrowd", truth.crowd.astype(int))
    dt = _annotations(found, "score", found.score)
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        evaluation = COCOeval(
            _coco(gt, classes, images), _coco(dt, classes, images), iouType="bbox"
        )
        small, medium = SIZE_BOUNDS_PX2
        evaluation.params.areaRng = [[0, _HUGE], [0, small], [small, medium], [medium, _HUGE]]
        evaluation.params.areaRngLbl = ["all", "small", "medium", "large"]
        evaluation.params.maxDets = [MAX_DETECTIONS]
        evaluation.evaluate()
        evaluation.accumulate()
    return evaluation


def _annotations(
    boxes: GroundTruth | DetectionSet, key: str, values: npt.NDArray[Any]
) -> list[dict[str, Any]]:
    """COCO's entries, with `values` [n] as `key`. Ids are from 1: as a match, 0 means none."""
    size = boxes.box_px[:, 2:] - boxes.box_px[:, :2]
    rows = zip(
        boxes.image.tolist(),
        boxes.category.tolist(),
        np.hstack([boxes.box_px[:, :2], size]).tolist(),
        _area(boxes.box_px).tolist(),
        values.tolist(),
        strict=True,
    )
    keys = ("image_id", "category_id", "bbox", "area", key)
    return [{"id": i, **dict(zip(keys, row, strict=True))} for i, row in enumerate(rows, 1)]


def _coco(annotations: list[dict[str, Any]], classes: int, images: int) -> Any:
    from pycocotools.coco import COCO

    coco = COCO()
    coco.dataset = {
        "images": [{"id": i} for i in range(images)],
        "categories": [{"id": i} for i in range(classes)],
        "annotations": annotations,
    }
    coco.createIndex()
    return coco


def _hits(evaluation: Any, objects: int, classes: int) -> tuple[BoolArray, tuple[int, ...]]:
    """See `Measures`: `hits` and `false`."""
    hits = np.zeros((objects, len(evaluation.params.iouThrs)), np.bool_)
    false = [0] * classes
    everything = evaluation.params.areaRng[0]
    for image in evaluation.evalImgs:
        if image is not None and image["aRng"] == everything:
            index = np.asarray(image["gtIds"], np.int64) - 1
            hits[index] = (np.asarray(image["gtMatches"]) > 0).T
            unmatched = np.asarray(image["dtMatches"])[0] == 0
            wrong = unmatched & (np.asarray(image["dtIgnore"])[0] == 0)
            false[image["category_id"]] += int(np.count_nonzero(wrong))
    return hits, tuple(false)


def _overall(rows: Sequence[ClassMeasures]) -> ClassMeasures:
    def mean(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known else None

    return ClassMeasures(
        "all",
        sum(row.objects for row in rows),
        mean([row.ap for row in rows]),
        mean([row.ap50 for row in rows]),
        mean([row.ar for row in rows]),
        tuple(mean([row.ar_by_size[size] for row in rows]) for size in range(3)),  # type: ignore[arg-type]
        tuple(sum(row.objects_by_size[size] for row in rows) for size in range(3)),  # type: ignore[arg-type]
    )


def _mean(values: FloatArray) -> float | None:
    """The mean of the measured values: pycocotools gives -1 for none."""
    known = values[values > -1]
    return float(known.mean()) if known.size else None


def _area(box_px: FloatArray) -> FloatArray:
    return np.asarray((box_px[:, 2] - box_px[:, 0]) * (box_px[:, 3] - box_px[:, 1]))


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
