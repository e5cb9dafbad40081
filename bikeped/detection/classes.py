"""Maps a model's class names to the three kinds of road user."""

from __future__ import annotations

import logging

import numpy as np

from bikeped.config.schema import DetectionConfig
from bikeped.errors import DetectorError
from bikeped.types import Kind, KindArray

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
        raise DetectorError(
            f"{source}: none of the model's classes ({_abbreviated(names)}) is named by "
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


def _abbreviated(names: tuple[str, ...]) -> str:
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
