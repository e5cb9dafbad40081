"""Which scale of input a YOLOX network was trained on, read from its ONNX file.

YOLOX changed its preprocessing in 0.1.1 and the file does not say which it wants; with the wrong
one it still answers, worse. But its first convolution gives it away: trained layers answer with
values around one, so a network on 0..255 has first weights smaller by the input's deviation,
255 * 0.225 = 57 times, than one on normalised input. The file is walked as protobuf here (a
few fields of onnx.proto; github.com/onnx/onnx), so that the pole needs no `onnx` package.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bikeped.errors import DetectorError

Buffer = memoryview
_FLOAT, _FLOAT16, _DOUBLE = 1, 10, 11
_TYPES = {_FLOAT: "<f4", _FLOAT16: "<f2", _DOUBLE: "<f8"}
#: Operators that move values about and leave them as they are.
_MOVES = frozenset({"Slice", "Concat", "Cast", "Identity", "Transpose", "Reshape", "SpaceToDepth"})
#: Gain (see `FirstLayer`) between these is neither clearly the one nor the other. YOLOX nano before
#: 0.1.1 has 7.8; the same network written for 0..255 has 0.14.
_LEGACY_ABOVE, _BYTES_BELOW = 1.0, 0.4


@dataclass(frozen=True)
class FirstLayer:
    """The first convolution of a network, batch normalisation folded in.

    `gain` is the root mean square, over filters, of the length of the filter's weights: the
    deviation of the answer to noise of deviation one. (Not the median: half of the filters may be
    nearly dead.) Trained on normalised pictures it is some units, on 0..255 about 57 times less.
    """

    name: str
    gain: float

    @property
    def trained_on_bytes(self) -> bool | None:
        """Whether the input is 0..255 (True), normalised (False), or cannot be told (None)."""
        if self.gain > _LEGACY_ABOVE:
            return False
        return True if self.gain < _BYTES_BELOW else None


@dataclass(frozen=True)
class _Node:
    op: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    constant: Buffer | None  #: the tensor of a Constant node
    epsilon: float


def first_layer(path: Path) -> FirstLayer | None:
    """The first convolution that the picture meets in an ONNX file.

    None where it cannot be judged: arithmetic before it, quantised weights, weights in another
    file. Raises `DetectorError` where the file cannot be read or is not ONNX.
    """
    try:
        return _walk(memoryview(path.read_bytes()))
    except (ValueError, struct.error, UnicodeDecodeError) as error:
        raise DetectorError(f"{path}: not an ONNX file that can be read: {error}") from error
    except OSError as error:
        raise DetectorError(f"{path}: cannot read the model file: {error.strerror}") from error


def _walk(model: Buffer) -> FirstLayer | None:
    graph = next((v for n, v in _fields(model) if n == 7 and isinstance(v, Buffer)), None)
    if graph is None:
        raise ValueError("no graph in it")
    nodes: list[_Node] = []
    tensors: dict[str, Buffer] = {}
    pictures: list[str] = []
    for number, value in _fields(graph):
        if not isinstance(value, Buffer):
            continue
        if number == 1:
            nodes.append(_node(value))
        elif number == 5:
            tensors[_text(value, 8)] = value
        elif number == 11:
            pictures.append(_text(value, 1))
    for node in nodes:
        if node.op == "Constant" and node.constant is not None and node.outputs:
            tensors[node.outputs[0]] = node.constant
    carried = {name for name in pictures if name not in tensors}
    for node in nodes:
        if not carried.intersection(node.inputs):
            continue
        if node.op == "Conv" and len(node.inputs) >= 2 and node.inputs[0] in carried:
            return _judge(node, nodes, tensors)
        if node.op not in _MOVES:
            return None
        carried.update(node.outputs)
    return None


def _judge(conv: _Node, nodes: list[_Node], tensors: dict[str, Buffer]) -> FirstLayer | None:
    name = conv.inputs[1]
    weights = _array(tensors[name]) if name in tensors else None
    if weights is None or weights.ndim != 4 or weights.size == 0:
        return None
    gain = np.sqrt((weights.astype(np.float64) ** 2).sum(axis=(1, 2, 3)))
    for node in nodes:
        if node.op == "BatchNormalization" and node.inputs[:1] == conv.outputs[:1]:
            scale, variance = (
                _array(tensors[key]) if key in tensors else None
                for key in (node.inputs[1], node.inputs[4])
            )
            if scale is None or variance is None or not len(gain) == scale.size == variance.size:
                return None
            gain = gain * np.abs(scale) / np.sqrt(np.maximum(variance + node.epsilon, 1e-12))
    mean = float(np.sqrt((gain**2).mean()))
    return FirstLayer(name, mean) if np.isfinite(mean) else None


def _node(data: Buffer) -> _Node:
    inputs: list[str] = []
    outputs: list[str] = []
    op, constant, epsilon = "", None, 1e-5
    for number, value in _fields(data):
        if not isinstance(value, Buffer):
            continue
        if number == 1:
            inputs.append(_utf8(value))
        elif number == 2:
            outputs.append(_utf8(value))
        elif number == 4:
            op = _utf8(value)
        elif number == 5:
            for inner, content in _fields(value):
                if inner == 5 and isinstance(content, Buffer):
                    constant = content
                elif inner == 2 and isinstance(content, float) and _text(value, 1) == "epsilon":
                    epsilon = content
    return _Node(op, tuple(inputs), tuple(outputs), constant, epsilon)


def _array(tensor: Buffer) -> npt.NDArray[np.floating] | None:
    """A TensorProto of floats as an array; None for other types and for weights kept elsewhere."""
    shape: list[int] = []
    kind, raw, packed = 0, b"", b""
    loose: list[float] = []
    for number, value in _fields(tensor):
        if number == 1:
            shape.extend([value] if isinstance(value, int) else _varints(value))
        elif number == 2 and isinstance(value, int):
            kind = value
        elif number == 4 and isinstance(value, Buffer):
            packed += bytes(value)
        elif number == 4 and isinstance(value, float):
            loose.append(value)
        elif number == 9 and isinstance(value, Buffer):
            raw = bytes(value)
        elif number == 14 and value == 1:
            return None
    if kind not in _TYPES:
        return None
    if raw:
        flat = np.frombuffer(raw, _TYPES[kind])
    else:
        flat = np.frombuffer(packed, "<f4") if packed else np.array(loose, np.float32)
    return flat.reshape(shape)


def _text(message: Buffer, number: int) -> str:
    """The string field `number` of a message, empty where it has none."""
    for n, value in _fields(message):
        if n == number and isinstance(value, Buffer):
            return _utf8(value)
    return ""


def _utf8(value: Buffer) -> str:
    return bytes(value).decode("utf-8")


def _fields(message: Buffer) -> Iterator[tuple[int, int | float | Buffer]]:
    """Number and value of every field of a protobuf message (protobuf.dev, encoding).

    A 32-bit value is given as a float, a 64-bit one as an integer. Raises `ValueError` where the
    bytes are not a message.
    """
    at, end = 0, len(message)
    while at < end:
        key, at = _varint(message, at)
        kind = key & 7
        if kind == 0:
            number, at = _varint(message, at)
            yield key >> 3, number
            continue
        if kind == 2:
            size, at = _varint(message, at)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            raise ValueError(f"field of unknown wire type {kind}")
        if at + size > end:
            raise ValueError("it ends within a field")
        part = message[at : at + size]
        at += size
        if kind == 5:
            yield key >> 3, float(struct.unpack("<f", part)[0])
        elif kind == 1:
            yield key >> 3, int.from_bytes(part, "little")
        else:
            yield key >> 3, part


def _varints(packed: int | float | Buffer) -> list[int]:
    numbers: list[int] = []
    at = 0
    while isinstance(packed, Buffer) and at < len(packed):
        number, at = _varint(packed, at)
        numbers.append(number)
    return numbers


def _varint(data: Buffer, at: int) -> tuple[int, int]:
    number = 0
    for shift in range(0, 70, 7):
        if at >= len(data):
            raise ValueError("it ends within a number")
        byte = data[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
    raise ValueError("a number of more than 64 bits")
