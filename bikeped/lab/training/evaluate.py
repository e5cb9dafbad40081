"""Evaluates detectors on a data set: the paper's detection table for any model and data.

The same network outputs are evaluated in three ways:

`classes`     the network's own classes against the data's, matched by name: COCO's usual measures.
`merged`      classes merged to pedestrian, cyclist and vehicle by the names in `detection`, as in
              the paper's table: a bicycle is a bicycle's box, and its rider a person.
`road_users`  as deployed, at the configured confidence and suppression, riders joined to their
              cycles by `detection/person_boxes.py`, in the ground truth too: one cyclist, whose
              box holds both. Data with whole cyclists (`cyclist`) are used as they are.

The simulation's recall curve is that of `road_users`, for its objects are road users.

Areas are square pixels at a network input of 1280 pixels, for any network: a picture of w x h is
scaled by 1280 / max(w, h), as by letterboxing. For the sensor's 3840 x 2160 this is the
definitions' (1280/3840)^2.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from bikeped import __version__
from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import Detector, load_detector
from bikeped.detection.nms import non_max_suppression
from bikeped.detection.output_layouts import Candidates
from bikeped.errors import DataSetError, require
from bikeped.files import write_whole
from bikeped.lab.training.coco import CocoData, read_picture
from bikeped.lab.training.measures import (
    INPUT_PX,
    DetectionSet,
    GroundTruth,
    Measures,
    RecallCurve,
    category_truth,
    kinds_by_name,
    measure,
    plain_name,
    recall_by_distance,
    recall_curve,
    road_user_truth,
)
from bikeped.types import Detections, Kind

KIND_NAMES = tuple(kind.label for kind in Kind)
_MAX_DETECTIONS = 300  # more than the measures read


@dataclass(frozen=True)
class EvaluationSettings:
    """`confidence` and `iou` (of suppression) are for `classes` and `merged` only."""

    confidence: float = 0.001
    iou: float = 0.65
    least_objects: int = 20  #: per bin of the recall curve


@dataclass(frozen=True)
class ModelUnderTest:
    """A loaded model and its label in tables."""

    label: str
    path: Path
    detector: Detector


@dataclass(frozen=True)
class ModelScores:
    """Everything measured of one model."""

    label: str
    facts: dict[str, Any]
    classes: Measures | None  #: None where model and data share no class
    merged: Measures
    road_users: Measures
    curve: RecallCurve
    curves: dict[str, RecallCurve]  #: the same by kind
    by_distance: dict[str, list[dict[str, Any]]]  #: of road users, by kind


@dataclass(frozen=True)
class Evaluation:
    """Models measured over the same data, in the order given; the first is the baseline."""

    data: dict[str, Any]
    settings: dict[str, Any]
    scores: tuple[ModelScores, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "version": __version__,
            "data": self.data,
            "settings": self.settings,
            "models": [self._model_dict(score) for score in self.scores],
        }

    def _model_dict(self, score: ModelScores) -> dict[str, Any]:
        parts = {name: getattr(score, name) for name in ("classes", "merged", "road_users")}
        false = zip(KIND_NAMES, score.road_users.false, strict=True)
        curves = {"all": score.curve, **score.curves}
        return {
            "label": score.label,
            **score.facts,
            **{name: part and part.as_dict() for name, part in parts.items()},
            "false_per_100_pictures": {
                name: 100 * count / self.data["images"] for name, count in false
            },
            "recall_by_distance": score.by_distance,
            "recall_curve": {name: asdict(curve) for name, curve in curves.items()},
        }


def load_models(
    named: Sequence[tuple[str, Path]], detection: DetectionConfig
) -> list[ModelUnderTest]:
    """Model files by label, loaded with the `detection` section but for its own model.

    Raises DetectorError for a file that cannot be run, DataSetError for two of one name.
    """
    labels = [label for label, _ in named]
    for label in labels:
        if labels.count(label) > 1:
            raise DataSetError(f"MODEL: two are called {label!r}; name them apart with NAME=FILE")
    models = []
    for label, path in named:
        config = msgspec.structs.replace(detection, model=str(path.absolute()), sha256=None)
        models.append(ModelUnderTest(label, path, load_detector(config, Path())))
    return models


def evaluate(
    data: CocoData,
    models: Sequence[ModelUnderTest],
    detection: DetectionConfig,
    settings: EvaluationSettings | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Evaluation:
    """Runs every model over every picture once, and measures.

    Raises DataSetError for data without road users (by the names in `detection`) and for pictures
    that cannot be read.
    """
    require("pycocotools")
    settings = settings or EvaluationSettings()
    kind_of = kinds_by_name(data.categories, detection)
    if not kind_of or not any(
        thing.category_id in kind_of and not thing.crowd
        for found in data.objects.values()
        for thing in found
    ):
        raise DataSetError(
            f"{data.source}: holds no pedestrian, cyclist or vehicle by the names in "
            "detection.pedestrian, detection.cyclist and detection.vehicle; name its categories "
            "there"
        )
    known = [{plain_name(name) for name in model.detector.class_names} for model in models]
    shared = [i for i, name in data.categories.items() if all(plain_name(name) in k for k in known)]
    gathered = [_ModelResults(model, data, shared, detection, settings) for model in models]
    for done, image in enumerate(data.images):
        picture = read_picture(image)
        scale = INPUT_PX / max(image.width, image.height)
        for model, its in zip(models, gathered, strict=True):
            users, every = model.detector.infer_classes(
                picture, image.width, image.height, settings.confidence
            )
            its.add(done, users, every, scale)
        progress(done + 1)
    truths = (
        category_truth(data, {category: n for n, category in enumerate(shared)}),
        category_truth(data, {category: int(kind) for category, kind in kind_of.items()}),
        road_user_truth(data, kind_of, detection),
    )
    names = [data.categories[category] for category in shared]
    return Evaluation(
        {
            "source": str(data.source),
            "sha256": data.sha256,
            "images": len(data.images),
            "objects": data.count,
            "crowds": sum(t.crowd for found in data.objects.values() for t in found),
            "boxes_without_area": data.empty,
            "categories_not_known_to_every_model": [
                name for i, name in data.categories.items() if i not in shared
            ],
        },
        {
            "area_input_px": INPUT_PX,
            **asdict(settings),
            "deployed_confidence": detection.confidence,
            "deployed_iou": detection.iou,
            "rider_overlap": detection.rider_overlap,
        },
        tuple(its.score(truths, names, len(data.images)) for its in gathered),
    )


def write_curve(path: Path, curve: RecallCurve, at_iou_50: bool = False) -> None:
    """Writes a recall curve as the conformance simulation reads it with `--recall-curve`.

    CSV, or JSON where the name ends so. `at_iou_50` writes recall at IoU 0.50 instead of the mean
    over 0.50 to 0.95. Raises DataSetError for a curve of fewer than two bins.
    """
    if len(curve.area_px2) < 2:
        raise DataSetError(
            f"{path}: the data have too few road users for a recall curve of two bins or more; "
            "evaluate more pictures, or lower --least-objects"
        )
    recall = curve.recall50 if at_iou_50 else curve.recall
    if path.suffix == ".json":
        body = {"area_px2": list(curve.area_px2), "recall": list(recall)}
        write_whole(path, json.dumps({**body, "objects": list(curve.objects)}, indent=2) + "\n")
        return
    pairs = zip(curve.area_px2, recall, strict=True)
    lines = [f"{area!r},{share!r}" for area, share in pairs]
    write_whole(path, "\n".join(["area_px2,recall", *lines]) + "\n")


_NONE = np.zeros(0, np.int64)
_EMPTY = (_NONE, _NONE, np.zeros((0, 4)), np.zeros(0, np.float32))


class _ModelResults:
    """The detections of one model in all pictures, grouped in the three ways."""

    def __init__(
        self,
        model: ModelUnderTest,
        data: CocoData,
        shared: Sequence[int],
        detection: DetectionConfig,
        settings: EvaluationSettings,
    ) -> None:
        self._model, self._settings = model, settings
        names = model.detector.class_names
        place = {plain_name(data.categories[category]): n for n, category in enumerate(shared)}
        kinds = kinds_by_name(dict(enumerate(names)), detection)
        self._class_of = np.array([place.get(plain_name(name), -1) for name in names], np.int64)
        self._kind_of = np.array([int(kinds.get(n, -1)) for n in range(len(names))], np.int64)
        self._found: tuple[list[tuple[Any, ...]], ...] = ([_EMPTY], [_EMPTY], [_EMPTY])

    def add(self, image: int, users: Detections, every: Candidates, scale: float) -> None:
        """Adds one picture's detections; `scale` is from its pixels to the network's input."""
        groups = []
        for group_of in (self._class_of, self._kind_of):
            group = group_of[every.class_id]
            wanted = group >= 0
            box, score, group = every.box[wanted], every.score[wanted], group[wanted]
            keep = non_max_suppression(box, score, group, self._settings.iou, _MAX_DETECTIONS)
            groups.append((group[keep], box[keep], score[keep]))
        groups.append((users.kind.astype(np.int64), users.box_px, users.confidence))
        for found, (group, box, score) in zip(self._found, groups, strict=True):
            number = np.full(len(score), image, np.int64)
            found.append((number, group, (box * scale).astype(np.float64), score))

    def score(
        self, truths: Sequence[GroundTruth], names: Sequence[str], images: int
    ) -> ModelScores:
        """Measures everything that was added."""
        found = [
            DetectionSet(*map(np.concatenate, zip(*rows, strict=True))) for rows in self._found
        ]
        users, least = (
            measure(truths[2], found[2], KIND_NAMES, images),
            self._settings.least_objects,
        )
        detector = self._model.detector
        return ModelScores(
            self._model.label,
            {
                "file": str(self._model.path),
                "sha256": detector.model_hash,
                "input_px": list(detector.input_size),
                "classes_in_model": len(detector.class_names),
            },
            measure(truths[0], found[0], names, images) if names else None,
            measure(truths[1], found[1], KIND_NAMES, images),
            users,
            recall_curve(truths[2], users.hits, least),
            {k.label: recall_curve(truths[2], users.hits, least, int(k)) for k in Kind},
            {kind.label: recall_by_distance(truths[2], users.hits, int(kind)) for kind in Kind},
        )
