"""Where a network takes something for somebody: windows to learn from more often.

A street has thousands of places where nobody is and a few that look like somebody: a hydrant in the
rain, a leaf before the lens. Windows cut at random hardly ever show those few. So, some way into
the training, the network looks at the very pictures that it learns from, and its mistakes become
windows of their own (Sung and Poggio 1998, "Example-based learning for view-based human face
detection", section 2.5, who call it bootstrapping; Felzenszwalb et al. 2010, "Object detection with
discriminatively trained part-based models", section 4.4: data-mining hard negatives).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np

from bikeped.config.schema.inputs import DetectionConfig
from bikeped.detection import load_detector
from bikeped.geometry.boxes import iou_matrix
from bikeped.lab.training.coco import MISTAKEN, CocoData, CocoImage, furniture
from bikeped.lab.training.crops import reduced_picture
from bikeped.lab.training.export import export_network
from bikeped.lab.training.network import SmallNet
from bikeped.lab.training.quantise import quantise, shown_pictures
from bikeped.types import Float32Array, FloatArray, Kind

#: Shares of the steps: while it still learns fast, and again before it sees plain windows.
AFTER = (0.4, 0.7)
#: Mistakes of these kinds make a false alarm.
_KINDS = (Kind.PEDESTRIAN, Kind.CYCLIST)
_Look = tuple[CocoImage, Float32Array]  #: a picture and the boxes [n, 4] of everybody in it


@dataclass(frozen=True)
class MiningSettings:
    """When the network looks, and what counts."""

    after: tuple[float, ...] = ()  #: shares of the steps
    confidence: float = 0.15  #: of a mistake, at least
    overlap: float = 0.1  #: with anybody, below which it is one
    processes: int = 2


def with_mistakes(
    network: SmallNet, data: CocoData, size: tuple[int, int], settings: MiningSettings
) -> tuple[CocoData, int]:
    """`data` with what `network` (in evaluation, on the CPU) takes for pedestrians and cyclists
    among the furniture of its pictures, as `MISTAKEN`, and how many they are; those that were there
    before are gone.

    It looks as it will on the street: in eight bits, at whole frames of `size` (width, height),
    through the service's `load_detector`. Raises DataSetError and DetectorError.
    """
    names = tuple(data.categories.values())
    looks = [(i, _boxes(data, i)) for i in data.images]
    with tempfile.TemporaryDirectory(prefix="bikeped-mining-") as folder:
        whole, model = Path(folder) / "whole.onnx", Path(folder) / "model.onnx"
        export_network(network, names, size, whole, {})
        quantise(whole, shown_pictures(data, size), model)
        with ProcessPoolExecutor(settings.processes, mp_context=get_context("spawn")) as pool:
            parts = [
                pool.submit(_mistakes, model, looks[part :: settings.processes], settings)
                for part in range(settings.processes)
            ]
            found = {number: boxes for part in parts for number, boxes in part.result().items()}
    images = tuple(_told(image, found[image.id]) for image in data.images)
    return replace(data, images=images), sum(len(boxes) for boxes in found.values())


def _boxes(data: CocoData, image: CocoImage) -> Float32Array:
    return np.array([o.box_px for o in data.objects[image.id]], np.float32).reshape(-1, 4)


def _mistakes(
    model: Path, looks: Sequence[_Look], settings: MiningSettings
) -> dict[int, FloatArray]:
    """By picture, the boxes [n, 4] of what is nobody; runs in a process of its own."""
    cv2.setNumThreads(1)
    order = DetectionConfig(model=str(model), confidence=settings.confidence, threads=1)
    detector = load_detector(order, Path("/"))
    found = {}
    for image, people in looks:
        rgb = reduced_picture(image, *detector.decode_size(image.width, image.height))
        seen = detector.infer(rgb, image.width, image.height).detections
        overlap = iou_matrix(seen.box_px, people).max(axis=1, initial=0.0)
        mistaken = (overlap < settings.overlap) & np.isin(seen.kind, _KINDS)
        found[image.id] = seen.box_px[mistaken].astype(np.float64)
    return found


def _told(image: CocoImage, mistaken: FloatArray) -> CocoImage:
    """`image` with these mistakes, and no others."""
    things = [(what, box) for what, box in furniture(image) if what != MISTAKEN]
    things += [(MISTAKEN, box) for box in mistaken.tolist()]
    told = [{"what": w, "bbox": [u1, v1, u2 - u1, v2 - v1]} for w, (u1, v1, u2, v2) in things]
    return replace(image, entry={**image.entry, "furniture": told})
