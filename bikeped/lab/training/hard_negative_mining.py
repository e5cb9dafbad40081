"""Hard-negative mining: crops around false positives.

Most of a street is easy background; windows cut at random hardly ever show the few places that look
like a road user, such as a hydrant in the rain. So the network is run over its training pictures
between stages of the training, and its false positives become windows (Sung and Poggio 1998,
"Example-based learning for view-based human face detection", section 2.5; Felzenszwalb et al. 2010,
"Object detection with discriminatively trained part-based models", section 4.4).
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import load_detector
from bikeped.geometry.boxes import iou_matrix
from bikeped.lab.process_pool import worker_pool
from bikeped.lab.training.coco import FALSE_POSITIVE, CocoData, CocoImage, furniture
from bikeped.lab.training.crops import reduced_picture
from bikeped.lab.training.export import calibration_images, export_network, quantise
from bikeped.lab.training.network import SmallDetector, SmallNet
from bikeped.types import Float32Array, FloatArray, Kind

#: Shares of the steps: while learning is fast, and again before the plain windows.
MINING_ROUNDS = (0.4, 0.7)
#: False positives of these kinds cause false alarms.
_KINDS = (Kind.PEDESTRIAN, Kind.CYCLIST)
_LabelledImage = tuple[CocoImage, Float32Array]  #: and its objects [n, 4]


@dataclass(frozen=True)
class MiningSettings:
    """When false positives are mined, and what counts as one."""

    after: tuple[float, ...] = ()  #: shares of the steps
    confidence: float = 0.15  #: at least
    overlap: float = 0.1  #: IoU with every object is below this
    processes: int = 2


def mine_false_positives(
    network: SmallNet, data: CocoData, size: tuple[int, int], settings: MiningSettings
) -> tuple[CocoData, int]:
    """`data` with the false pedestrians and cyclists of `network` (in evaluation mode, on the CPU)
    added to the furniture of its pictures as `FALSE_POSITIVE`, in place of earlier ones, and their
    number.

    The network runs as deployed: in eight bits, at whole frames of `size` (width, height), through
    the service's `load_detector`. Raises DataSetError and DetectorError.
    """
    names = tuple(data.categories.values())
    labelled = [(i, _boxes(data, i)) for i in data.images]
    with tempfile.TemporaryDirectory(prefix="bikeped-mining-") as folder:
        whole, model = Path(folder) / "whole.onnx", Path(folder) / "model.onnx"
        export_network(SmallDetector(network, names, size), whole)
        quantise(whole, calibration_images(data, size), model)
        with worker_pool(settings.processes) as pool:
            parts = [
                pool.submit(_false_positives, model, labelled[part :: settings.processes], settings)
                for part in range(settings.processes)
            ]
            found = {number: boxes for part in parts for number, boxes in part.result().items()}
    images = tuple(_with_false_positives(image, found[image.id]) for image in data.images)
    return replace(data, images=images), sum(len(boxes) for boxes in found.values())


def _boxes(data: CocoData, image: CocoImage) -> Float32Array:
    return np.array([o.box_px for o in data.objects[image.id]], np.float32).reshape(-1, 4)


def _false_positives(
    model: Path, labelled: Sequence[_LabelledImage], settings: MiningSettings
) -> dict[int, FloatArray]:
    """False positives [n, 4] by picture id; runs in a process of its own."""
    cv2.setNumThreads(1)
    config = DetectionConfig(model=str(model), confidence=settings.confidence, threads=1)
    detector = load_detector(config, Path("/"))
    found = {}
    for image, objects in labelled:
        rgb = reduced_picture(image, *detector.decode_size(image.width, image.height))
        seen = detector.infer(rgb, image.width, image.height).detections
        overlap = iou_matrix(seen.box_px, objects).max(axis=1, initial=0.0)
        mistaken = (overlap < settings.overlap) & np.isin(seen.kind, _KINDS)
        found[image.id] = seen.box_px[mistaken].astype(np.float64)
    return found


def _with_false_positives(image: CocoImage, mistaken: FloatArray) -> CocoImage:
    """`image` with these false positives, and no others."""
    things = [(what, box) for what, box in furniture(image) if what != FALSE_POSITIVE]
    things += [(FALSE_POSITIVE, box) for box in mistaken.tolist()]
    entry = [{"what": w, "bbox": [u1, v1, u2 - u1, v2 - v1]} for w, (u1, v1, u2, v2) in things]
    return replace(image, entry={**image.entry, "furniture": entry})
