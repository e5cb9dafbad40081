"""The event file that `--events` writes."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from bikeped.errors import TelemetryError
from bikeped.telemetry.builders import encode_line
from bikeped.telemetry.schema import EventHeader, EventLine

Writer = TypeVar("Writer", bound="EventWriter")


class EventWriter:
    """Writes the header and then one line a frame to `<name>.partial`; `close` renames it.

    A file of the final name is always complete. As a context manager it closes after success and
    leaves the partial file after an exception. Raises TelemetryError when it cannot write.
    """

    def __init__(self, path: Path | str, header: EventHeader) -> None:
        self.path = Path(path)
        self.partial_path = self.path.with_name(self.path.name + ".partial")
        try:
            self._file = self.partial_path.open("wb")
        except OSError as exc:
            raise self._error(exc) from exc
        self.write(header)

    def write(self, line: EventHeader | EventLine) -> None:
        """Appends one line."""
        try:
            self._file.write(encode_line(line))
        except OSError as exc:
            raise self._error(exc) from exc

    def close(self) -> None:
        """Completes the file and renames it; again is harmless."""
        if self._file.closed:
            return
        try:
            with self._file:
                self._file.flush()
                os.fsync(self._file.fileno())
            self.partial_path.replace(self.path)
        except OSError as exc:
            raise self._error(exc) from exc

    def abandon(self) -> None:
        """Closes the file and leaves it under its partial name."""
        try:
            self._file.close()
        except OSError as exc:
            raise self._error(exc) from exc

    def __enter__(self: Writer) -> Writer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:
            self.abandon()

    def _error(self, exc: OSError) -> TelemetryError:
        return TelemetryError(
            f"{self.partial_path}: the events cannot be written ({exc.strerror}): "
            "give --events a file in a directory that has room and that you may write"
        )
