"""Training crops: windows cut from pictures, with random scale, light and occlusion.

A picture is first resized as for the network's input, by the letterbox of `bikeped.detection`. Then
windows are cut from it, most of them around an object. All depends on the seed and the step only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from bikeped.capture.jpeg import JpegDecoder
from bikeped.detection.preprocess import PAD, Letterbox
from bikeped.errors import CaptureError, DataSetError
from bikeped.lab.training.coco import (
    FALSE_POSITIVE,
    Box,
    CocoData,
    CocoImage,
    furniture,
    read_picture,
)
from bikeped.types import FloatArray, ImageArray, IntArray

_LEAST_SHARE = 0.35  #: of an object's area within the window; with less it is ignored
_LEAST_SIDE_PX = 4.0  #: smaller objects are ignored
_WHOLE = 0.97  #: visible share of an object; with less it is occluded
_OCCLUDED_WEIGHT = 4
LARGEST_WINDOW_PX = 256  #: of windows of any size
_NOISES, _NOISIEST = 16, 6.0  #: patterns, standard deviation of the strongest in grey levels


@dataclass(frozen=True)
class CropSettings:
    """How windows are cut and changed; ranges are sampled uniformly."""

    view: tuple[int, int] = (1280, 736)  #: width and height of the network's input, pixels
    window: tuple[int, int] = (480, 288)
    around_object: float = 0.65  #: share of windows that are cut around an object
    around_usual: float = 0.2  #: share cut where another picture has an object
    around_mistaken: float = 0.5  #: share cut around a false positive, in pictures that have one
    scale: tuple[float, float] = (0.72, 1.1)
    flip: float = 0.5
    cover: float = 0.15  #: share of windows with an occluded object
    light: float = 0.7  #: share of windows whose light and colours are changed


@dataclass(frozen=True)
class Crop:
    """One window: `rgb` [h, w, 3], objects in its pixels, and boxes that are ignored."""

    rgb: ImageArray
    box_px: FloatArray
    class_id: IntArray
    ignored_px: FloatArray


@dataclass(frozen=True)
class Sample:
    """A whole picture, letterboxed to the network's size: `rgb` [h, w, 3] and its labels."""

    rgb: ImageArray
    box_px: FloatArray
    class_id: IntArray
    crowd: IntArray  #: 1 where a box is a region of many objects
    #: Fixtures, shadows and false positives, by what they are: boxes [n, 4].
    furniture_px: Mapping[str, FloatArray] = field(default_factory=dict)
    hidden: frozenset[int] = frozenset()  #: indices of occluded or cut objects

    @property
    def false_positive_px(self) -> FloatArray:
        """Boxes [n, 4] of a network's false positives."""
        return self.furniture_px.get(FALSE_POSITIVE, np.zeros((0, 4)))

    def sampling_weight(self, index: int) -> int:
        """Relative frequency of an object: occluded ones are rarer, and harder."""
        return _OCCLUDED_WEIGHT if index in self.hidden else 1


def class_ids(data: CocoData) -> dict[int, int]:
    """Category id of the data set -> class of the network, in the order of the ids."""
    return {category: number for number, category in enumerate(data.categories)}


def read_sample(data: CocoData, image: CocoImage, size: tuple[int, int]) -> Sample:
    """A picture for a network of input `size` (width, height); DataSetError as `read_picture`."""
    fit = Letterbox.fit(image.width, image.height, size, "ultralytics")
    rgb = np.full((size[1], size[0], 3), PAD, np.uint8)
    rgb[fit.top : fit.top + fit.height, fit.left : fit.left + fit.width] = cv2.resize(
        reduced_picture(image, fit.width, fit.height), (fit.width, fit.height)
    )
    found = data.objects[image.id]
    box = np.array([o.box_px for o in found], np.float64).reshape(-1, 4)
    known = class_ids(data)
    return Sample(
        rgb,
        fit.forward(box).astype(np.float64),
        np.array([known[o.category_id] for o in found], np.int64),
        np.array([o.crowd for o in found], np.int64),
        _furniture(image, fit),
        frozenset(i for i, o in enumerate(found) if o.visible is not None and o.visible < _WHOLE),
    )


def _furniture(image: CocoImage, fit: Letterbox) -> dict[str, FloatArray]:
    """Boxes in sample pixels by kind."""
    found: dict[str, list[Box]] = {}
    for what, box in furniture(image):
        found.setdefault(what, []).append(box)
    return {what: fit.forward(np.array(boxes)).astype(np.float64) for what, boxes in found.items()}


def object_centres(data: CocoData, size: tuple[int, int]) -> FloatArray:
    """Centres [n, 2] of all objects of the data set, in pixels of samples of `size`."""
    middles: list[FloatArray] = [np.zeros((0, 2))]
    for image in data.images:
        fit = Letterbox.fit(image.width, image.height, size, "ultralytics")
        found = np.array([o.box_px for o in data.objects[image.id]], np.float64).reshape(-1, 4)
        box = fit.forward(found).astype(np.float64)
        middles.append((box[:, :2] + box[:, 2:]) / 2)
    return np.concatenate(middles)


def reduced_picture(image: CocoImage, width: int, height: int) -> ImageArray:
    """The picture [h, w, 3], at least `width` x `height`; DataSetError as `read_picture`."""
    if image.path.suffix.lower() not in (".jpg", ".jpeg"):
        return read_picture(image)
    try:
        return JpegDecoder(1).decode(image.path.read_bytes(), width, height)
    except OSError as error:
        raise DataSetError(f"{image.path}: cannot be read ({error.strerror})") from error
    except CaptureError:
        return read_picture(image)  # a PNG with a JPEG's name, or a specific error


class Cropper:
    """Cuts windows by `CropSettings`."""

    def __init__(self, settings: CropSettings, seed: int, centres_px: FloatArray) -> None:
        """`centres_px` [n, 2]: centres of the objects of all pictures, in pixels of a sample."""
        self._settings = settings
        width, height = (max(side, LARGEST_WINDOW_PX) for side in settings.window)
        random = np.random.default_rng([seed, 1])
        self._noise = [
            np.rint(random.normal(0, strength, (height, width, 3))).astype(np.int16)
            for strength in np.linspace(1, _NOISIEST, _NOISES)
        ]
        self._centres = centres_px

    def __call__(
        self,
        sample: Sample,
        random: np.random.Generator,
        window: tuple[int, int] | None = None,
        around: FloatArray | None = None,
        scale: float | None = None,
    ) -> Crop:
        """One window of `sample`; `window` and `scale` replace what the settings give.

        `around`: a box [4] in pixels of the sample that the window must hold as far as it fits; an
        empty array for a place where other pictures have objects; None leaves it to the settings.
        """
        width, height = window or self._settings.window
        scale = float(random.uniform(*self._settings.scale)) if scale is None else scale
        left, top = self._corner(sample, width / scale, height / scale, random, around)
        flip = random.random() < self._settings.flip
        move = np.array([[scale, 0.0, -left * scale], [0.0, scale, -top * scale]])
        if flip:
            move[0] = [-scale, 0.0, width + left * scale]
        # OpenCV counts from pixel centres, boxes from pixel edges.
        middle = np.array([(move[0, 0] - 1) / 2, (scale - 1) / 2])
        warp = move.copy()
        warp[:, 2] += middle
        grey = (PAD, PAD, PAD)
        cut = cv2.warpAffine(
            sample.rgb, warp, (width, height), flags=cv2.INTER_LINEAR, borderValue=grey
        )
        rgb = np.asarray(cut, np.uint8)
        box = sample.box_px * scale - np.array([left, top, left, top]) * scale
        if flip:
            box[:, [0, 2]] = width - box[:, [2, 0]]
        crop = _window_labels(rgb, box, sample, (width, height))
        if random.random() < self._settings.cover and len(crop.box_px):
            _occlude(crop, random)
        if random.random() < self._settings.light:
            return replace(crop, rgb=self._relight(crop.rgb, random))
        return crop

    def _corner(
        self,
        sample: Sample,
        wide: float,
        high: float,
        random: np.random.Generator,
        around: FloatArray | None,
    ) -> tuple[float, float]:
        """Upper left corner of a window of `wide` x `high` pixels of the sample."""
        across, down = self._settings.view
        count = len(sample.box_px)
        kind = random.random() - self._settings.around_object
        mistaken = sample.false_positive_px
        if around is not None:
            kind = 0.0  # an empty `around`: at a centre of another picture
        elif len(mistaken) and random.random() < self._settings.around_mistaken:
            around = mistaken[int(random.integers(len(mistaken)))]
        if around is not None and len(around):
            box = around
            # Whole, anywhere in the window; a larger box fills it.
            slack = (wide, high) - (box[2:] - box[:2])
            left, top = box[:2] - random.uniform(0, 1, 2) * slack
        elif count and kind < 0:
            # First the class, then the object, for classes are unequally frequent.
            kinds = np.unique(sample.class_id)
            mine = np.flatnonzero(sample.class_id == kinds[int(random.integers(len(kinds)))])
            mine = np.repeat(mine, [sample.sampling_weight(int(index)) for index in mine])
            box = sample.box_px[mine[int(random.integers(len(mine)))]]
            left, top = (box[:2] + box[2:]) / 2 - random.uniform(0.1, 0.9, 2) * (wide, high)
        elif len(self._centres) and kind < self._settings.around_usual:
            centre = self._centres[int(random.integers(len(self._centres)))]
            left, top = centre - random.uniform(0.1, 0.9, 2) * (wide, high)
        else:
            left, top = random.uniform(0, 1, 2) * (across - wide, down - high)
        # The window stays within the sample as far as it fits.
        return (
            float(np.clip(left, min(0, across - wide), max(0, across - wide))),
            float(np.clip(top, min(0, down - high), max(0, down - high))),
        )

    def _relight(self, rgb: ImageArray, random: np.random.Generator) -> ImageArray:
        """Another exposure, white balance, contrast, blur and noise."""
        value = np.arange(256) / 255.0
        gamma = np.exp(random.uniform(-0.25, 0.25))
        gain = np.exp(random.uniform(-0.25, 0.25)) * np.exp(random.uniform(-0.08, 0.08, 3))
        lift = random.uniform(-0.05, 0.05)
        tables = ((value**gamma)[:, None] * gain + lift).clip(0, 1) * 255
        out = np.asarray(cv2.LUT(rgb, tables.astype(np.uint8).reshape(256, 1, 3)), np.uint8)
        if random.random() < 0.2:  # paler, or stronger colours
            grey = cv2.cvtColor(cv2.cvtColor(out, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
            share = float(random.uniform(-0.3, 0.7))
            out = np.asarray(cv2.addWeighted(out, 1 - share, grey, share, 0), np.uint8)
        if random.random() < 0.1:
            out = np.asarray(cv2.GaussianBlur(out, (0, 0), float(random.uniform(0.3, 0.6))))
        if random.random() < 0.3:
            noise = self._noise[int(random.integers(_NOISES))][: out.shape[0], : out.shape[1]]
            out = np.asarray(cv2.add(out, noise, dtype=cv2.CV_8U), np.uint8)
        return out


def _window_labels(rgb: ImageArray, box: FloatArray, sample: Sample, size: tuple[int, int]) -> Crop:
    """The window with its objects; too small or cut ones are ignored."""
    width, height = size
    inside = np.clip(box, 0, (width, height, width, height))
    area = np.prod(np.maximum(box[:, 2:] - box[:, :2], 1e-9), axis=1)
    side = inside[:, 2:] - inside[:, :2]
    left = np.prod(np.maximum(side, 0), axis=1)
    seen = left > 0
    good = seen & (left >= _LEAST_SHARE * area) & (side.max(axis=1) >= _LEAST_SIDE_PX)
    good &= (side.min(axis=1) >= _LEAST_SIDE_PX / 2) & (sample.crowd == 0)
    return Crop(rgb, inside[good], sample.class_id[good], inside[seen & ~good])


def _occlude(crop: Crop, random: np.random.Generator) -> None:
    """Paints a plain patch over up to a quarter of an object, in place."""
    box = crop.box_px[int(random.integers(len(crop.box_px)))]
    share = random.uniform(0.2, 0.5, 2)
    size = (box[2:] - box[:2]) * share
    corner = box[:2] + random.uniform(0, 1, 2) * (box[2:] - box[:2] - size)
    u1, v1 = np.floor(corner).astype(int)
    u2, v2 = np.ceil(corner + size).astype(int)
    crop.rgb[max(v1, 0) : v2, max(u1, 0) : u2] = random.integers(0, 256, 3)
