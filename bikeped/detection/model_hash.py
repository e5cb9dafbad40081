"""The SHA-256 of a model file: its identity in messages, and the check of `detection.sha256`."""

from __future__ import annotations

import hashlib
from pathlib import Path

from bikeped.errors import DetectorError

_CHUNK = 1 << 20


def sha256_of(path: Path) -> str:
    """The file's SHA-256 in lower-case hexadecimal, read in chunks of 1 MiB.

    Raises `DetectorError` where the file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(_CHUNK):
                digest.update(chunk)
    except FileNotFoundError:
        raise DetectorError(
            f"{path}: no such model file; correct detection.model or put the file there"
        ) from None
    except OSError as error:
        raise DetectorError(f"{path}: cannot read the model file: {error.strerror}") from error
    return digest.hexdigest()


def verify_sha256(path: Path, expected: str | None) -> str:
    """The file's hash; raises `DetectorError` where `detection.sha256` expects another."""
    actual = sha256_of(path)
    if expected is not None and expected.lower() != actual:
        raise DetectorError(
            f"{path}: SHA-256 is {actual} but detection.sha256 expects {expected.lower()}; "
            "put the right model there or correct detection.sha256"
        )
    return actual
