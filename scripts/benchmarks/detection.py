"""4K MJPEG frame to network input; suppression of overlapping boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from benchmarks.figures import Figures


def frame(figures: Figures) -> None:
    """A drawn 3840 x 2160 street as JPEG, onto inputs of 1280 and 416 pixels."""
    from benchmarks.figures import in_turns
    from benchmarks.pictures import street_4k
    from bikeped.capture import JpegDecoder
    from bikeped.detection.preprocess import Preprocessor

    jpeg = street_4k(1)[0]
    encoded = np.frombuffer(jpeg, np.uint8)
    for size in (1280, 416):
        buffer = np.empty((1, 3, size, size), np.float32)
        prepare = Preprocessor("ultralytics", buffer)
        decoder = JpegDecoder()
        least_height = -(-size * 2160 // 3840)

        def ours(
            prepare: Preprocessor = prepare,
            decoder: JpegDecoder = decoder,
            size: int = size,
            least: int = least_height,
        ) -> None:
            prepare(decoder.decode(jpeg, min_width=size, min_height=least), 3840, 2160)

        def obvious(size: int = size) -> None:
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
    from benchmarks.figures import in_turns
    from bikeped.detection.nms import non_max_suppression

    rng = np.random.default_rng(1)
    for count in (300, 3000):
        centres = rng.uniform(0, 1280, (count // 10, 2)).repeat(10, 0)
        centres = centres + rng.normal(0, 4, (count, 2))
        half = rng.uniform(10, 40, (count, 2))
        box = np.concatenate([centres - half, centres + half], 1).astype(np.float32)
        score = rng.random(count).astype(np.float32)
        group = rng.integers(0, 3, count)
        a, b = in_turns(
            lambda box=box, score=score, group=group: non_max_suppression(
                box, score, group, 0.45, 300
            ),
            lambda box=box, score=score, group=group: _loop(box, score, group, 0.45),
            5,
        )
        figures.add(f"non-maximum suppression, {count} boxes", a * 1e3, b * 1e3, "ms")


def _loop(
    box: np.ndarray,
    score: np.ndarray,
    group: np.ndarray,
    iou: float,  # type: ignore[type-arg]
) -> list[int]:
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
