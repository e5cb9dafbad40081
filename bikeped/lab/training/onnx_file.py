"""Metadata of an exported ONNX file, and comparison of its output with PyTorch's."""

from __future__ import annotations

from typing import Any

import numpy as np

from bikeped.errors import DetectorError

#: ONNX Runtime fuses and reorders operations, so outputs differ by rounding.
_MOST_BOX_PX, _MOST_SCORE = 0.05, 1e-3


def with_metadata(content: bytes, facts: dict[str, str]) -> bytes:
    """An ONNX file's bytes with `facts` in its metadata, replacing entries of the same names."""
    import onnx

    model = onnx.load_model_from_string(content)
    kept = {entry.key: entry.value for entry in model.metadata_props} | facts
    onnx.helper.set_model_props(model, kept)
    # Path names of the exporter say nothing about the model.
    for node in model.graph.node:
        node.ClearField("doc_string")
    data: bytes = model.SerializeToString()
    return data


def compare(
    content: bytes, picture: np.ndarray[Any, Any], expected: np.ndarray[Any, Any], source: str
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
