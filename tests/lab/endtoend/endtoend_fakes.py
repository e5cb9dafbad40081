"""Drawn objects and detections by hand."""

from __future__ import annotations

import numpy as np

from bikeped.lab.rendering import DrawnObject
from bikeped.types import Detections, Kind


def drawn(number: int, kind: Kind, box: tuple[float, float, float, float]) -> DrawnObject:
    return DrawnObject(
        id=number,
        kind=kind.label,
        label=kind,
        box_px=box,
        full_box_px=box,
        visible=1.0,
        xy_m=(5.0, 0.0),
        world_m=(5.0, -8.0),
        heading_rad=0.0,
    )


def found(*rows: tuple[Kind, tuple[float, float, float, float]]) -> Detections:
    return Detections(
        np.asarray([int(kind) for kind, _ in rows], np.int8),
        np.ones(len(rows), np.float32),
        np.asarray([box for _, box in rows], np.float32).reshape(-1, 4),
    )
