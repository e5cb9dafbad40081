"""The detector around a network: preprocessing, inference, decoding, suppression, riders; loading.

A runtime (ONNX Runtime, TensorRT) is a `Backend`: it owns the input array and returns output
arrays. Everything else is common to both and lives in the pure modules of this package.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from bikeped.config.schema import DetectionConfig
from bikeped.detection.model_metadata import (
    UNMAPPED,
    ModelMetadata,
    class_names,
    cyclist_classes_include_riders,
    kind_table,
)
from bikeped.detection.nms import non_max_suppression, vote_boxes
from bikeped.detection.output_layouts import Candidates, Layout, choose_layout, decode, pick_output
from bikeped.detection.person_boxes import join_riders, suppress_partial_person_boxes
from bikeped.detection.preprocess import PAD, Family, Letterbox, Preprocessor
from bikeped.errors import DetectorError
from bikeped.models import BUNDLED_SHA256, model_file, model_sha256
from bikeped.types import (
    BoolArray,
    Detections,
    Float32Array,
    ImageArray,
    IntArray,
    Kind,
    KindArray,
    Region,
)

log = logging.getLogger(__name__)

#: A cycle under a rider needs only this share of `detection.confidence`.
RIDDEN_CONFIDENCE_SHARE = 0.5
#: Suppression takes at most this many candidates, the strongest: it bounds its time.
MAX_CANDIDATES = 4096


@dataclass(frozen=True)
class DetectionResult:
    """Detections in one frame, and the time that each stage took, in milliseconds."""

    detections: Detections
    pre_ms: float
    inference_ms: float
    post_ms: float


class Backend(Protocol):
    """Runs the network. Raises `DetectorError` where it fails."""

    @property
    def description(self) -> str:
        """The runtime, for messages."""

    @property
    def metadata(self) -> ModelMetadata: ...

    @property
    def region(self) -> Region | None:
        """The part of every frame that the network sees; None: all."""

    @property
    def buffer(self) -> npt.NDArray[Any]:
        """The network's input [1, 3, height, width], to be filled before `run`."""

    def run(self) -> list[tuple[str, npt.NDArray[Any]]]:
        """All outputs for the input in `buffer`, with their names.

        The arrays may be overwritten by the next call.
        """


class Detector:
    """Detects road users in frames. For one thread at a time: buffers are reused."""

    def __init__(
        self, path: Path, config: DetectionConfig, model_hash: str, backend: Backend
    ) -> None:
        """Warms up the network on a grey image and chooses the layout by its output."""
        self._backend = backend
        self._config = config
        self._source = str(path)
        self.model_hash = model_hash  #: SHA-256 of the model file, lower-case hexadecimal
        height, width = backend.buffer.shape[2:]
        self.input_size = (int(width), int(height))  #: pixels
        metadata = backend.metadata
        backend.buffer[...] = PAD if backend.buffer.dtype == np.uint8 else PAD / 255
        outputs = backend.run()
        self._output = pick_output(outputs, self._source)
        answer = outputs[self._output][1]
        choice = choose_layout(answer, self.input_size, metadata, config.layout, self._source)
        self.layout: Layout = choice.layout
        classes = choice.classes
        if choice.layout == "end2end" and classes is None:
            classes = _coco_if_plausible(answer)
        names = class_names(metadata.names, classes, self._source)
        self.class_names: tuple[str, ...] = names  #: of the network's own classes, by their number
        self._kind_of_class = kind_table(names, config, self._source)
        self._wanted = self._kind_of_class != UNMAPPED
        #: Whether a cyclist's box holds the rider, too, who is then no pedestrian beside it.
        self.cyclist_box_includes_rider = cyclist_classes_include_riders(names, self._kind_of_class)
        self._rider_overlap = 1.0 if self.cyclist_box_includes_rider else config.rider_overlap
        share = RIDDEN_CONFIDENCE_SHARE if self._rider_overlap < 1 else 1.0
        self._min_confidence = np.where(
            self._kind_of_class == Kind.CYCLIST, config.confidence * share, config.confidence
        ).astype(np.float32)
        family, why = _family(choice.layout, metadata, config, path)
        self.family: Family = family
        self._preprocess = Preprocessor(family, backend.buffer, backend.region)
        log.info(
            "%s: %s, input %d x %d, region %s, layout %s (%s), preprocessing %s (%s), %d classes",
            path,
            backend.description,
            width,
            height,
            "frame" if backend.region is None else f"road ({_shares(backend.region)})",
            choice.layout,
            choice.reason,
            family,
            why,
            len(names),
        )
        # Once more through every stage, for grid tables, canvases and the runtime's caches.
        self.infer(np.full((height, width, 3), PAD, np.uint8), *self.input_size)

    @property
    def name(self) -> str:
        """The model file and what runs it."""
        return f"{Path(self._source).name} ({self._backend.description})"

    @property
    def region(self) -> Region | None:
        """The part of every frame that the network gets; None: all of it."""
        return self._preprocess.region

    def decode_size(self, frame_width: int, frame_height: int) -> tuple[int, int]:
        """Smallest decoded width and height that lose nothing against the full frame.

        A JPEG decoder may use any reduced scale that is not smaller than this.
        """
        box = self._preprocess.letterbox(frame_width, frame_height)
        x1, y1, x2, y2 = box.shown_px
        # Rounded down: one pixel more could need the next larger JPEG scale, at twice the time.
        wide = math.floor(box.width * frame_width / (x2 - x1) + 1e-6)
        high = math.floor(box.height * frame_height / (y2 - y1) + 1e-6)
        return min(wide, frame_width), min(high, frame_height)

    def infer(self, rgb: ImageArray, frame_width: int, frame_height: int) -> DetectionResult:
        """Detections in `rgb` [h, w, 3] uint8, a frame decoded at any scale.

        Boxes are in pixels of the full frame of `frame_width` x `frame_height`, clipped to it; most
        confident first, equal confidences in the network's order (deterministic). Raises
        `DetectorError` where the network fails or returns no numbers, and `ValueError` for an image
        of another aspect ratio than the frame's.
        """
        start = time.perf_counter()
        letterbox = self._preprocess(rgb, frame_width, frame_height)
        filled = time.perf_counter()
        output = self._run()
        answered = time.perf_counter()
        found = self._road_users(self._decode_road_users(output), letterbox)
        end = time.perf_counter()
        return DetectionResult(
            found, (filled - start) * 1e3, (answered - filled) * 1e3, (end - answered) * 1e3
        )

    def infer_classes(
        self, rgb: ImageArray, frame_width: int, frame_height: int, confidence: float
    ) -> tuple[Detections, Candidates]:
        """One inference read twice, for evaluation: the detections of `infer`, and the candidates
        of every class of at least `confidence`, in pixels of the full frame and clipped to it,
        before suppression and the joining of riders. Raises as `infer` does.
        """
        letterbox = self._preprocess(rgb, frame_width, frame_height)
        output = self._run()
        users = self._decode_road_users(output)
        wanted = np.ones_like(self._wanted)
        every = decode(output, self.layout, self.input_size, confidence, wanted, self._source)
        box = _to_frame(every.box, letterbox)
        kept = _has_area(box)
        candidates = Candidates(box[kept], every.score[kept], every.class_id[kept])
        return self._road_users(users, letterbox), candidates

    def _run(self) -> npt.NDArray[Any]:
        outputs = self._backend.run()
        if len(outputs) <= self._output:
            raise DetectorError(f"{self._source}: the network gave no answer")
        return outputs[self._output][1]

    def _decode_road_users(self, output: npt.NDArray[Any]) -> Candidates:
        return decode(
            output, self.layout, self.input_size, self._min_confidence, self._wanted, self._source
        )

    def _road_users(self, candidates: Candidates, letterbox: Letterbox) -> Detections:
        """Candidates as detections on the frame: one box an object, riders joined."""
        score = candidates.score
        if len(score) > MAX_CANDIDATES:
            strongest = np.sort(np.argsort(-score, kind="stable")[:MAX_CANDIDATES])
            score = score[strongest]
        else:
            strongest = np.arange(len(score))
        kind = self._kind_of_class[candidates.class_id[strongest]]
        box = _to_frame(candidates.box[strongest], letterbox)
        # Boxes on the padding have no area left. Boxes of one kind suppress one another whatever
        # their class: a car that is also a truck is one vehicle.
        on_frame = np.nonzero(_has_area(box))[0]
        kind, score, box = kind[on_frame], score[on_frame], box[on_frame]
        keep = self._suppress(box, score, kind)
        voted = vote_boxes(box, score, kind, keep, self._config.merge_overlap)
        joined = join_riders(
            suppress_partial_person_boxes(Detections(kind[keep], score[keep], voted)),
            self._rider_overlap,
            self._config.confidence,
        )
        # Joining enlarges boxes: two of one cyclist may overlap enough only now.
        return joined.take(self._suppress(joined.box_px, joined.confidence, joined.kind))

    def _suppress(self, box: Float32Array, score: Float32Array, kind: KindArray) -> IntArray:
        """Indices of one box for each object of a kind.

        Where a cyclist's box includes the rider, pedestrians and cyclists suppress one another.
        """
        if self.cyclist_box_includes_rider:
            kind = np.where(kind == Kind.CYCLIST, np.int8(Kind.PEDESTRIAN), kind)
        return non_max_suppression(box, score, kind, self._config.iou, self._config.max_detections)


def _shares(region: Region) -> str:
    return (
        f"from {region.left:.1%} to {region.right:.1%} across, "
        f"from {region.top:.1%} to {region.bottom:.1%} down"
    )


def _to_frame(box: Float32Array, letterbox: Letterbox) -> Float32Array:
    """Boxes [n, 4] from input pixels to frame pixels, clipped to the part that was shown."""
    x1, y1, x2, y2 = letterbox.shown_px
    low, high = (np.array(side * 2, np.float32) for side in ((x1, y1), (x2, y2)))
    clipped: Float32Array = np.minimum(np.maximum(letterbox.inverse(box), low), high)
    return clipped


def _has_area(box: Float32Array) -> BoolArray:
    return np.asarray((box[:, 2] > box[:, 0]) & (box[:, 3] > box[:, 1]))


def _coco_if_plausible(answer: npt.NDArray[Any]) -> int | None:
    """80 where the class numbers of an end-to-end output without names could be COCO's."""
    with np.errstate(all="ignore"):
        number = answer[0, :, 5].astype(np.float64)
    fits = number.size and bool(((number >= 0) & (number < 80) & (number % 1 == 0)).all())
    return 80 if fits else None


def _family(
    layout: Layout, metadata: ModelMetadata, config: DetectionConfig, path: Path
) -> tuple[Family, str]:
    """The preprocessing family and the reason. Raises `DetectorError` where it is unknown."""
    if config.preprocess != "auto":
        return config.preprocess, "detection.preprocess says so"
    if metadata.ultralytics:
        return "ultralytics", "the metadata is Ultralytics'"
    if layout not in ("yolox", "yolox-decoded"):
        return "ultralytics", f"usual for layout {layout}"
    ask = "set detection.preprocess to yolox (0.1.1 and later) or yolox-legacy"
    if path.suffix.lower() != ".onnx":
        raise DetectorError(f"{path}: an engine does not show its preprocessing; {ask}")
    from bikeped.detection.weights import first_gain, trained_on_bytes  # imports protobuf

    gain = first_gain(path)
    on_bytes = None if gain is None else trained_on_bytes(gain)
    if on_bytes is None:
        seen = "is not readable" if gain is None else f"has gain {gain:.3g}"
        raise DetectorError(
            f"{path}: the first convolution {seen}, so the preprocessing stays unknown; {ask}"
        )
    family: Family = "yolox" if on_bytes else "yolox-legacy"
    input_range = "0..255" if on_bytes else "normalised input"
    return family, f"first convolution's gain {gain:.3g} is that of {input_range}"


def sha256_of(path: Path, expected: str | None = None) -> str:
    """The model's SHA-256 in lower-case hexadecimal (`model_sha256`).

    Raises `DetectorError` where the file cannot be read or is not `expected`, `detection.sha256`.
    """
    try:
        actual = model_sha256(path)
    except FileNotFoundError as error:
        raise DetectorError(
            f"{error.filename}: no such model file; correct detection.model or put the file there"
        ) from None
    except ValueError:  # mmap's word for an empty file
        raise DetectorError(f"{path}: is empty; put the model there") from None
    except OSError as error:
        raise DetectorError(f"{path}: cannot read the model file: {error.strerror}") from error
    if expected is not None and expected.lower() != actual:
        raise DetectorError(
            f"{path}: SHA-256 is {actual} but detection.sha256 expects {expected.lower()}; "
            "put the right model there or correct detection.sha256"
        )
    return actual


def load_detector(config: DetectionConfig, base_dir: Path, road: Region | None = None) -> Detector:
    """The detector of the section `detection`, warmed up.

    A relative `detection.model` starts from `base_dir`; `bundled` is the model that comes with
    bikeped, with 8-bit weights on a CPU. `road` is the part of the frames in which road users can
    appear, for `detection.region`; None: the whole frame. Raises `DetectorError` where there is no
    model, its hash differs, it cannot be run, or its output layout is unknown.
    """
    if config.model is None:
        raise DetectorError(
            "detection.model: no model is configured; name an .onnx or .engine file, or bundled"
        )
    path = model_file(config.model, base_dir)
    # Imported where needed: an .engine does not need onnxruntime, nor an .onnx file tensorrt.
    if path.suffix.lower() == ".onnx":
        from bikeped.detection.onnx_runtime import OnnxBackend, runs_on_cpu

        path = model_file(config.model, base_dir, on_cpu=runs_on_cpu(config.providers))
        digest = sha256_of(path, BUNDLED_SHA256.get(path, config.sha256))
        backend: Backend = OnnxBackend(path, config, digest, road)
    elif path.suffix.lower() == ".engine":
        from bikeped.detection.trt_engine import EngineBackend

        digest = sha256_of(path, config.sha256)
        backend = EngineBackend(path, config, road)
    else:
        raise DetectorError(
            f"detection.model: {path} is neither .onnx nor .engine; export the model to one of them"
        )
    return Detector(path, config, digest, backend)
