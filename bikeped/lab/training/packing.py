"""Many small windows in one picture to learn from: three times as many people for the same work.

A road user at ten metres is thirty pixels tall: in a window that a whole street fits into, nearly
all of the work goes into asphalt. Here every window is cut just large enough for one object and
some of what surrounds it, and windows are laid side by side on squares of one size, as mosaics are
(Bochkovskiy et al. 2020, YOLOv4, section 3.3) but without making anybody smaller. The last part of
the training sees plain windows again, so that the network knows streets as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bikeped.lab.training.coco import FALSE_POSITIVE
from bikeped.lab.training.crops import Crop, Cropper, CropSettings, Sample
from bikeped.types import BoolArray, FloatArray

BLOCK_PX = 64
_NARROW = 0.6  #: share of the windows around things that are one block wide, the others two
_TRIES = 12  #: objects that did not fit in a row, until what is left gets empty windows


@dataclass(frozen=True)
class PackSettings:
    """How squares are filled."""

    side: int = 256  #: of a square, a multiple of `BLOCK_PX`
    squares: int = 16  #: for each step
    pool: int = 48  #: pictures that windows are cut from at any time
    empty: float = 0.08  #: share of windows where some other picture has an object
    #: Share of windows around signs, bollards and other things that are nobody, where the data
    #: tell of them: they are what is taken for somebody.
    furniture: float = 0.18
    #: Share of windows around what a network took for somebody, where it was asked: those things,
    #: leaves and shadows that do look like somebody.
    mistaken: float = 0.1
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


@dataclass(frozen=True)
class SamplingPool:
    """What a window may be about, each as number of its picture in the pool and number there:
    objects by class, things by kind, and what a network took for somebody."""

    by_class: list[list[tuple[int, int]]]
    things: dict[str, list[tuple[int, int]]]
    mistakes: list[tuple[int, int]]

    @classmethod
    def of(cls, pool: Sequence[Sample]) -> SamplingPool:
        things = _by_thing(pool)
        mistakes = things.pop(FALSE_POSITIVE, [])
        return cls(_by_class(pool), things, mistakes)


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
        lots = SamplingPool.of(pool)
        misses = 0
        while free.any():
            pick = self._choose_window(pool, lots, random) if misses < _TRIES else None
            if pick is None:
                pick = _Window(pool[int(random.integers(len(pool)))], np.zeros(0), 1.0, 1)
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
        self, pool: Sequence[Sample], lots: SamplingPool, random: np.random.Generator
    ) -> _Window | None:
        """First the class, then one of its objects; None for a window with nobody in its middle."""
        settings = self._settings
        if lots.mistakes and random.random() < settings.mistaken:
            number, index = lots.mistakes[int(random.integers(len(lots.mistakes)))]
            return self._object_window(pool[number], pool[number].false_positive_px[index], random)
        what = random.random() - settings.empty
        if what < 0:
            return None
        if what < settings.furniture and lots.things:
            return self._furniture_window(pool, lots.things, random)
        by_class = lots.by_class
        if not any(by_class):
            return None
        share = random.random() - np.cumsum(settings.classes)
        rest = len(settings.classes)
        kind = int(np.argmax(share < 0)) if (share < 0).any() else rest
        if kind == rest and len(by_class) > rest:
            kind += int(random.integers(len(by_class) - rest))
        if kind >= len(by_class) or not by_class[kind]:
            kind = int(random.choice([k for k, found in enumerate(by_class) if found]))
        number, index = by_class[kind][int(random.integers(len(by_class[kind])))]
        pick = self._object_window(pool[number], pool[number].box_px[index], random)
        likely = settings.taken[min(pick.blocks, len(settings.taken)) - 1]
        if random.random() >= likely:
            return self._choose_window(pool, lots, random)
        return pick

    def _object_window(
        self, sample: Sample, box: FloatArray, random: np.random.Generator
    ) -> _Window:
        """A window that holds `box` [4] and a little of what surrounds it."""
        scale = float(random.uniform(*self._scale))
        longest = float((box[2:] - box[:2]).max()) * scale * self._settings.room
        blocks = int(np.clip(np.ceil(longest / BLOCK_PX), 1, self._settings.side // BLOCK_PX))
        return _Window(sample, box, scale, blocks)

    def _furniture_window(
        self,
        pool: Sequence[Sample],
        things: dict[str, list[tuple[int, int]]],
        random: np.random.Generator,
    ) -> _Window:
        """A window about any spot of a thing: first the kind of thing, then one of them."""
        kinds = sorted(things)
        kind = kinds[int(random.integers(len(kinds)))]
        number, index = things[kind][int(random.integers(len(things[kind])))]
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


def _by_class(pool: Sequence[Sample]) -> list[list[tuple[int, int]]]:
    """For every class: picture of the pool and number there of each of its objects."""
    most = max((int(v.class_id.max()) for v in pool if len(v.class_id)), default=-1)
    found: list[list[tuple[int, int]]] = [[] for _ in range(most + 1)]
    for number, sample in enumerate(pool):
        for index in np.flatnonzero(sample.crowd == 0).tolist():
            lots = [(number, index)] * sample.sampling_weight(index)
            found[int(sample.class_id[index])].extend(lots)
    return found


def _by_thing(pool: Sequence[Sample]) -> dict[str, list[tuple[int, int]]]:
    """For every kind of thing: picture of the pool and number there of each of them."""
    found: dict[str, list[tuple[int, int]]] = {}
    for number, sample in enumerate(pool):
        for what, boxes in sample.furniture_px.items():
            found.setdefault(what, []).extend((number, index) for index in range(len(boxes)))
    return found


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
