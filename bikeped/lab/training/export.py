"""Exports weights to ONNX, as they are or in eight bits.

Class names, input size and task go into the file's metadata as text, as Ultralytics writes them and
`bikeped.detection` reads them.
"""

from __future__ import annotations

import io
import json
import logging
import re
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from bikeped import __version__
from bikeped.detection.preprocess import Preprocessor
from bikeped.errors import DetectorError
from bikeped.files import write_whole
from bikeped.lab.training.coco import CocoData, read_coco, read_picture
from bikeped.lab.training.network import (
    STRIDES,
    ExportModule,
    SmallDetector,
    is_small,
    load_weights,
)
from bikeped.types import Float32Array

_OPSET = 17
#: ONNX Runtime fuses and reorders operations, so outputs differ by rounding.
_MOST_BOX_PX, _MOST_SCORE = 0.05, 1e-3
CALIBRATION_IMAGES = 64  #: enough to calibrate with
_INPUT = "images"
#: Names of the operations to quantise, as `export_network` writes them. The last concatenation is
#: not one: edges would be rounded to a twentieth of a cell.
_ROUNDED = re.compile(
    r"/network/(stem/stem\.[12]/|stages\.|lateral\.|merge\.|heads\.\d+/trunk/|Resize|Add)"
)
_OPERATIONS = ["Conv", "Relu", "Concat", "Add", "Slice", "Resize"]


def export_weights(weights: Path, out: Path) -> ExportSummary:
    """Exports a weight file of the small network. Raises DetectorError where that fails."""
    return export_network(load_weights(weights), out)


def export_network(detector: SmallDetector, out: Path) -> ExportSummary:
    """Writes the small network as ONNX after comparing its output with PyTorch's.

    The model takes any input size in multiples of 32; the metadata name `detector.size`, and hold
    `detector.facts` as JSON. Raises DetectorError where the outputs differ.
    """
    width, height = detector.size
    whole = ExportModule(detector.network.eval()).eval()
    picture = torch.rand((1, 3, height, width), generator=torch.Generator().manual_seed(0))
    file = io.BytesIO()
    with warnings.catch_warnings():
        # The exporter that needs nothing but PyTorch is called deprecated since PyTorch 2.9.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            whole,
            (picture,),
            file,
            opset_version=_OPSET,
            dynamo=False,
            input_names=["images"],
            output_names=["output0"],
            dynamic_axes={"images": {2: "height", 3: "width"}, "output0": {2: "cells"}},
        )
    # A second size shows that the trace has not fixed the first one.
    shown = (picture, picture[:, :, : max(STRIDES[-1], height // 2 // 32 * 32)].contiguous())
    with torch.no_grad():
        outputs = [(part.numpy(), whole(part).numpy()) for part in shown]
    facts = json.dumps(detector.facts, sort_keys=True)
    author = f"bikeped {__version__}"
    return write_onnx(
        out, file.getvalue(), detector.names, detector.size, outputs, author=author, bikeped=facts
    )


def export_any(weights: Path, out: Path, size: int, int8: Path | None = None) -> dict[str, Any]:
    """Exports the weights of either network of `model train`; `size` is a YOLO's input side.

    `int8`: data set to calibrate the eight-bit steps with; the small network only. Raises
    DetectorError and DataSetError.
    """
    if is_small(weights):
        summary = export_weights(weights, out) if int8 is None else _in_int8(weights, out, int8)
        return summary.as_dict()
    if int8 is not None:
        raise DetectorError(
            f"--int8: {weights} is no small network's; export without it, and let TensorRT or ONNX "
            "Runtime round a YOLO"
        )
    from bikeped.lab.training.yolo import export_yolo

    return export_yolo(weights, out, size).as_dict()


def _in_int8(weights: Path, out: Path, data: Path) -> ExportSummary:
    pictures = read_coco(data)
    with tempfile.TemporaryDirectory() as folder:
        summary = export_weights(weights, Path(folder) / "float.onnx")
        shown = calibration_images(pictures, summary.size)
        return replace(summary, path=out, bytes=quantise(summary.path, shown, out))


@dataclass(frozen=True)
class ExportSummary:
    """An exported model: class names, input size (width, height), and how much its output differs
    from PyTorch's."""

    path: Path
    bytes: int
    names: tuple[str, ...]
    size: tuple[int, int]
    box_difference_px: float
    score_difference: float

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "model": str(self.path),
            "bytes": self.bytes,
            "names": list(self.names),
            "size": list(self.size),
            "largest_box_difference_px": self.box_difference_px,
            "largest_score_difference": self.score_difference,
        }


def write_onnx(
    out: Path,
    content: bytes,
    names: Sequence[str],
    size: tuple[int, int],
    outputs: Iterable[tuple[npt.NDArray[Any], npt.NDArray[Any]]],
    **facts: str,
) -> ExportSummary:
    """Writes an exported model with its metadata, after comparing its outputs with PyTorch's.

    `size`: width and height of the input; `outputs`: pictures [1, 3, h, w] and PyTorch's output for
    each; `facts` are further metadata. Raises DetectorError where the outputs differ.
    """
    import onnx

    model = onnx.load_model_from_string(content)
    known = {"task": "detect", "names": repr(dict(enumerate(names))), "stride": "32"}
    known |= {"imgsz": repr([size[1], size[0]]), **facts}
    kept = {entry.key: entry.value for entry in model.metadata_props}
    onnx.helper.set_model_props(model, kept | known)
    # Path names of the exporter say nothing about the model.
    for node in model.graph.node:
        node.ClearField("doc_string")
    content = model.SerializeToString()
    apart = [_compare(content, picture, expected, out) for picture, expected in outputs]
    box_px, score = (max(values) for values in zip(*apart, strict=True))
    write_whole(out, content)
    return ExportSummary(out, len(content), tuple(names), size, box_px, score)


def training_record(data: CocoData, weights: Path, exported: ExportSummary) -> dict[str, Any]:
    """What training.json records of either network."""
    return {
        "data": str(data.source),
        "data_sha256": data.sha256,
        "pictures": len(data.images),
        "objects": data.count,
        "names": list(exported.names),
        "size": list(exported.size),
        "weights": str(weights),
        "model": str(exported.path),
        "model_bytes": exported.bytes,
    }


def _compare(
    content: bytes, picture: npt.NDArray[Any], expected: npt.NDArray[Any], source: Path
) -> tuple[float, float]:
    """Largest differences of boxes (pixels) and scores between ONNX Runtime and `expected`.

    Raises DetectorError where they are too large to be rounding.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    answer = np.asarray(session.run(None, {session.get_inputs()[0].name: picture})[0])
    if answer.shape != expected.shape:
        raise DetectorError(
            f"{source}: ONNX Runtime answers {list(answer.shape)}, PyTorch {list(expected.shape)}; "
            "export with another PyTorch or ONNX Runtime"
        )
    difference = np.abs(answer.astype(np.float64) - expected)
    box, score = float(difference[:, :4].max()), float(difference[:, 4:].max())
    if not (box <= _MOST_BOX_PX and score <= _MOST_SCORE):
        raise DetectorError(
            f"{source}: ONNX Runtime's answer differs from PyTorch's by {box:.3g} px and "
            f"{score:.3g} in score; export with another PyTorch or ONNX Runtime"
        )
    return box, score


def calibration_images(
    data: CocoData, size: tuple[int, int], count: int = CALIBRATION_IMAGES
) -> Iterator[Float32Array]:
    """About `count` evenly spread pictures of `data`, preprocessed for a network of input `size`
    (width, height): [1, 3, h, w], 0..1. Raises DataSetError for one that cannot be read."""
    width, height = size
    show = Preprocessor("ultralytics", np.zeros((1, 3, height, width), np.float32))
    for image in data.images[:: max(1, len(data.images) // count)]:
        show(read_picture(image), image.width, image.height)
        yield np.asarray(show.buffer, np.float32).copy()


def quantise(model: Path, pictures: Iterable[Float32Array], out: Path) -> int:
    """Quantises `model`, an ONNX file of the small network, to `out`; returns the size in bytes.

    Weights (per channel) and activations become eight-bit integers, in 0.7 of the time on a
    processor (Jacob et al. 2018, "Quantization and training of neural networks for efficient
    integer-arithmetic-only inference"). The first layer, which gains nothing, and scores and edges,
    which must be exact, stay in floating point.

    `pictures` as `calibration_images` gives them: the ranges are means over them, values beyond are
    clipped. Weights take seven of the eight bits, for with eight the sums of two products overflow
    on processors with AVX2 only (ONNX Runtime, "Quantize ONNX models", `reduce_range`). Raises
    DetectorError where there is no picture, or the model is another one.
    """
    import onnx
    from onnxruntime.quantization import (
        CalibrationDataReader,
        QuantFormat,
        QuantType,
        quantize_static,
    )

    class Reader(CalibrationDataReader):  # type: ignore[misc]  # ONNX Runtime has no types
        def __init__(self) -> None:
            self._pictures, self.count = iter(pictures), 0

        def get_next(self) -> dict[str, npt.NDArray[Any]] | None:
            picture = next(self._pictures, None)
            if picture is None:
                return None
            self.count += 1
            return {_INPUT: picture}

    nodes = onnx.load(str(model)).graph.node
    kept = [node.name for node in nodes if not _ROUNDED.match(node.name)]
    if len(kept) == len(nodes):
        raise DetectorError(f"{model}: is not the small network that `bikeped model export` writes")
    reader = Reader()
    log = logging.getLogger()
    level = log.level
    log.setLevel(logging.ERROR)  # advice about a preprocessing that the exporter has done
    try:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "int8.onnx"
            quantize_static(
                str(model),
                str(file),
                reader,
                quant_format=QuantFormat.QDQ,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                per_channel=True,
                reduce_range=True,
                op_types_to_quantize=_OPERATIONS,
                nodes_to_exclude=kept,
                # Mean ranges: the extremes of one glaring picture would coarsen all others.
                extra_options={"CalibMovingAverage": True},
            )
            content = file.read_bytes()
    except ValueError as error:
        if reader.count:
            raise
        raise DetectorError(f"{model}: no picture to calibrate with; name a data set") from error
    finally:
        log.setLevel(level)
    write_whole(out, content)
    return len(content)
