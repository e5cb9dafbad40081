"""Metadata of a model file: class names, input size, task.

Ultralytics writes metadata as text into the ONNX metadata map (each value a Python literal) and as
JSON in front of a TensorRT engine. Both become one mapping here; a value may be text or already
decoded. Nothing is evaluated: `ast.literal_eval` accepts literals only.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.config.schema import DetectionConfig
from bikeped.errors import DetectorError
from bikeped.types import Region

_LONGEST_LITERAL = 1 << 20
_DEFAULT_SIZE = 640  #: Ultralytics' default, where neither the shape nor the metadata names one
_LARGEST_SIDE = 16384
_COARSEST = 32  #: YOLO networks want sides that are multiples of their largest stride
#: Padding above and below the region, together: the network has learnt persons cut off by the edge
#: with padding beyond it.
_EDGE_PX = 12
_INPUT_TYPES = (np.dtype(np.float32), np.dtype(np.float16), np.dtype(np.uint8))


@dataclass(frozen=True)
class ModelMetadata:
    """The metadata that bikeped uses; None where the file has none."""

    names: tuple[str, ...] | None = None  #: class names in order of their index
    image_size: tuple[int, int] | None = None  #: width, height
    task: str | None = None
    end_to_end: bool = False  #: the answer is [1, n, 6], suppression done by the network
    ultralytics: bool = False  #: written by Ultralytics' exporter


@dataclass(frozen=True)
class InputSpec:
    """The network's one input: [1, 3, height, width] of `dtype` (float32, float16 or uint8)."""

    name: str
    width: int
    height: int
    dtype: np.dtype[Any]

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of the input array."""
        return (1, 3, self.height, self.width)

    def buffer(self) -> npt.NDArray[Any]:
        """A fresh contiguous input array, zeroed."""
        return np.zeros(self.shape, self.dtype)


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
) -> InputSpec:
    """The input with every dynamic dimension filled in.

    `shape` is the runtime's: integers, and names, None or -1 where dynamic. A dynamic height or
    width is the metadata's `imgsz`, else 640; with `region` a dynamic height is at most what the
    region needs at the input's width. Raises `DetectorError` for any other input.
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
    return InputSpec(name, width, height, kind)


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
