"""Packs small windows into squares: three times as many objects for the same work.

A road user at ten metres is thirty pixels tall, so a window of a whole street is mostly background.
Here each window is just large enough for one object and some of its surroundings, and windows are
laid side by side on squares of one size, as in a mosaic (Bochkovskiy et al. 2020, YOLOv4, section
3.3) but without downscaling. The last part of the training uses plain windows again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from bikeped.lab.training.coco import FALSE_POSITIVE
from bikeped.lab.training.crops import Crop, Cropper, CropSettings, Sample
from bikeped.types import BoolArray, FloatArray

T = TypeVar("T")

BLOCK_PX = 64
_NARROW = 0.6  #: share of the windows around fixtures that are one block wide, the others two
_TRIES = 12  #: consecutive objects that did not fit; then empty windows fill the rest


@dataclass(frozen=True)
class PackSettings:
    """How squares are filled."""

    side: int = 256  #: of a square, a multiple of `BLOCK_PX`
    squares: int = 16  #: per step
    pool: int = 48  #: pictures that windows are cut from
    empty: float = 0.08  #: share of windows where another picture has an object
    furniture: float = 0.18  #: share of windows around fixtures and shadows
    mistaken: float = 0.1  #: share of windows around false positives, where they were mined
    room: float = 1.25  #: side of a window, in longest sides of its object
    #: How often objects that need 1, 2, 3, 4 blocks are taken: the largest are the easiest.
    taken: tuple[float, ...] = (1.0, 1.0, 0.85, 0.65)
    #: Share of each of the first classes; further ones share what is left.
    classes: tuple[float, ...] = (0.5, 0.42)


@dataclass(frozen=True)
class _Window:
    """A box of `sample` (empty: none) at a scale; its window is `blocks` blocks wide."""

    sample: Sample
    box_px: FloatArray
    scale: float
    blocks: int


_Target = tuple[int, int]  #: index of its sample in the pool, and index there


@dataclass(frozen=True)
class SamplingPool:
    """What windows can be cut around: objects by class, fixtures by kind, false positives."""

    by_class: list[list[_Target]]
    furniture: dict[str, list[_Target]]
    false_positives: list[_Target]

    @classmethod
    def of(cls, pool: Sequence[Sample]) -> SamplingPool:
        most = max((int(v.class_id.max()) for v in pool if len(v.class_id)), default=-1)
        by_class: list[list[_Target]] = [[] for _ in range(most + 1)]
        things: dict[str, list[_Target]] = {}
        for number, sample in enumerate(pool):
            for index in np.flatnonzero(sample.crowd == 0).tolist():
                weighted = [(number, index)] * sample.sampling_weight(index)
                by_class[int(sample.class_id[index])].extend(weighted)
            for what, boxes in sample.furniture_px.items():
                things.setdefault(what, []).extend((number, index) for index in range(len(boxes)))
        false_positives = things.pop(FALSE_POSITIVE, [])
        return cls(by_class, things, false_positives)


class Packer:
    """Fills squares from a pool of pictures."""

    def __init__(self, settings: PackSettings, crops: CropSettings, cropper: Cropper) -> None:
        self._settings, self._scale, self._cropper = settings, crops.scale, cropper

    def __call__(
        self, pool: Sequence[Sample], count: int, random: np.random.Generator
    ) -> list[Crop]:
        """`count` squares, from pictures of `pool`."""
        side = self._settings.side // BLOCK_PX
        free = np.ones((count, side, side), np.bool_)
        placed: list[list[tuple[int, int, Crop]]] = [[] for _ in range(count)]
        targets = SamplingPool.of(pool)
        misses = 0
        while free.any():
            pick = self._choose_window(pool, targets, random) if misses < _TRIES else None
            if pick is None:
                pick = _Window(_one_of(pool, random), np.zeros(0), 1.0, 1)
            spot = first_fit(free, pick.blocks)
            if spot is None:
                misses += 1
                continue
            misses = 0
            square, row, column = spot
            free[square, row : row + pick.blocks, column : column + pick.blocks] = False
            placed[square].append((row, column, self._cut(pick, random)))
        return [_assembled(tiles, self._settings.side) for tiles in placed]

    def _choose_window(
        self, pool: Sequence[Sample], targets: SamplingPool, random: np.random.Generator
    ) -> _Window | None:
        """A window around a random target; None for one at another picture's object."""
        settings = self._settings
        if targets.false_positives and random.random() < settings.mistaken:
            number, index = _one_of(targets.false_positives, random)
            return self._object_window(pool[number], pool[number].false_positive_px[index], random)
        what = random.random() - settings.empty
        if what < 0:
            return None
        if what < settings.furniture and targets.furniture:
            return self._furniture_window(pool, targets.furniture, random)
        by_class = targets.by_class
        if not any(by_class):
            return None
        share = random.random() - np.cumsum(settings.classes)
        rest = len(settings.classes)
        kind = int(np.argmax(share < 0)) if (share < 0).any() else rest
        if kind == rest and len(by_class) > rest:
            kind += int(random.integers(len(by_class) - rest))
        if kind >= len(by_class) or not by_class[kind]:
            kind = int(random.choice([k for k, found in enumerate(by_class) if found]))
        number, index = _one_of(by_class[kind], random)
        pick = self._object_window(pool[number], pool[number].box_px[index], random)
        likely = settings.taken[min(pick.blocks, len(settings.taken)) - 1]
        if random.random() >= likely:
            return self._choose_window(pool, targets, random)
        return pick

    def _object_window(
        self, sample: Sample, box: FloatArray, random: np.random.Generator
    ) -> _Window:
        """A window around `box` [4] with a margin."""
        scale = float(random.uniform(*self._scale))
        longest = float((box[2:] - box[:2]).max()) * scale * self._settings.room
        blocks = int(np.clip(np.ceil(longest / BLOCK_PX), 1, self._settings.side // BLOCK_PX))
        return _Window(sample, box, scale, blocks)

    def _furniture_window(
        self, pool: Sequence[Sample], things: dict[str, list[_Target]], random: np.random.Generator
    ) -> _Window:
        """A window at a random spot of a fixture: first the kind, then one of it."""
        kind = _one_of(sorted(things), random)
        number, index = _one_of(things[kind], random)
        box = pool[number].furniture_px[kind][index]
        spot = box[:2] + random.uniform(0, 1, 2) * (box[2:] - box[:2])
        blocks = 1 if random.random() < _NARROW else min(2, self._settings.side // BLOCK_PX)
        scale = float(random.uniform(*self._scale))
        return _Window(pool[number], np.concatenate([spot, spot]), scale, blocks)

    def _cut(self, pick: _Window, random: np.random.Generator) -> Crop:
        side = pick.blocks * BLOCK_PX
        return self._cropper(
            pick.sample, random, window=(side, side), around=pick.box_px, scale=pick.scale
        )


def _one_of(choices: Sequence[T], random: np.random.Generator) -> T:
    return choices[int(random.integers(len(choices)))]


def first_fit(free: BoolArray, blocks: int) -> tuple[int, int, int] | None:
    """Square, row and column of the first place in `free` [n, s, s] for `blocks` x `blocks`."""
    reach = free.shape[1] - blocks + 1
    fits = np.ones((free.shape[0], reach, reach), np.bool_)
    for row in range(blocks):
        for column in range(blocks):
            fits &= free[:, row : row + reach, column : column + reach]
    found = np.flatnonzero(fits)
    if len(found) == 0:
        return None
    square, row, column = np.unravel_index(found[0], fits.shape)
    return int(square), int(row), int(column)


def _assembled(tiles: list[tuple[int, int, Crop]], side: int) -> Crop:
    """One square of its windows."""
    rgb = np.zeros((side, side, 3), np.uint8)
    boxes: list[FloatArray] = [np.zeros((0, 4))]
    ignored: list[FloatArray] = [np.zeros((0, 4))]
    for row, column, tile in tiles:
        top, left = row * BLOCK_PX, column * BLOCK_PX
        high, wide = tile.rgb.shape[:2]
        rgb[top : top + high, left : left + wide] = tile.rgb
        shift = np.array([left, top, left, top], np.float64)
        boxes.append(tile.box_px + shift)
        ignored.append(tile.ignored_px + shift)
    classes = [np.zeros(0, np.int64), *(tile.class_id for _, _, tile in tiles)]
    return Crop(rgb, np.concatenate(boxes), np.concatenate(classes), np.concatenate(ignored))
