"""Every stage around the network: picture to input, output to road users.

A runtime (ONNX Runtime, TensorRT) is a `Backend` here: it owns the input array and answers with
output arrays. All the rest is the same for both, and lives in the pure modules beside this one.
"""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from bikeped.detection.base import DetectionResult
from bikeped.detection.classes import UNMAPPED, class_names, kind_table, riders_are_whole
from bikeped.detection.model_metadata import ModelMetadata
from bikeped.detection.nms import non_max_suppression, vote_boxes
from bikeped.detection.output_layouts import Candidates, Layout, choose_layout, decode, pick_output
from bikeped.detection.partial_persons import suppress_partial_person_boxes
from bikeped.detection.preprocess import PAD, Family, Letterbox, Preprocessor
from bikeped.detection.riders import join_riders
from bikeped.detection.weights import first_layer
from bikeped.errors import DetectorError
from bikeped.types import Detections, Float32Array, ImageArray, IntArray, Kind, KindArray, Region

if TYPE_CHECKING:
    from bikeped.config.schema.inputs import DetectionConfig

log = logging.getLogger(__name__)

#: A cycle under a rider may be this much less confident than `detection.confidence`.
RIDDEN_SHARE = 0.5
#: Suppression looks at this many of the strongest at most: it bounds the time of a strange frame.
MOST_CANDIDATES = 4096


class Backend(Protocol):
    """Runs the network. Raises `DetectorError` where it fails."""

    @property
    def description(self) -> str:
        """For people: what runs the network."""
        ...

    @property
    def metadata(self) -> ModelMetadata: ...

    @property
    def buffer(self) -> npt.NDArray[Any]:
        """The network's input [1, 3, height, width], to be filled before `run`."""
        ...

    def run(self) -> list[tuple[str, npt.NDArray[Any]]]:
        """The network's answer to what `buffer` holds: every output by name.

        The arrays may be overwritten by the next call.
        """
        ...


class NetworkDetector:
    """A `Detector` around a backend."""

    def __init__(
        self,
        path: Path,
        config: DetectionConfig,
        model_hash: str,
        backend: Backend,
        region: Region | None = None,
    ) -> None:
        """Runs the network on a grey picture: it warms up, and its answer shows the layout.

        `region`: the part of every frame that it is shown; None: all.
        """
        self._backend = backend
        self._config = config
        self._source = str(path)
        self._hash = model_hash
        height, width = backend.buffer.shape[2:]
        self._size = (int(width), int(height))
        metadata = backend.metadata
        backend.buffer[...] = PAD if backend.buffer.dtype == np.uint8 else PAD / 255
        outputs = backend.run()
        self._output = pick_output(outputs, self._source)
        answer = outputs[self._output][1]
        choice = choose_layout(answer, self._size, metadata, config.layout, self._source)
        self._layout: Layout = choice.layout
        classes = choice.classes
        if choice.layout == "end2end" and classes is None:
            classes = _coco_if_plausible(answer)
        names = class_names(metadata.names, classes, self._source)
        self.class_names: tuple[str, ...] = names  #: of the network's own classes, by their number
        self._kind_of_class = kind_table(names, config, self._source)
        self._wanted = self._kind_of_class != UNMAPPED
        self._whole = riders_are_whole(names, self._kind_of_class)
        self._rider_overlap = 1.0 if self._whole else config.rider_overlap
        faint = RIDDEN_SHARE if self._rider_overlap < 1 else 1.0
        self._least = np.where(
            self._kind_of_class == Kind.CYCLIST, config.confidence * faint, config.confidence
        ).astype(np.float32)
        family, why = _family(choice.layout, metadata, config, path)
        self._preprocess = Preprocessor(family, backend.buffer, region)
        log.info(
            "%s: %s, input %d x %d, shown %s, layout %s (%s), preprocessing %s (%s), %d classes",
            path,
            backend.description,
            width,
            height,
            "all of the frame" if region is None else f"the road ({_shares(region)})",
            choice.layout,
            choice.reason,
            family,
            why,
            len(names),
        )
        # Once more through every stage: grid tables, canvases and the runtime's own caches.
        self.infer(np.full((height, width, 3), PAD, np.uint8), self._size[0], self._size[1])

    @property
    def name(self) -> str:
        """The model file and what runs it."""
        return f"{Path(self._source).name} ({self._backend.description})"

    @property
    def model_hash(self) -> str:
        """SHA-256 of the model file."""
        return self._hash

    @property
    def input_size(self) -> tuple[int, int]:
        """Width and height of the network's input."""
        return self._size

    @property
    def cyclist_box_includes_rider(self) -> bool:
        """Whether a cyclist's box holds the rider, too, by the names of the model's classes."""
        return self._whole

    @property
    def layout(self) -> Layout:
        """The output layout in use."""
        return self._layout

    @property
    def family(self) -> Family:
        """The preprocessing in use."""
        return self._preprocess.family

    def decode_size(self, frame_width: int, frame_height: int) -> tuple[int, int]:
        """The size at which a frame is as large as on the network's input, never more than its own.

        Of the whole frame, also where only a part of it is shown.
        """
        box = self._preprocess.letterbox(frame_width, frame_height)
        x1, y1, x2, y2 = box.shown_px
        # Down to whole pixels: a copy that is a rounding smaller costs half of the decoding.
        wide = math.floor(box.width * frame_width / (x2 - x1) + 1e-6)
        high = math.floor(box.height * frame_height / (y2 - y1) + 1e-6)
        return min(wide, frame_width), min(high, frame_height)

    def infer(self, rgb: ImageArray, frame_width: int, frame_height: int) -> DetectionResult:
        """See `Detector.infer`."""
        start = time.perf_counter()
        where = self._preprocess(rgb, frame_width, frame_height)
        filled = time.perf_counter()
        outputs = self._backend.run()
        answered = time.perf_counter()
        if len(outputs) <= self._output:
            raise DetectorError(f"{self._source}: the network gave no answer")
        candidates = decode(
            outputs[self._output][1],
            self._layout,
            self._size,
            self._least,
            self._wanted,
            self._source,
        )
        found = self._road_users(candidates, where)
        end = time.perf_counter()
        return DetectionResult(
            found, (filled - start) * 1e3, (answered - filled) * 1e3, (end - answered) * 1e3
        )

    def infer_classes(
        self, rgb: ImageArray, frame_width: int, frame_height: int, confidence: float
    ) -> tuple[Detections, Candidates]:
        """One answer of the network read twice, for measuring a model: as `infer` gives it, and as
        the candidates of every class of at least `confidence`, in pixels of the full frame and
        clipped to it, nothing suppressed and nobody joined. Raises as `infer` does.
        """
        where = self._preprocess(rgb, frame_width, frame_height)
        outputs = self._backend.run()
        if len(outputs) <= self._output:
            raise DetectorError(f"{self._source}: the network gave no answer")
        answer = outputs[self._output][1]
        read = (answer, self._layout, self._size)
        users = decode(*read, self._least, self._wanted, self._source)
        every = decode(*read, confidence, np.ones_like(self._wanted), self._source)
        box = _on_frame(every.box, where)
        left = (box[:, 2] > box[:, 0]) & (box[:, 3] > box[:, 1])
        found = Candidates(box[left], every.score[left], every.class_id[left])
        return self._road_users(users, where), found

    def _road_users(self, candidates: Candidates, where: Letterbox) -> Detections:
        """Candidates as detections on the frame: one box an object, riders joined."""
        score = candidates.score
        if len(score) > MOST_CANDIDATES:
            strongest = np.sort(np.argsort(-score, kind="stable")[:MOST_CANDIDATES])
            score = score[strongest]
        else:
            strongest = np.arange(len(score))
        kind = self._kind_of_class[candidates.class_id[strongest]]
        box = _on_frame(candidates.box[strongest], where)
        # What lay on the grey rest has no area left. Boxes of one kind suppress one another
        # whatever their class: a car that is also a truck is one vehicle.
        on_frame = np.nonzero((box[:, 2] > box[:, 0]) & (box[:, 3] > box[:, 1]))[0]
        kind, score, box = kind[on_frame], score[on_frame], box[on_frame]
        keep = self._suppress(box, score, kind)
        steady = vote_boxes(box, score, kind, keep, self._config.merge_overlap)
        joined = join_riders(
            suppress_partial_person_boxes(Detections(kind[keep], score[keep], steady)),
            self._rider_overlap,
            self._config.confidence,
        )
        # Joining makes boxes grow: two sights of one cyclist may only now lie on one another.
        return joined.take(self._suppress(joined.box_px, joined.confidence, joined.kind))

    def _suppress(self, box: Float32Array, score: Float32Array, kind: KindArray) -> IntArray:
        """Which boxes stay: one for each object of a kind.

        Where a cyclist's box holds the rider, one person boxed as both is the likelier of the two.
        """
        group = np.where(kind == Kind.CYCLIST, Kind.PEDESTRIAN, kind) if self._whole else kind
        return non_max_suppression(box, score, group, self._config.iou, self._config.max_detections)


def _shares(region: Region) -> str:
    return (
        f"from {region.left:.1%} to {region.right:.1%} across, "
        f"from {region.top:.1%} to {region.bottom:.1%} down"
    )


def _on_frame(box: Float32Array, where: Letterbox) -> Float32Array:
    """Boxes [n, 4] in input pixels in pixels of the frame, clipped to what of it was shown."""
    x1, y1, x2, y2 = where.shown_px
    low, high = (np.array(side * 2, np.float32) for side in ((x1, y1), (x2, y2)))
    clipped: Float32Array = np.minimum(np.maximum(where.inverse(box), low), high)
    return clipped


def _coco_if_plausible(answer: npt.NDArray[Any]) -> int | None:
    """80 where an end-to-end answer without names numbers its classes as COCO could."""
    with np.errstate(all="ignore"):
        number = answer[0, :, 5].astype(np.float64)
    fits = number.size and bool(((number >= 0) & (number < 80) & (number % 1 == 0)).all())
    return 80 if fits else None


def _family(
    layout: Layout, metadata: ModelMetadata, config: DetectionConfig, path: Path
) -> tuple[Family, str]:
    """The preprocessing family and why. Raises `DetectorError` where it cannot be told."""
    if config.preprocess != "auto":
        return config.preprocess, "detection.preprocess says so"
    if metadata.ultralytics:
        return "ultralytics", "the metadata is Ultralytics'"
    if layout not in ("yolox", "yolox-decoded"):
        return "ultralytics", f"usual for layout {layout}"
    ask = "set detection.preprocess to yolox (0.1.1 and later) or yolox-legacy"
    if path.suffix.lower() != ".onnx":
        raise DetectorError(f"{path}: an engine does not show its preprocessing; {ask}")
    first = first_layer(path)
    if first is None or first.trained_on_bytes is None:
        seen = "is not readable" if first is None else f"has gain {first.gain:.3g}"
        raise DetectorError(
            f"{path}: the first convolution {seen}, so the preprocessing stays unknown; {ask}"
        )
    if first.trained_on_bytes:
        return "yolox", f"first convolution's gain {first.gain:.3g} is that of 0..255"
    return "yolox-legacy", f"first convolution's gain {first.gain:.3g} is that of normalised input"
