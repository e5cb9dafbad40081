"""How well the detector finds what was drawn, and how well its boxes lie on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bikeped.config import LoadedConfig
from bikeped.lab.endtoend.matching import MIN_VISIBLE, match_detections
from bikeped.lab.endtoend.run import EndToEndRun
from bikeped.lab.simulation.perception import PerceptionResult
from bikeped.pipeline.ground_mapper import GroundMapper
from bikeped.types import Detections, FloatArray, Kind

#: Bounds of the distance rings, metres from the camera.
RINGS_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 35.0)


@dataclass(frozen=True)
class Observations:
    """Every drawn object of every frame that could be seen: arrays [n].

    `found_m` is how far from its true place the detector's box puts it on the ground, `exact_m` its
    exact box, `model_m` the simulation's box model; NaN where there is none. `found` says whether
    it was found, `kind_right` whether as what it is.
    """

    frames: int
    false: dict[Kind, int]  #: detections that are nobody, by what they were taken for
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
    """What there was to see in `runs`, and what became of it."""
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
            found_xy = _on_ground(
                ground_mapper, framing.frame_to_crop(detections.bottom_centre_px())
            )
            boxes = Detections(
                np.zeros(len(objects), np.int8),
                np.ones(len(objects), np.float32),
                np.asarray([o.box_px for o in objects], np.float32).reshape(-1, 4),
            )
            exact_xy = _on_ground(ground_mapper, framing.frame_to_crop(boxes.bottom_centre_px()))
            for index, item in enumerate(objects):
                if item.visible < MIN_VISIBLE or item.id not in column:
                    continue  # hidden; or a parked car, which no scenario knows
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


def _on_ground(ground_mapper: GroundMapper, crop_px: FloatArray) -> FloatArray:
    """[n, 2] places of bottom centres; NaN where they lie on no ground."""
    xy, valid = ground_mapper.table.lookup(crop_px)
    return np.asarray(np.where(valid[:, None], xy, np.nan))


def recall_rows(all_sights: Observations) -> list[dict[str, float | str | int | None]]:
    """Recall by kind and distance ring: `seen` object frames, the share `found` and `recall`
    (found as what it is)."""
    rows: list[dict[str, float | str | int | None]] = []
    for kind, low, high, there in _cells(all_sights):
        count = int(there.sum())
        rows.append(
            {
                "kind": kind.label,
                "from_m": low,
                "to_m": high,
                "seen": count,
                "found": float(all_sights.found[there].mean()) if count else None,
                "recall": float(all_sights.kind_right[there].mean()) if count else None,
            }
        )
    return rows


def localisation_rows(all_sights: Observations) -> list[dict[str, float | str | int | None]]:
    """Localisation error by kind and ring: mean and 90th percentile of the found boxes, and beside
    them, over the same objects, the exact boxes' and the simulation's box model's means, metres."""
    rows: list[dict[str, float | str | int | None]] = []
    for kind, low, high, there in _cells(all_sights):
        there = there & np.isfinite(all_sights.found_m)
        count = int(there.sum())
        found = all_sights.found_m[there]
        rows.append(
            {
                "kind": kind.label,
                "from_m": low,
                "to_m": high,
                "found": count,
                "mean_m": float(found.mean()) if count else None,
                "p90_m": float(np.percentile(found, 90)) if count else None,
                "exact_box_mean_m": _mean(all_sights.exact_m[there]),
                "box_model_mean_m": _mean(all_sights.model_m[there]),
            }
        )
    return rows


def _mean(values: FloatArray) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


def _cells(all_sights: Observations) -> list[tuple[Kind, float, float, np.ndarray]]:  # type: ignore[type-arg]
    return [
        (
            kind,
            low,
            high,
            (all_sights.kind == kind)
            & (all_sights.distance_m >= low)
            & (all_sights.distance_m < high),
        )
        for kind in Kind
        for low, high in pairwise(RINGS_M)
    ]
