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


def model_file(model: str, base_dir: Path) -> Path:
    """The file that `detection.model` names; a relative one starts from `base_dir`."""
    return BUNDLED_FILE if model == BUNDLED else base_dir / Path(model).expanduser()
