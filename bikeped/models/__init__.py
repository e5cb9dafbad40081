"""The small detector that comes with bikeped: for demo, self-test and pixel conformance.

It has seen drawn streets only; what it is worth there, and what it must not be used for, stands in
`small.md` beside it.
"""

from __future__ import annotations

from pathlib import Path

#: `detection.model: bundled` names the model that comes with bikeped.
BUNDLED = "bundled"
NOT_FOR_STREETS = (
    "the bundled model knows drawn streets only; it must not warn anybody on a real one"
)
BUNDLED_FILE = Path(__file__).with_name("small.onnx")
#: The same network in eight bits, quicker on a processor.
BUNDLED_INT8_FILE = Path(__file__).with_name("small-int8.onnx")


def model_file(model: str, base_dir: Path, *, on_cpu: bool = False) -> Path:
    """The file that `detection.model` names; a relative one starts from `base_dir`.

    `on_cpu`: it will run on the processor, not on a GPU.
    """
    if model == BUNDLED:
        return BUNDLED_INT8_FILE if on_cpu else BUNDLED_FILE
    return base_dir / Path(model).expanduser()
