"""Where a network takes something for somebody, and whom it misses: to be learnt from more often.

A street has thousands of places where nobody is and a few that look like somebody: a hydrant in the
rain, a leaf before the lens. Windows cut at random hardly ever show those few. So, some way into
the training, the network looks at the very pictures that it learns from; its mistakes become
windows of their own, and whom it missed comes more often (Sung and Poggio 1998, "Example-based
learning for view-based human face detection", section 2.5, who call it bootstrapping; Felzenszwalb
et al. 2010, "Object detection with discriminatively trained part-based models", section 4.4;
Shrivastava et al. 2016, "Training region-based object detectors with online hard example mining",
who take hard ones of both kinds).
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np

from bikeped.config.sections import DetectionConfig
from bikeped.detection import load_detector
from bikeped.detection.nms import overlap_matrix
from bikeped.training.coco import MISTAKEN, CocoData, CocoImage, CocoObject, furniture
from bikeped.training.crops import reduced_picture
from bikeped.training.export import export_network
from bikeped.training.network import SmallNet
from bikeped.training.quantise import quantise, shown_pictures
from bikeped.types import Detections, FloatArray, Kind

#: Shares of the steps: while it still learns fast, and again before it sees plain windows.
AFTER = (0.4, 0.7)
#: Mistakes of these kinds make a false alarm, and these are to be warned.
_KINDS = (Kind.PEDESTRIAN, Kind.CYCLIST)
_LABELS = {kind.label: kind for kind in _KINDS}
_FOUND_OVERLAP = 0.5  #: of its box, or somebody is missed


@dataclass(frozen=True)
class MiningSettings:
    """When the network looks, and what counts."""

    after: tuple[float, ...] = ()  #: shares of the steps
    confidence: float = 0.15  #: of a mistake, at least
    overlap: float = 0.1  #: with anybody, below which it is one
    sure: float = 0.4  #: confidence from which somebody is found
    #: Longest side of who can be missed, in pixels of what the network is shown: the far ones are
    #: many, and hardly to be found.
    least_px: float = 30.0
    processes: int = 2


@dataclass(frozen=True)
class Mined:
    """`data` with what was found, and how many: mistakes, and missed of all who were looked for."""

    data: CocoData
    mistakes: int
    missed: int
    asked: int


@dataclass(frozen=True)
class _Look:
    """A picture, who is in it, and the kind of each [n] (-1: of no kind that can be missed)."""

    image: CocoImage
    objects: Sequence[CocoObject]
    kinds: Sequence[int]


@dataclass(frozen=True)
class _Seen:
    """What came of it: boxes [n, 4] of what is nobody; for every object whether it was missed, None
    where it was not asked for."""

    mistakes: FloatArray
    missed: Sequence[bool | None]


def mine(
    network: SmallNet, data: CocoData, size: tuple[int, int], settings: MiningSettings
) -> Mined:
    """`data` with what `network` (in evaluation, on the CPU) takes for pedestrians and cyclists
    added to the furniture of its pictures, as `MISTAKEN`, and with `missed` of its objects set.

    Only who is of a category that is called as bikeped's kinds are can be missed. The network looks
    as it will on the street: in eight bits, at whole frames of `size` (width, height), through the
    service's `load_detector`. Raises DataSetError and DetectorError.
    """
    names = data.categories
    looks = [_look(image, data.objects[image.id], names) for image in data.images]
    with tempfile.TemporaryDirectory(prefix="bikeped-mining-") as folder:
        whole, model = Path(folder) / "whole.onnx", Path(folder) / "model.onnx"
        export_network(network, tuple(names.values()), size, whole, {})
        quantise(whole, shown_pictures(data, size), model)
        with ProcessPoolExecutor(settings.processes, mp_context=get_context("spawn")) as pool:
            parts = [
                pool.submit(_see, model, size, looks[part :: settings.processes], settings)
                for part in range(settings.processes)
            ]
            seen = {number: found for part in parts for number, found in part.result().items()}
    objects = {
        image.id: tuple(
            replace(item, missed=bool(missed))
            for item, missed in zip(data.objects[image.id], seen[image.id].missed, strict=True)
        )
        for image in data.images
    }
    images = tuple(_told(image, seen[image.id].mistakes) for image in data.images)
    missed = [m for found in seen.values() for m in found.missed if m is not None]
    return Mined(
        replace(data, images=images, objects=objects),
        sum(len(found.mistakes) for found in seen.values()),
        sum(missed),
        len(missed),
    )


def _look(image: CocoImage, objects: Sequence[CocoObject], names: Mapping[int, str]) -> _Look:
    kinds = [
        -1 if o.crowd or names[o.category_id] not in _LABELS else int(_LABELS[names[o.category_id]])
        for o in objects
    ]
    return _Look(image, objects, kinds)


def _see(
    model: Path, size: tuple[int, int], looks: Sequence[_Look], settings: MiningSettings
) -> dict[int, _Seen]:
    """By picture, what came of it; runs in a process of its own."""
    cv2.setNumThreads(1)
    order = DetectionConfig(model=str(model), confidence=settings.confidence, threads=1)
    detector = load_detector(order, Path("/"))
    found = {}
    for look in looks:
        image = look.image
        rgb = reduced_picture(image, *detector.decode_size(image.width, image.height))
        seen = detector.infer(rgb, image.width, image.height).detections
        scale = min(size[0] / image.width, size[1] / image.height)
        found[image.id] = _judged(look, seen, scale, settings)
    return found


def _judged(look: _Look, seen: Detections, scale: float, settings: MiningSettings) -> _Seen:
    """`scale`: pixels shown to the network for one of the picture."""
    people = np.array([o.box_px for o in look.objects], np.float32).reshape(-1, 4)
    overlap = overlap_matrix(seen.box_px, people)
    nobody = overlap.max(axis=1, initial=0.0) < settings.overlap
    mistakes = seen.box_px[nobody & np.isin(seen.kind, _KINDS)].astype(np.float64)
    kinds = np.array(look.kinds, np.int64)
    fits = (overlap >= _FOUND_OVERLAP) & (seen.kind[:, None] == kinds[None])
    fits &= (seen.confidence >= settings.sure)[:, None]
    side = (people[:, 2:] - people[:, :2]).max(axis=1, initial=0.0) * scale
    asked = (kinds >= 0) & (side >= settings.least_px)
    missed = [bool(m) if a else None for m, a in zip(~fits.any(axis=0), asked, strict=True)]
    return _Seen(mistakes, missed)


def _told(image: CocoImage, mistakes: FloatArray) -> CocoImage:
    """`image` with these mistakes as well; one that is made again counts again."""
    things = furniture(image) + [(MISTAKEN, box) for box in mistakes.tolist()]
    told = [{"what": w, "bbox": [u1, v1, u2 - u1, v2 - v1]} for w, (u1, v1, u2, v2) in things]
    return replace(image, entry={**image.entry, "furniture": told})
