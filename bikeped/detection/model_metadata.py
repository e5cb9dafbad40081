"""Metadata of a model file: class names, input size, task; and its classes as kinds of road user.

Ultralytics writes metadata as text into the ONNX metadata map (each value a Python literal) and as
JSON in front of a TensorRT engine. Both become one mapping here; a value may be text or already
decoded. Nothing is evaluated: `ast.literal_eval` accepts literals only.
"""

from __future__ import annotations

import ast
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.config.schema import DetectionConfig
from bikeped.errors import DetectorError
from bikeped.types import Kind, KindArray, Region

_LONGEST_LITERAL = 1 << 20
_DEFAULT_SIZE = 640  #: Ultralytics' default, where neither the shape nor the metadata names one
_LARGEST_SIDE = 16384
_COARSEST = 32  #: YOLO networks want sides that are multiples of their largest stride
#: Padding above and below the region, together: the network has learnt persons cut off by the edge
#: with padding beyond it.
_EDGE_PX = 12
_INPUT_TYPES = (np.dtype(np.float32), np.dtype(np.float16), np.dtype(np.uint8))
log = logging.getLogger(__name__)
#: Classes whose box holds a cycle and its rider; COCO's `bicycle` is the cycle alone.
WITH_RIDER = frozenset({"cyclist", "bicyclist", "motorcyclist", "rider"})
UNMAPPED = -1  #: in a kind table: a class that is no road user
_COCO = (
    "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,"
    "stop sign,parking meter,bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,"
    "backpack,umbrella,handbag,tie,suitcase,frisbee,skis,snowboard,sports ball,kite,"
    "baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,cup,fork,"
    "knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,"
    "chair,couch,potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,keyboard,"
    "cell phone,microwave,oven,toaster,sink,refrigerator,book,clock,vase,scissors,teddy bear,"
    "hair drier,toothbrush"
)
#: The 80 classes of COCO in the order that detectors number them (cocodataset.org).
COCO_NAMES: tuple[str, ...] = tuple(_COCO.split(","))


@dataclass(frozen=True)
class ModelMetadata:
    """The metadata that bikeped uses; None where the file has none."""

    names: tuple[str, ...] | None = None  #: class names in order of their index
    image_size: tuple[int, int] | None = None  #: width, height
    task: str | None = None
    end_to_end: bool = False  #: the answer is [1, n, 6], suppression done by the network
    ultralytics: bool = False  #: written by Ultralytics' exporter


def parse_metadata(entries: Mapping[str, object], source: str) -> ModelMetadata:
    """Parses a model's metadata map. Raises `DetectorError` for malformed class names.

    They are not ignored: guessed names could turn pedestrians into something else.
    """
    arguments = _literal(entries.get("args"))
    nms_inside = isinstance(arguments, Mapping) and arguments.get("nms") is True
    task = entries.get("task")
    author = entries.get("author")
    return ModelMetadata(
        names=_names(entries["names"], source) if "names" in entries else None,
        image_size=_image_size(_literal(entries.get("imgsz"))),
        task=task.strip().lower() if isinstance(task, str) else None,
        end_to_end=nms_inside or _is_true(entries.get("end2end")),
        ultralytics="imgsz" in entries
        or "task" in entries
        or (isinstance(author, str) and "ultralytics" in author.lower()),
    )


def resolve_input(
    name: str,
    shape: Sequence[object],
    dtype: npt.DTypeLike,
    metadata: ModelMetadata,
    source: str,
    region: Region | None = None,
) -> tuple[int, int, int, int]:
    """The input's shape [1, 3, height, width] with every dynamic dimension filled in.

    `shape` is the runtime's: integers, and names, None or -1 where dynamic. A dynamic height or
    width is the metadata's `imgsz`, else 640; with `region` a dynamic height is at most what the
    region needs at the input's width. Raises `DetectorError` for any other shape
    and for a `dtype` that is not float32, float16 or uint8.
    """
    if len(shape) != 4:
        raise DetectorError(
            f"{source}: input {name} has shape {list(shape)}; bikeped needs [1, 3, height, width]"
        )
    batch, channels, height, width = (
        d if isinstance(d, int) and not isinstance(d, bool) and d > 0 else None for d in shape
    )
    if batch not in (None, 1):
        raise DetectorError(f"{source}: input {name} has batch size {batch}; export with batch 1")
    if channels not in (None, 3):
        raise DetectorError(
            f"{source}: input {name} has shape {list(shape)}; bikeped needs [1, 3, height, width], "
            "three channels first"
        )
    known_width, known_height = metadata.image_size or (_DEFAULT_SIZE, _DEFAULT_SIZE)
    width, height = width or known_width, height or known_height
    if region is not None and is_free(shape):
        aspect = region.aspect * (region.right - region.left) / (region.bottom - region.top)
        wanted = math.ceil((width / aspect + _EDGE_PX) / _COARSEST) * _COARSEST
        height = min(wanted, max(height, _COARSEST))
    if not (32 <= width <= _LARGEST_SIDE and 32 <= height <= _LARGEST_SIDE):
        raise DetectorError(
            f"{source}: input {name} is {width} x {height}; sides must be 32 to {_LARGEST_SIDE}"
        )
    kind = np.dtype(dtype)
    if kind not in _INPUT_TYPES:
        raise DetectorError(
            f"{source}: input {name} is {kind}; export with float32, float16 or uint8 input"
        )
    return 1, 3, height, width


def is_free(shape: Sequence[object]) -> bool:
    """Whether the input's height is free, independent of its width (they share no name)."""
    if len(shape) != 4 or (isinstance(shape[2], int) and shape[2] > 0):
        return False
    return not isinstance(shape[2], str) or shape[2] != shape[3]


def choose_region(config: DetectionConfig, road: Region | None, free: bool) -> Region | None:
    """The part of every frame that the network sees by `detection.region`, None for all.

    `free` is the result of `is_free`.
    """
    return road if config.region == "road" or (config.region == "auto" and free) else None


def _literal(value: object) -> object:
    """The Python literal in a text, None for other text; anything but text stays."""
    if not isinstance(value, str):
        return value
    if len(value) > _LONGEST_LITERAL:
        return None
    try:
        return ast.literal_eval(value.strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return None


def _is_true(value: object) -> bool:
    return value is True or (isinstance(value, str) and value.strip().lower() == "true")


def _names(value: object, source: str) -> tuple[str, ...]:
    names = _literal(value)
    if isinstance(names, Mapping):
        try:
            by_index = {int(key): name for key, name in names.items()}
        except (TypeError, ValueError):
            by_index = {}
        names = [by_index.get(i) for i in range(len(names))]
    if (
        not isinstance(names, list | tuple)
        or not names
        or not all(isinstance(name, str) for name in names)
    ):
        raise DetectorError(
            f"{source}: metadata `names` is not a list of class names numbered from 0; export again"
        )
    return tuple(str(name) for name in names)


def _image_size(value: object) -> tuple[int, int] | None:
    """Width and height out of `imgsz`, which is one side or [height, width]."""
    sides = [value, value] if isinstance(value, int) else value
    if not isinstance(sides, list | tuple) or len(sides) != 2:
        return None
    height, width = sides
    if not isinstance(height, int) or not isinstance(width, int):
        return None
    return (width, height) if 0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE else None


def class_names(names: tuple[str, ...] | None, classes: int | None, source: str) -> tuple[str, ...]:
    """The names of the model's classes: its own, or COCO's for 80 classes without names.

    `classes` is the number that the output's shape implies, or None. Raises `DetectorError` where
    the two disagree or the names are unknown.
    """
    if names is not None:
        if classes not in (None, len(names)):
            raise DetectorError(
                f"{source}: the metadata names {len(names)} classes but the output has {classes}; "
                "export again"
            )
        return names
    if classes == len(COCO_NAMES):
        return COCO_NAMES
    has = "an unknown number of" if classes is None else str(classes)
    raise DetectorError(
        f"{source}: the model has {has} classes and no metadata `names`; only COCO's 80 are known "
        "without: add `names` to the model's metadata (a list or {index: name})"
    )


def kind_table(names: tuple[str, ...], config: DetectionConfig, source: str) -> KindArray:
    """[nc] the `Kind` code of every class, `UNMAPPED` where the configuration names none.

    Comparison ignores case and surrounding whitespace. Raises `DetectorError` where one name is
    given to two kinds or no class is mapped.
    """
    kinds: dict[str, Kind] = {}
    for kind, wanted in (
        (Kind.PEDESTRIAN, config.pedestrian),
        (Kind.CYCLIST, config.cyclist),
        (Kind.VEHICLE, config.vehicle),
    ):
        for name in map(_normalised, wanted):
            if kinds.setdefault(name, kind) is not kind:
                raise DetectorError(
                    f"detection.{kind.label} and detection.{kinds[name].label} both name {name!r}; "
                    "remove it from one"
                )
    table = np.array([kinds.get(_normalised(name), UNMAPPED) for name in names], np.int8)
    missing = [kind.label for kind in Kind if not (table == kind).any()]
    if len(missing) == len(Kind):
        shown = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
        raise DetectorError(
            f"{source}: none of the model's classes ({shown}) is named by "
            "detection.pedestrian, detection.cyclist or detection.vehicle; name them there"
        )
    for label in missing:
        log.warning("%s: no class of the model is a %s (detection.%s)", source, label, label)
    return table


def cyclist_classes_include_riders(names: tuple[str, ...], kinds: KindArray) -> bool:
    """Whether the boxes of all cyclist classes, by `kind_table`'s `kinds`, hold the rider, too.

    For such a model persons are not joined to cycles.
    """
    cyclists = [
        name for name, kind in zip(names, kinds.tolist(), strict=True) if kind == Kind.CYCLIST
    ]
    return bool(cyclists) and all(_normalised(name) in WITH_RIDER for name in cyclists)


def _normalised(name: str) -> str:
    return name.strip().lower()
