"""Output layouts of YOLO networks: recognition and decoding. Pure: arrays in, arrays out.

    yolov5         [1, A, 5 + nc]  cx cy w h objectness classes; three anchors a cell (v5, v7)
    yolov8         [1, 4 + nc, A]  cx cy w h classes; one anchor a cell (v8, v9, v11, v12)
    end2end        [1, n, 6]       x1 y1 x2 y2 score class, after suppression (v10, 26)
    yolox          [1, A, 5 + nc]  as yolov5 but one anchor a cell, and raw:
                                   centre (xy + cell) * stride, size exp(wh) * stride
    yolox-decoded  [1, A, 5 + nc]  the same, decoded by the network

Boxes are in pixels of the network's input. A is the number of cells of all strides, given by the
input size; it identifies the layout where the metadata does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, cast, get_args

import numpy as np
import numpy.typing as npt

from bikeped.detection.model_metadata import ModelMetadata
from bikeped.errors import DetectorError
from bikeped.types import BoolArray, Float32Array, IntArray

Layout = Literal["yolov5", "yolov8", "end2end", "yolox", "yolox-decoded"]
LAYOUTS: tuple[Layout, ...] = get_args(Layout)

#: Detection heads in use: P3-P5, P3-P6 (the large models), P2-P5 (the small-object ones).
STRIDE_SETS: tuple[tuple[int, ...], ...] = ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32))
_V5_ANCHORS_A_CELL = 3
_END2END_MOST = 1000  #: [1, n, 6] with more rows is a grid of one class, not an end-to-end output
_SCORE_SLACK = 1e-3  #: half precision may carry a probability this far past 1
_ASK = "set detection.layout to one of " + ", ".join(LAYOUTS)


@dataclass(frozen=True)
class Candidates:
    """Boxes before suppression, in the output's own order.

    `box` [n, 4] x1, y1, x2, y2 in input pixels; `score` [n] in 0..1; `class_id` [n].
    """

    box: Float32Array
    score: Float32Array
    class_id: IntArray

    def __len__(self) -> int:
        return len(self.score)


@dataclass(frozen=True)
class LayoutChoice:
    """A layout, its number of classes where the shape tells it, and why it was chosen."""

    layout: Layout
    classes: int | None
    reason: str


def anchor_count(size: tuple[int, int], strides: tuple[int, ...]) -> int:
    """Cells of all strides together for an input of `size` (width, height)."""
    width, height = size
    return sum(-(-width // s) * -(-height // s) for s in strides)


def strides_of(anchors: int, size: tuple[int, int], per_cell: int = 1) -> tuple[int, ...] | None:
    """The strides whose cells make up `anchors`, or None."""
    for strides in STRIDE_SETS:
        if per_cell * anchor_count(size, strides) == anchors:
            return strides
    return None


def pick_output(outputs: list[tuple[str, npt.NDArray[Any]]], source: str) -> int:
    """Index of the output that holds the detections: the only one of three dimensions.

    Of several (a model with further heads), the one named `output0` or `output`. Raises
    `DetectorError` where none or several qualify.
    """
    flat = [i for i, (_, array) in enumerate(outputs) if array.ndim == 3]
    named = [i for i in flat if outputs[i][0] in ("output0", "output")]
    for choice in (flat, named):
        if len(choice) == 1:
            return choice[0]
    shapes = ", ".join(f"{name} {list(array.shape)}" for name, array in outputs)
    raise DetectorError(
        f"{source}: none of the outputs ({shapes}) is clearly the detections; export a detection "
        "model with one output of three dimensions"
    )


def choose_layout(
    output: npt.NDArray[Any],
    size: tuple[int, int],
    metadata: ModelMetadata,
    configured: str,
    source: str,
) -> LayoutChoice:
    """The layout of `output`, the output for any image of input `size` (width, height).

    `configured` is `detection.layout`. Metadata, then class names, then the anchor count decide;
    the two YOLOX layouts have the same shape and differ in their values (see `yolox_is_decoded`).
    Raises `DetectorError` where no layout or more than one fits.
    """
    shape = list(output.shape)
    if metadata.task not in (None, "detect"):
        raise DetectorError(
            f"{source}: the model's task is {metadata.task!r}; bikeped needs a detection model"
        )
    if output.ndim != 3 or shape[0] != 1:
        raise DetectorError(f"{source}: output has shape {shape}; bikeped needs [1, rows, columns]")
    # A configured layout is checked against the shape alone: it may overrule wrong metadata.
    fits = _fitting(output, size, metadata if configured == "auto" else ModelMetadata())
    if configured != "auto":
        asked = cast(Layout, configured)
        near: Layout = "yolox" if asked == "yolox-decoded" else asked
        if asked == "end2end" and shape[2] == 6:
            fits = {"end2end": None}
        if near not in fits:
            raise DetectorError(
                f"{source}: output {shape} for an input of {size[0]} x {size[1]} cannot be "
                f"detection.layout {asked}; {_fits_text(fits)}"
            )
        return LayoutChoice(asked, fits[near], "detection.layout says so")
    if len(fits) != 1:
        raise DetectorError(
            f"{source}: output {shape} for an input of {size[0]} x {size[1]} has no layout that "
            f"bikeped can tell; {_fits_text(fits)}; {_ASK}"
        )
    layout, classes = next(iter(fits.items()))
    reason = f"output {shape} fits no other layout at {size[0]} x {size[1]}"
    if layout == "yolox":
        decoded = yolox_is_decoded(output, size)
        if decoded is None:
            raise DetectorError(
                f"{source}: output {shape} is YOLOX's but its values look neither raw nor decoded; "
                f"{_ASK}"
            )
        layout = "yolox-decoded" if decoded else "yolox"
        reason += ", centres " + ("follow the grid" if decoded else "stay near zero")
    return LayoutChoice(layout, classes, reason)


def yolox_is_decoded(output: npt.NDArray[Any], size: tuple[int, int]) -> bool | None:
    """Whether a YOLOX output [1, A, 5 + nc] is decoded; None where the values fit neither.

    A decoded centre is within a few cells of its own cell for any image; a raw one is an offset of
    a few units around zero. Their medians over all cells differ by an order of magnitude.
    """
    strides = strides_of(output.shape[1], size)
    if strides is None:
        return None
    cell, stride = _grid(size, strides)
    with np.errstate(all="ignore"):
        centre = output[0, :, :2].astype(np.float64)
        centre = centre[np.isfinite(centre).all(axis=1)]
        if len(centre) != len(cell):
            return None  # only a complete output is conclusive
        from_cell = np.median(np.abs(centre - cell * stride), axis=0)
        from_zero = np.median(np.abs(centre), axis=0)
    near = np.asarray(size) / 8.0
    decoded, raw = bool((from_cell < near).all()), bool((from_zero < near).all())
    return None if decoded == raw else decoded


def decode(
    output: npt.NDArray[Any],
    layout: Layout,
    size: tuple[int, int],
    confidence: npt.ArrayLike,
    wanted: BoolArray,
    source: str,
) -> Candidates:
    """Boxes of at least `confidence` whose best class is `wanted`.

    `output` as the network gave it; `size` (width, height) of the input; `confidence` one number or
    one for each class; `wanted` [nc]. Rows with invalid numbers (not finite, a probability
    above 1, no area) are dropped. Raises `DetectorError` for another shape than the layout's, and
    where most rows are not finite or no probabilities: dropped, they would read as an empty street.
    """
    if output.dtype.kind not in "fiu":
        raise DetectorError(f"{source}: output is {output.dtype}, not numbers")
    shape, classes = output.shape, len(wanted)
    axis, length = {"end2end": (2, 6), "yolov8": (1, 4 + classes)}.get(layout, (2, 5 + classes))
    if len(shape) != 3 or shape[0] != 1 or shape[axis] != length:
        raise DetectorError(
            f"{source}: output has shape {list(shape)}, which is not {layout} with "
            f"{classes} classes"
        )
    if not wanted.any():
        return Candidates(
            np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int64)
        )
    least = np.broadcast_to(np.asarray(confidence, np.float32), wanted.shape)
    with np.errstate(all="ignore"):
        if layout == "end2end":
            found = _end2end(output[0], least, wanted, source)
        elif layout == "yolov8":
            found = _yolov8(output[0], least, wanted, source)
        else:
            found = _with_objectness(output[0], layout, size, least, wanted, source)
        # Rows of invalid numbers are dropped.
        box, score = found.box, found.score
        keep = np.isfinite(box).all(axis=1) & (score <= 1 + _SCORE_SLACK)
        keep &= (box[:, 2] > box[:, 0]) & (box[:, 3] > box[:, 1])
        return Candidates(
            np.ascontiguousarray(box[keep], np.float32),
            np.minimum(score[keep], np.float32(1)),
            found.class_id[keep],
        )


def _end2end(
    rows: npt.NDArray[Any], least: Float32Array, wanted: BoolArray, source: str
) -> Candidates:
    _check_probabilities(rows[:, 4], source)
    rows = rows.astype(np.float32)
    class_number = rows[:, 5]
    known = (class_number > -0.5) & (class_number < len(wanted) - 0.5)
    class_id = np.rint(np.where(known, class_number, 0)).astype(np.int64)
    keep = known & (rows[:, 4] >= least[class_id]) & wanted[class_id]
    return Candidates(rows[keep, :4], rows[keep, 4], class_id[keep])


def _yolov8(
    table: npt.NDArray[Any], least: Float32Array, wanted: BoolArray, source: str
) -> Candidates:
    index = np.nonzero(wanted)[0]
    # Cheap first: the best of the few wanted classes, over all anchors. An anchor whose best class
    # is wanted passes this, so nothing is lost; the full comparison is for the few left.
    best = table[4 + index].max(axis=0)
    _check_probabilities(best, source)
    few = np.nonzero(best >= least[index].min())[0]
    columns = table[:, few].astype(np.float32)
    return _best_class(_corners(columns[:4].T), columns[4:].T, least, wanted)


def _with_objectness(
    rows: npt.NDArray[Any],
    layout: Layout,
    size: tuple[int, int],
    least: Float32Array,
    wanted: BoolArray,
    source: str,
) -> Candidates:
    strides = strides_of(len(rows), size) if layout == "yolox" else ()
    if strides is None:
        raise DetectorError(
            f"{source}: {len(rows)} rows are not YOLOX's for an input of {size[0]} x {size[1]}"
        )
    objectness = rows[:, 4]
    _check_probabilities(objectness, source)
    # The score is objectness times a probability: it cannot exceed the objectness.
    few = np.nonzero(objectness >= least[wanted].min())[0]
    chosen = rows[few].astype(np.float32)
    box = chosen[:, :4]
    if strides:
        cell, stride = _grid(size, strides)
        box = np.concatenate(
            [(box[:, :2] + cell[few]) * stride[few], np.exp(box[:, 2:]) * stride[few]], axis=1
        )
    return _best_class(_corners(box), chosen[:, 5:] * chosen[:, 4:5], least, wanted)


def _best_class(
    box: Float32Array, scores: Float32Array, least: Float32Array, wanted: BoolArray
) -> Candidates:
    """One class a box, its best; kept where that is wanted and strong enough."""
    class_id = scores.argmax(axis=1)
    score = np.take_along_axis(scores, class_id[:, None], axis=1)[:, 0]
    keep = wanted[class_id] & (score >= least[class_id])
    return Candidates(box[keep], score[keep], class_id[keep].astype(np.int64))


def _check_probabilities(score: npt.NDArray[Any], source: str) -> None:
    """Raises `DetectorError` where most of `score` [n] cannot be probabilities."""
    odd = len(score) - np.count_nonzero((score >= -_SCORE_SLACK) & (score <= 1 + _SCORE_SLACK))
    if 2 * odd > len(score):
        raise DetectorError(
            f"{source}: {odd} of {len(score)} scores are not probabilities (not a number, or "
            "outside 0..1); the model is damaged, overflows in half precision, or has another "
            "detection.layout"
        )


def _corners(box: Float32Array) -> Float32Array:
    half = box[:, 2:] / 2
    corners: Float32Array = np.concatenate([box[:, :2] - half, box[:, :2] + half], axis=1)
    return corners


@lru_cache(maxsize=8)
def _grid(size: tuple[int, int], strides: tuple[int, ...]) -> tuple[Float32Array, Float32Array]:
    """Cell [A, 2] (x, y) and stride [A, 1] of every anchor, strides one after another."""
    width, height = size
    cells, steps = [], []
    for stride in strides:
        across, down = -(-width // stride), -(-height // stride)
        y, x = np.mgrid[:down, :across]
        cells.append(np.stack([x.ravel(), y.ravel()], axis=1))
        steps.append(np.full((across * down, 1), stride))
    cell, step = np.concatenate(cells), np.concatenate(steps)
    return cell.astype(np.float32), step.astype(np.float32)


def _fitting(
    output: npt.NDArray[Any], size: tuple[int, int], metadata: ModelMetadata
) -> dict[Layout, int | None]:
    """Layouts that the shape allows, with the number of classes that each implies."""
    _, first, second = output.shape
    names = None if metadata.names is None else len(metadata.names)
    fits: dict[Layout, int | None] = {}

    def offer(layout: Layout, classes: int) -> None:
        if classes >= 1 and names in (None, classes):
            fits[layout] = classes

    if strides_of(second, size):
        offer("yolov8", first - 4)
    if strides_of(first, size, _V5_ANCHORS_A_CELL):
        offer("yolov5", second - 5)
    if strides_of(first, size) and not metadata.ultralytics:
        offer("yolox", second - 5)
    # A grid of one class has six columns too, so the grids were asked first.
    if second == 6 and (metadata.end_to_end or (not fits and 0 < first <= _END2END_MOST)):
        fits = {"end2end": names}
    return fits


def _fits_text(fits: dict[Layout, int | None]) -> str:
    return "it could be " + " or ".join(fits) if fits else "it fits none"
