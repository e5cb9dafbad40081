"""Libraries that only the workshop needs: a clear word where one is missing."""

from __future__ import annotations

from importlib.util import find_spec

from bikeped.errors import DetectorError


def need(library: str, what: str) -> None:
    """Raises DetectorError where `library` is not installed; `what` needs it."""
    if find_spec(library) is None:
        raise DetectorError(
            f"{what}: needs {library}, which is not installed; pip install 'bikeped[train]'"
        )
