"""Reads from a YOLOX ONNX file which input scale the network was trained on.

YOLOX changed its preprocessing in 0.1.1, and the file does not say which it needs; with the wrong
one it still returns detections, but worse. The first convolution shows it: the outputs of trained
layers are of the order of 1, so a network on 0..255 has first weights smaller by the input's
deviation, 255 * 0.225 = 57 times, than one on normalised input. The few fields of onnx.proto
(github.com/onnx/onnx) that this needs are declared here: the device needs no `onnx` package.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from bikeped.errors import DetectorError

#: TensorProto.DataType: FLOAT, FLOAT16, DOUBLE.
_TYPES = {1: "<f4", 10: "<f2", 11: "<f8"}
#: Operators that rearrange values and do not change them.
_MOVES = frozenset({"Slice", "Concat", "Cast", "Identity", "Transpose", "Reshape", "SpaceToDepth"})
#: A gain (see `first_gain`) between these decides nothing. YOLOX nano before 0.1.1 has 7.8; the
#: same network written for 0..255 has 0.14.
_LEGACY_ABOVE, _BYTES_BELOW = 1.0, 0.4
#: Fields of onnx.proto's messages: name, number and type; `*` is repeated.
_FIELDS = {
    "Tensor": "dims 1 *int64, data_type 2 int32, float_data 4 *float, name 8 string, "
    "raw_data 9 bytes, data_location 14 int32",
    "Attribute": "name 1 string, f 2 float, t 5 Tensor",
    "Node": "input 1 *string, output 2 *string, op_type 4 string, attribute 5 *Attribute",
    "ValueInfo": "name 1 string",
    "Graph": "node 1 *Node, initializer 5 *Tensor, input 11 *ValueInfo",
    "Model": "graph 7 Graph",
}


def trained_on_bytes(gain: float) -> bool | None:
    """Whether the input is 0..255 (True), normalised (False), or unknown (None), by the gain."""
    if gain > _LEGACY_ABOVE:
        return False
    return True if gain < _BYTES_BELOW else None


def first_gain(path: Path) -> float | None:
    """The gain of an ONNX file's first convolution after the image, batch normalisation folded in.

    It is the root mean square, over filters, of the norm of the filter's weights: the standard
    deviation of the output for unit noise. (Not the median: half of the filters may be nearly
    zero.) Trained on normalised input it is of the order of 1, on 0..255 about 57 times less.
    None where it cannot be read: arithmetic before it, quantised weights, weights in another file.
    Raises `DetectorError` where the file cannot be read or is not ONNX.
    """
    try:
        model = _model_message()()
        model.ParseFromString(path.read_bytes())
        if not model.HasField("graph"):
            raise ValueError("it has no graph")
        return _first_convolution(model.graph)
    except (ValueError, DecodeError) as error:
        raise DetectorError(f"{path}: not an ONNX file that can be read: {error}") from error
    except OSError as error:
        raise DetectorError(f"{path}: cannot read the model file: {error.strerror}") from error


def _first_convolution(graph: Any) -> float | None:
    tensors = {tensor.name: tensor for tensor in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant" and node.output:
            tensors.update((node.output[0], a.t) for a in node.attribute if a.HasField("t"))
    image_values = {value.name for value in graph.input} - set(tensors)
    for node in graph.node:
        if image_values.isdisjoint(node.input):
            continue
        if node.op_type == "Conv" and len(node.input) >= 2 and node.input[0] in image_values:
            return _gain(node, graph.node, tensors)
        if node.op_type not in _MOVES:
            return None
        image_values.update(node.output)
    return None


def _gain(conv: Any, nodes: Any, tensors: dict[str, Any]) -> float | None:
    weights = _array(tensors.get(conv.input[1]))
    if weights is None or weights.ndim != 4 or weights.size == 0:
        return None
    gain = np.sqrt((weights.astype(np.float64) ** 2).sum(axis=(1, 2, 3)))
    for node in nodes:
        if node.op_type == "BatchNormalization" and node.input[:1] == conv.output[:1]:
            if len(node.input) < 5:
                return None
            scale, variance = (_array(tensors.get(node.input[i])) for i in (1, 4))
            if scale is None or variance is None or not len(gain) == scale.size == variance.size:
                return None
            epsilon = next((a.f for a in node.attribute if a.name == "epsilon"), 1e-5)
            gain = gain * np.abs(scale) / np.sqrt(np.maximum(variance + epsilon, 1e-12))
    mean = float(np.sqrt((gain**2).mean()))
    return mean if np.isfinite(mean) else None


def _array(tensor: Any) -> npt.NDArray[np.floating] | None:
    """A tensor of floats as an array; None for other types and for weights in another file."""
    if tensor is None or tensor.data_location == 1 or tensor.data_type not in _TYPES:
        return None
    if tensor.raw_data:
        flat = np.frombuffer(tensor.raw_data, _TYPES[tensor.data_type])
    else:
        flat = np.array(tensor.float_data, np.float32)
    return flat.reshape(tuple(tensor.dims))


@cache
def _model_message() -> Any:
    """The message class of onnx.proto's ModelProto, with the fields in `_FIELDS`."""
    file = descriptor_pb2.FileDescriptorProto(name="bikeped/onnx.proto", package="bikeped.onnx")
    for message_name, fields in _FIELDS.items():
        message = file.message_type.add(name=message_name)
        for text in fields.split(", "):
            name, number, kind = text.split()
            repeated, kind = kind.startswith("*"), kind.lstrip("*")
            field = message.field.add(name=name, number=int(number), label=3 if repeated else 1)
            if kind in _FIELDS:
                field.type, field.type_name = field.TYPE_MESSAGE, f".bikeped.onnx.{kind}"
            else:
                field.type = getattr(field, f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("bikeped.onnx.Model"))
