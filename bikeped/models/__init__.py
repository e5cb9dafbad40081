"""The bundled small detector, for demo, self-test and pixel conformance.

It was trained on drawn streets only; docs/bundled-detector.md has its figures and limits.
"""

from __future__ import annotations

import hashlib
import os
import re
from mmap import ACCESS_READ, mmap
from pathlib import Path

#: Value of `detection.model` for the bundled model.
BUNDLED = "bundled"
NOT_FOR_STREETS = (
    "the bundled model knows drawn streets only; it must not warn anybody on a real one"
)
BUNDLED_FILE = Path(__file__).with_name("small.onnx")
#: The same network quantised to eight bits, quicker on a processor.
BUNDLED_INT8_FILE = Path(__file__).with_name("small-int8.onnx")
#: A drawn picture in which the bundled model must find what check.json says.
CHECK_PICTURE_FILE = Path(__file__).with_name("check.jpg")

#: SHA-256 of the bundled files: they are never loaded with another content.
BUNDLED_SHA256 = {
    BUNDLED_FILE: "a9877bdf3f2b92e7ddffcb9120dd5b594a8bba3337de3b8d52abea3165971786",
    BUNDLED_INT8_FILE: "1d90a19da5944fd5312a188224f306db994fc0e35e1e1246ca9172497e24fc49",
}


def model_file(model: str, base_dir: Path, *, on_cpu: bool = False) -> Path:
    """The file of `detection.model`, relative to `base_dir`; `on_cpu`: to run on a processor."""
    if model == BUNDLED:
        return BUNDLED_INT8_FILE if on_cpu else BUNDLED_FILE
    return base_dir / Path(model).expanduser()


#: A tensor's `location` in an ONNX file: key and value of a protobuf entry, each with its length.
_LOCATION = re.compile(rb"\x0a\x08location\x12([\x80-\xff]*[\x00-\x7f])", re.DOTALL)


def model_sha256(path: Path) -> str:
    """SHA-256 of a model: of its file, and then of the files beside it that hold its weights.

    `cat model.onnx model.onnx.data | sha256sum` gives the same; several such files follow in the
    order of their names. Raises OSError where one cannot be read.
    """
    digest, weights = hashlib.sha256(), set()
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        digest.update(data)
        if path.suffix.lower() == ".onnx":
            for found in _LOCATION.finditer(data):
                length = sum((b & 0x7F) << (7 * i) for i, b in enumerate(found[1]))
                weights.add(data[found.end() : found.end() + length])
    for name in sorted(weights):
        with (path.parent / os.fsdecode(name)).open("rb") as file:
            while chunk := file.read(1 << 20):
                digest.update(chunk)
    return digest.hexdigest()
