"""Static quantisation of the small network to eight bits: 0.7 of the time on a processor.

Weights (per channel) and activations become eight-bit integers, calibrated on pictures (Jacob et
al. 2018, "Quantization and training of neural networks for efficient integer-arithmetic-only
inference"). The first layer stays in floating point, as its three channels gain nothing, and so do
scores and edges, which must be exact and take little time.
"""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.detection.preprocess import Preprocessor
from bikeped.errors import DetectorError
from bikeped.files import write_whole
from bikeped.lab.training.coco import CocoData, read_picture
from bikeped.types import Float32Array

CALIBRATION_IMAGES = 64  #: enough to calibrate with
_INPUT = "images"
#: Names of the quantised operations, as `export` writes them. The last concatenation is not one:
#: edges would be rounded to a twentieth of a cell.
_ROUNDED = re.compile(
    r"/network/(stem/stem\.[12]/|stages\.|lateral\.|merge\.|heads\.\d+/trunk/|Resize|Add)"
)
_OPERATIONS = ["Conv", "Relu", "Concat", "Add", "Slice", "Resize"]


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
