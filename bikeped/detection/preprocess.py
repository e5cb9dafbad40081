"""Image to network input: letterbox, channel order, scale; and boxes back to the frame.

    ultralytics   RGB / 255, image centred, padding grey 114
    yolox         BGR 0..255, image top left, padding grey 114
    yolox-legacy  RGB / 255, ImageNet's mean and deviation, top left (YOLOX before 0.1.1)

The image may have been decoded at a reduced scale; boxes are mapped with the full frame's size to
full-frame pixels. With a region only that part is shown, as if it were the whole image.

The cost is one bilinear resize and one look-up table per channel, written into the network's
contiguous input: a byte has 256 values, so the table contains scale, mean and deviation exactly.
Only the image's part is written; the padding stays from the frame before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from bikeped.types import Float32Array, FloatArray, ImageArray, Region

Family = Literal["ultralytics", "yolox", "yolox-legacy"]

PAD = 114  #: grey of the letterbox, 0..255
_IMAGENET_MEAN = (0.485, 0.456, 0.406)  #: red, green, blue, of RGB / 255
_IMAGENET_DEVIATION = (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Letterbox:
    """Position of a frame, or of a part of it, in the network's input, in whole input pixels.

    Each axis has its own scale, because the image is rounded to whole pixels.
    """

    frame_width: int
    frame_height: int
    left: int
    top: int
    width: int  #: of the image
    height: int
    #: The part of the frame that is shown: x1, y1, x2, y2 in frame pixels.
    shown_px: tuple[float, float, float, float]

    @staticmethod
    def fit(
        frame_width: int,
        frame_height: int,
        size: tuple[int, int],
        family: Family,
        part_px: tuple[float, float, float, float] | None = None,
    ) -> Letterbox:
        """The largest fit of a frame into an input of `size` (width, height), aspect kept.

        `part_px`: the part (x1, y1, x2, y2 in frame pixels) that is to lie there; None: all. Raises
        `ValueError` for a frame or an input without area.
        """
        across, down = size
        if min(frame_width, frame_height, across, down) < 1:
            raise ValueError(
                f"cannot letterbox {frame_width} x {frame_height} into {across} x {down}"
            )
        x1, y1, x2, y2 = part_px or (0.0, 0.0, float(frame_width), float(frame_height))
        ratio = min(across / (x2 - x1), down / (y2 - y1))
        wide, high = (x2 - x1) * ratio, (y2 - y1) * ratio
        if family == "ultralytics":
            width, height = round(wide), round(high)
        else:  # YOLOX truncates; the slack keeps 1280 * (416 / 1280) from becoming 415
            width, height = int(wide + 1e-6), int(high + 1e-6)
        width, height = min(max(width, 1), across), min(max(height, 1), down)
        centred = family == "ultralytics"
        left, top = ((across - width) // 2, (down - height) // 2) if centred else (0, 0)
        return Letterbox(frame_width, frame_height, left, top, width, height, (x1, y1, x2, y2))

    def forward(self, box: npt.NDArray[Any]) -> Float32Array:
        """Boxes [n, 4] (x1, y1, x2, y2) from frame pixels to input pixels."""
        scale = np.array([self.width, self.height] * 2) / (self._shown_size * 2)
        moved: npt.NDArray[np.float64] = (box - np.array(self.shown_px[:2] * 2)) * scale
        moved += np.array([self.left, self.top] * 2)
        return moved.astype(np.float32)

    def inverse(self, box: npt.NDArray[Any]) -> Float32Array:
        """Boxes [n, 4] from input pixels to frame pixels; not clipped to the frame."""
        moved: npt.NDArray[np.float64] = box - np.array([self.left, self.top] * 2, np.float64)
        moved *= np.array(self._shown_size * 2) / np.array([self.width, self.height] * 2)
        moved += np.array(self.shown_px[:2] * 2)
        return moved.astype(np.float32)

    @property
    def _shown_size(self) -> tuple[float, float]:
        x1, y1, x2, y2 = self.shown_px
        return x2 - x1, y2 - y1


class Preprocessor:
    """Fills one network's input buffer, frame after frame. Not for several threads at once."""

    def __init__(
        self, family: Family, buffer: npt.NDArray[Any], region: Region | None = None
    ) -> None:
        """`buffer` is the network's input, [1, 3, height, width], float32, float16 or uint8.

        A uint8 input gets the bytes as they are: such a network scales them itself. `region`: the
        part of every frame that is shown; None: all.
        """
        if buffer.ndim != 4 or buffer.shape[:2] != (1, 3) or not buffer.flags.c_contiguous:
            raise ValueError(
                f"expected a contiguous buffer [1, 3, height, width], got {buffer.shape}"
            )
        self.family = family
        self.buffer = buffer
        self.size = (int(buffer.shape[3]), int(buffer.shape[2]))
        self.region = region
        # Channel of the network -> channel of the image, which is RGB.
        self._source = (2, 1, 0) if family == "yolox" else (0, 1, 2)
        self._tables = _tables(family, self._source, buffer.dtype)
        # OpenCV has no look-up into half precision: its bits travel as 16-bit integers.
        self._planes = buffer[0].view(np.int16) if buffer.dtype == np.float16 else buffer[0]
        self._letterbox: Letterbox | None = None
        self._image: ImageArray = np.zeros((0, 0, 3), np.uint8)
        self._channel: ImageArray = np.zeros((0, 0), np.uint8)

    def letterbox(
        self, frame_width: int, frame_height: int, copy_size: tuple[int, int] | None = None
    ) -> Letterbox:
        """How a frame of this size lies on the input.

        `copy_size`: width and height of the scaled copy that is shown, of which whole pixels are
        cut; None: the frame's own.
        """
        copy_size = copy_size or (frame_width, frame_height)
        part = None
        if self.region is not None and min(copy_size) > 0:
            across, down = frame_width / copy_size[0], frame_height / copy_size[1]
            u1, v1, u2, v2 = self.region.pixels(*copy_size)
            part = u1 * across, v1 * down, u2 * across, v2 * down
        return Letterbox.fit(frame_width, frame_height, self.size, self.family, part)

    def __call__(self, rgb: ImageArray, frame_width: int, frame_height: int) -> Letterbox:
        """Writes `rgb` [h, w, 3] uint8, of any scale, into the buffer; returns where it lies.

        Raises `ValueError` where `rgb` is no such image or has another aspect than the frame.
        """
        _check_image(rgb, frame_width, frame_height)
        copy_size = rgb.shape[1], rgb.shape[0]
        box = self.letterbox(frame_width, frame_height, copy_size)
        if box != self._letterbox:
            for plane, table in zip(self._planes, self._tables, strict=True):
                plane[...] = table[PAD]
            self._image = np.empty((box.height, box.width, 3), np.uint8)
            self._channel = np.empty((box.height, box.width), np.uint8)
            self._letterbox = box
        if self.region is not None:
            u1, v1, u2, v2 = self.region.pixels(*copy_size)
            rgb = rgb[v1:v2, u1:u2]
        image = rgb
        if rgb.shape[:2] != (box.height, box.width):
            cv2.resize(rgb, (box.width, box.height), dst=self._image)
            image = self._image
        rows, columns = slice(box.top, box.top + box.height), slice(box.left, box.left + box.width)
        for plane, table, source in zip(self._planes, self._tables, self._source, strict=True):
            target = plane[rows, columns]
            if target.dtype == np.uint8:
                target[...] = image[:, :, source]
            else:
                cv2.extractChannel(image, source, dst=self._channel)
                cv2.LUT(self._channel, table, dst=target)
        return box


def _tables(
    family: Family, source: tuple[int, int, int], dtype: np.dtype[Any]
) -> list[npt.NDArray[Any]]:
    """For each channel of the network, what the input holds for every byte value, [256]."""
    byte: FloatArray = np.arange(256, dtype=np.float64)
    value: FloatArray
    tables: list[npt.NDArray[Any]] = []
    for channel in source:
        if dtype == np.uint8 or family == "yolox":
            value = byte
        elif family == "ultralytics":
            value = byte / 255
        else:
            value = (byte / 255 - _IMAGENET_MEAN[channel]) / _IMAGENET_DEVIATION[channel]
        table = value.astype(dtype)
        tables.append(table.view(np.int16) if dtype == np.float16 else table)
    return tables


def _check_image(rgb: ImageArray, frame_width: int, frame_height: int) -> None:
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape:
        raise ValueError(f"expected an image [height, width, 3] uint8, got {rgb.shape} {rgb.dtype}")
    height, width = rgb.shape[:2]
    # A reduced decode rounds each side up to a whole pixel; more than that is another image.
    if abs(width * frame_height - height * frame_width) > 2 * max(frame_width, frame_height):
        raise ValueError(
            f"an image of {width} x {height} is not a scaled {frame_width} x {frame_height} frame"
        )
