"""Detections matched to drawn objects; recall and localisation error by kind and distance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bikeped.config.load import LoadedConfig
from bikeped.geometry.boxes import Boxes, iou_matrix
from bikeped.lab.endtoend.run import EndToEndRun
from bikeped.lab.rendering import DrawnObject
from bikeped.lab.simulation.perception import PerceptionResult
from bikeped.pipeline.track_and_decide import GroundMapper
from bikeped.types import BoolArray, Detections, FloatArray, IntArray, Kind

#: Bounds of the distance rings, metres from the camera.
RINGS_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 35.0)


@dataclass(frozen=True)
class Observations:
    """Every visible drawn object of every frame: arrays [n].

    Localisation errors (m): `found_m` of the detector's box, `exact_m` of the drawn box, `model_m`
    of the simulation's box model; NaN where there is none. `found`: detected; `kind_right`:
    detected with the right kind.
    """

    frames: int
    false: dict[Kind, int]  #: false detections, by their kind
    kind: FloatArray
    distance_m: FloatArray
    found: FloatArray
    kind_right: FloatArray
    found_m: FloatArray
    exact_m: FloatArray
    model_m: FloatArray


def collect_observations(
    runs: Sequence[EndToEndRun], seen: Sequence[PerceptionResult], loaded: LoadedConfig
) -> Observations:
    """The visible objects of all `runs`, and how each was detected; `seen`: by scenario."""
    ground_mapper = GroundMapper(loaded)
    rows: list[tuple[float, ...]] = []
    false = dict.fromkeys(Kind, 0)
    frames = 0
    for run, script in zip(runs, seen, strict=True):
        column = {agent.id: i for i, agent in enumerate(run.scenario.agents)}
        framing = ground_mapper.framing_for(run.width, run.height)
        for frame, (objects, detections) in enumerate(
            zip(run.objects, run.detections, strict=True)
        ):
            frames += 1
            matched = match_detections(detections, objects)
            for kind in detections.kind[matched.object < 0].tolist():
                false[Kind(kind)] += 1
            exact = Detections(
                np.zeros(len(objects), np.int8),
                np.ones(len(objects), np.float32),
                np.asarray([o.box_px for o in objects], np.float32).reshape(-1, 4),
            )
            found_xy, exact_xy = (
                _ground_points(ground_mapper, framing.frame_to_crop(boxes.bottom_centre_px()))
                for boxes in (detections, exact)
            )
            for index, item in enumerate(objects):
                if item.visible < MIN_VISIBLE or item.id not in column:
                    continue  # hidden, or a parked car of the drawn street
                d = int(matched.found[index])
                rows.append(
                    (
                        float(item.label),
                        float(np.hypot(*item.xy_m)),
                        float(d >= 0),
                        float(d >= 0 and detections.kind[d] == int(item.label)),
                        np.nan if d < 0 else float(np.hypot(*(found_xy[d] - item.xy_m))),
                        float(np.hypot(*(exact_xy[index] - item.xy_m))),
                        float(script.error_m[frame, column[item.id]]),
                    )
                )
    table = np.asarray(rows, np.float64).reshape(-1, 7)
    return Observations(frames, false, *table.T)


def _ground_points(ground_mapper: GroundMapper, crop_px: FloatArray) -> FloatArray:
    """Ground points [n, 2] of bottom centres; NaN above the horizon."""
    xy, valid = ground_mapper.table.lookup(crop_px)
    return np.asarray(np.where(valid[:, None], xy, np.nan))


Row = dict[str, float | str | int | None]


def recall_rows(observations: Observations) -> list[Row]:
    """Recall by kind and distance ring: `seen` object frames, the share `found` and `recall`
    (found with the right kind)."""
    return [
        {
            **ring,
            "seen": int(inside.sum()),
            "found": _mean(observations.found[inside]),
            "recall": _mean(observations.kind_right[inside]),
        }
        for ring, inside in _rings(observations)
    ]


def localisation_rows(observations: Observations) -> list[Row]:
    """Localisation error by kind and ring: mean and 90th percentile of the found boxes, and beside
    them, over the same objects, the exact boxes' and the simulation's box model's means, metres."""
    rows: list[Row] = []
    for ring, inside in _rings(observations):
        at = inside & np.isfinite(observations.found_m)
        error_m = observations.found_m[at]
        rows.append(
            {
                **ring,
                "found": len(error_m),
                "mean_m": _mean(error_m),
                "p90_m": float(np.percentile(error_m, 90)) if len(error_m) else None,
                "exact_box_mean_m": _mean(observations.exact_m[at]),
                "box_model_mean_m": _mean(observations.model_m[at]),
            }
        )
    return rows


def _mean(values: FloatArray) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


def _rings(observations: Observations) -> Iterator[tuple[Row, BoolArray]]:
    """By kind and distance ring: its keys, and which observations lie in it [n]."""
    distance_m = observations.distance_m
    for kind in Kind:
        for low, high in pairwise(RINGS_M):
            inside = (observations.kind == kind) & (distance_m >= low) & (distance_m < high)
            yield {"kind": kind.label, "from_m": low, "to_m": high}, np.asarray(inside)


#: Least overlap (intersection over union) of a detection with its object.
#: Below COCO's 0.5: a pedestrian at 20 m is four pixels wide; half a pixel costs a fifth of IoU.
MIN_IOU = 0.3
#: Objects with a smaller visible share are not counted as missed.
MIN_VISIBLE = 0.25


@dataclass(frozen=True)
class DetectionMatch:
    """`object` [d]: index of the object that each detection is, or -1; `found` [o] the reverse."""

    object: IntArray
    found: IntArray


def match_detections(detections: Detections, objects: Sequence[DrawnObject]) -> DetectionMatch:
    """Greedy by overlap; a detection of the right kind comes before any of a wrong one."""
    of_detection = np.full(len(detections), -1)
    of_object = np.full(len(objects), -1)
    if len(detections) and objects:
        overlap = iou_matrix(
            detections.box_px.astype(np.float64), np.asarray([o.box_px for o in objects], float)
        )
        same = detections.kind[:, None] == np.asarray([int(o.label) for o in objects])[None, :]
        for mask in (same, ~same):
            for d, o in _best_first(np.where(mask, overlap, 0.0)):
                if of_detection[d] < 0 and of_object[o] < 0:
                    of_detection[d], of_object[o] = o, d
    return DetectionMatch(of_detection, of_object)


def _best_first(overlap: Boxes) -> list[tuple[int, int]]:
    d, o = np.nonzero(overlap >= MIN_IOU)
    order = np.argsort(-overlap[d, o], kind="stable")
    return list(zip(d[order].tolist(), o[order].tolist(), strict=True))
