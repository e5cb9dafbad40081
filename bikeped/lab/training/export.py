"""Exports weights to ONNX.

Class names, input size and task go into the file's metadata as text, as Ultralytics writes them and
`bikeped.detection` reads them.
"""

from __future__ import annotations

import io
import json
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from bikeped import __version__
from bikeped.errors import DetectorError
from bikeped.lab.training.network import STRIDES, ExportModule
from bikeped.lab.training.onnx_file import ExportSummary, write_onnx
from bikeped.lab.training.weights import SmallDetector, is_small, load_weights

_OPSET = 17


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
