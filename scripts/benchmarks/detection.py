"""4K MJPEG frame to network input; suppression of overlapping boxes."""

from __future__ import annotations

import cv2
import numpy as np

from benchmarks.figures import Figures, in_turns
from benchmarks.loop import street_4k
from bikeped.capture.jpeg import JpegDecoder
from bikeped.detection.nms import non_max_suppression
from bikeped.detection.preprocess import Preprocessor


def frame(figures: Figures) -> None:
    """A drawn 3840 x 2160 street as JPEG, onto inputs of 1280 and 416 pixels."""
    for size in (1280, 416):
        _frame(figures, street_4k(1)[0], size)


def _frame(figures: Figures, jpeg: bytes, size: int) -> None:
    encoded = np.frombuffer(jpeg, np.uint8)
    buffer = np.empty((1, 3, size, size), np.float32)
    prepare = Preprocessor("ultralytics", buffer)
    decoder = JpegDecoder()
    least_height = -(-size * 2160 // 3840)

    def ours() -> None:
        prepare(decoder.decode(jpeg, min_width=size, min_height=least_height), 3840, 2160)

    def obvious() -> None:
        picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        assert picture is not None
        height = round(size * 2160 / 3840)
        small = cv2.resize(picture, (size, height))
        top = (size - height) // 2
        padded = cv2.copyMakeBorder(
            small, top, size - height - top, 0, 0, cv2.BORDER_CONSTANT, value=(114, 114, 114)
        )
        rgb = padded[:, :, ::-1].transpose(2, 0, 1)
        np.ascontiguousarray(rgb)[None].astype(np.float32) / 255

    a, b = in_turns(ours, obvious, 15)
    figures.add(f"4K MJPEG frame to network input, {size} px", a * 1e3, b * 1e3, "ms")


def nms(figures: Figures) -> None:
    """300 and 3000 boxes in clumps, as a detector gives them before suppression."""
    rng = np.random.default_rng(1)
    for count in (300, 3000):
        _nms(figures, count, rng)


def _nms(figures: Figures, count: int, rng: np.random.Generator) -> None:
    centres = rng.uniform(0, 1280, (count // 10, 2)).repeat(10, 0)
    centres = centres + rng.normal(0, 4, (count, 2))
    half = rng.uniform(10, 40, (count, 2))
    box = np.concatenate([centres - half, centres + half], 1).astype(np.float32)
    score = rng.random(count).astype(np.float32)
    group = rng.integers(0, 3, count)
    a, b = in_turns(
        lambda: non_max_suppression(box, score, group, 0.45, 300),
        lambda: _loop(box, score, group, 0.45),
        5,
    )
    figures.add(f"non-maximum suppression, {count} boxes", a * 1e3, b * 1e3, "ms")


def _loop(box: np.ndarray, score: np.ndarray, group: np.ndarray, iou: float) -> list[int]:
    """The textbook's double loop."""
    kept: list[int] = []
    for i in sorted(range(len(score)), key=lambda k: -score[k]):
        for j in kept:
            if group[i] != group[j]:
                continue
            w = min(box[i, 2], box[j, 2]) - max(box[i, 0], box[j, 0])
            h = min(box[i, 3], box[j, 3]) - max(box[i, 1], box[j, 1])
            if w > 0 and h > 0:
                a = (box[i, 2] - box[i, 0]) * (box[i, 3] - box[i, 1])
                b = (box[j, 2] - box[j, 0]) * (box[j, 3] - box[j, 1])
                if w * h / (a + b - w * h) > iou:
                    break
        else:
            kept.append(i)
    return kept
