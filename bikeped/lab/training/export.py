"""Exports weights to ONNX.

Class names, input size and task go into the file's metadata as text, as Ultralytics writes them and
`bikeped.detection` reads them.
"""

from __future__ import annotations

import io
import json
import tempfile
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from bikeped import __version__
from bikeped.errors import DetectorError
from bikeped.files import write_whole
from bikeped.lab.training.coco import CocoData
from bikeped.lab.training.network import (
    STRIDES,
    ExportModule,
    SmallDetector,
    is_small,
    load_weights,
)

_OPSET = 17
#: ONNX Runtime fuses and reorders operations, so outputs differ by rounding.
_MOST_BOX_PX, _MOST_SCORE = 0.05, 1e-3


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
    from bikeped.lab.training.coco import read_coco
    from bikeped.lab.training.quantise import calibration_images, quantise

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
