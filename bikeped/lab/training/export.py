"""From weights to what bikeped runs: an ONNX file with its facts inside, a TensorRT engine.

The facts (class names, input size, task) are written as Ultralytics writes them, which is what
`bikeped.detection` reads: text in the ONNX metadata, JSON in front of an engine.
"""

from __future__ import annotations

import io
import json
import tempfile
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from bikeped import __version__
from bikeped.errors import DetectorError
from bikeped.files import write_whole
from bikeped.lab.training.network import STRIDES, Exported, SmallNet
from bikeped.lab.training.onnx_file import compare, with_metadata
from bikeped.lab.training.weights import is_small, load_weights

_OPSET = 17


@dataclass(frozen=True)
class ExportSummary:
    """What was written and how far its answers are from PyTorch's."""

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


def export_weights(weights: Path, out: Path) -> ExportSummary:
    """Writes the small network's weights as ONNX. Raises DetectorError where that fails."""
    network, names, size, facts = load_weights(weights)
    return export_network(network, names, size, out, facts)


def export_network(
    network: SmallNet,
    names: tuple[str, ...],
    size: tuple[int, int],
    out: Path,
    facts: dict[str, Any],
) -> ExportSummary:
    """Writes `network` as ONNX and holds its answers against PyTorch's, before the file is there.

    `size` is width and height of the input that is told in the metadata; it takes any multiples of
    32. `facts` go into the metadata as JSON.
    """
    width, height = size
    whole = Exported(network.eval()).eval()
    generator = torch.Generator().manual_seed(0)
    picture = torch.rand((1, 3, height, width), generator=generator)
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
    content = with_metadata(
        file.getvalue(),
        {
            "author": f"bikeped {__version__}",
            "task": "detect",
            "names": repr(dict(enumerate(names))),
            "imgsz": repr([height, width]),
            "stride": str(STRIDES[-1]),
            "bikeped": json.dumps(facts, sort_keys=True),
        },
    )
    box = score = 0.0
    # Of other sides, too: the traced network must not have kept this picture's.
    for shown in (picture, picture[:, :, : max(STRIDES[-1], height // 2 // 32 * 32)]):
        with torch.no_grad():
            expected = whole(shown).numpy()
        apart = compare(content, shown.contiguous().numpy(), expected, str(out))
        box, score = max(box, apart[0]), max(score, apart[1])
    write_whole(out, content)
    return ExportSummary(out, len(content), names, size, box, score)


def export_any(weights: Path, out: Path, size: int, int8: Path | None = None) -> dict[str, Any]:
    """Exports whatever `model train` wrote: the small network's weights, or a YOLO's (`size`).

    `int8`: a data set from whose pictures the steps of eight-bit numbers are taken; the small
    network only. Raises DetectorError and DataSetError.
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

    return export_yolo(weights, out, size)


def _in_int8(weights: Path, out: Path, data: Path) -> ExportSummary:
    from bikeped.lab.training.coco import read_coco
    from bikeped.lab.training.quantise import quantise, shown_pictures

    pictures = read_coco(data)
    with tempfile.TemporaryDirectory() as folder:
        summary = export_weights(weights, Path(folder) / "float.onnx")
        shown = shown_pictures(pictures, summary.size)
        return replace(summary, path=out, bytes=quantise(summary.path, shown, out))
