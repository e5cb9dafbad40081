"""ONNX files of exported models, with metadata as Ultralytics writes them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.errors import DetectorError
from bikeped.files import write_whole
from bikeped.lab.training.coco import CocoData

#: ONNX Runtime fuses and reorders operations, so outputs differ by rounding.
_MOST_BOX_PX, _MOST_SCORE = 0.05, 1e-3


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
