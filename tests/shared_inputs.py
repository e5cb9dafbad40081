"""The real recording and model that some tests need; they lie beside the project, not in it.

What those tests expect was measured on one recording, so they check that it is that one: another
file of the same name would make them fail for no fault of the code.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

SHARED = Path(__file__).resolve().parents[2] / "shared"
MODEL = SHARED / "models" / "yolox_nano.onnx"
CLIP = SHARED / "media" / "person-bicycle-car.mp4"
_CLIP_BYTES = 4_064_257
_CLIP_START = "90275e001d804f4c669fcb81c7f41c82408e1e49b00afbc265ec653cbd95a441"
_START_BYTES = 2_000_000


def missing(*files: Path) -> str:
    """Why the tests of these files must be skipped; empty when they can run."""
    for file in files:
        if not file.is_file():
            return f"{file.name} is not in {file.parent}"
        if file == CLIP and not _is_the_clip():
            return f"{file} is not the recording that the tests were measured on; restore it"
    return ""


def _is_the_clip() -> bool:
    if CLIP.stat().st_size != _CLIP_BYTES:
        return False
    with CLIP.open("rb") as file:
        return hashlib.sha256(file.read(_START_BYTES)).hexdigest() == _CLIP_START
