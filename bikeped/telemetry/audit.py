"""The audit log: event lines appended by a thread of their own, rotated, never in the way.

`write` only puts a line aside. The thread writes what waits. When it cannot (disk full, too little
room, read-only, directory gone) it says so in `fault` and tries again until it can; meanwhile the
queue keeps the newest lines and counts the rest.
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from bikeped.config import AuditConfig
from bikeped.telemetry.builders import encode_line
from bikeped.telemetry.schema import EventHeader, EventLine

log = logging.getLogger(__name__)

MB = 1_000_000  #: bytes


class AuditLog:
    """Appends event lines to `config.path`; with no path it does nothing.

    Every new file begins with `header`, and so does every later run in the same file, or what
    follows an interruption. At `max_mb` the file becomes `<name>.1`, the former `.1` becomes `.2`,
    and so on up to `keep`. `queue_size` lines wait at most, `retry_s` is the pause after a failure,
    `sync_s` the time between two fsyncs (what a power cut may cost). `free_bytes` tells the room on
    a directory's disk.

    The thread starts with `start`. No method raises for what the disk does.
    """

    def __init__(
        self,
        config: AuditConfig,
        header: EventHeader,
        *,
        base_dir: Path = Path(),
        queue_size: int = 3000,
        retry_s: float = 5.0,
        sync_s: float = 10.0,
        free_bytes: Callable[[Path], int] | None = None,
    ) -> None:
        self._path = None if config.path is None else base_dir / config.path
        self._max_bytes = config.max_mb * MB
        self._min_free_bytes = config.min_free_mb * MB
        self._keep = config.keep
        self._header = encode_line(header)
        self._queue_size = queue_size
        self._retry_s = retry_s
        self._sync_s = sync_s
        self._free_bytes = free_bytes or (lambda directory: shutil.disk_usage(directory).free)

        self._changed = threading.Condition()  # guards the fields down to `_closing`
        self._queue: deque[bytes] = deque()
        self._dropped = 0
        self._written = 0
        self._closing = False
        self._fault: str | None = None
        self._thread: threading.Thread | None = None

        # Only the thread touches these.
        self._file: BinaryIO | None = None
        self._size = 0
        self._synced_s = 0.0

    @property
    def fault(self) -> str | None:
        """Why nothing is being written, one line with the mend; None: all is well."""
        return self._fault

    @property
    def dropped(self) -> int:
        """Lines that will never be in the log, since the start."""
        return self._dropped

    @property
    def written(self) -> int:
        """Lines in the log, headers not counted, since the start."""
        return self._written

    def start(self) -> None:
        """Starts the thread; a daemon, so that a disk that hangs cannot hold the process."""
        if self._path is not None and self._thread is None:
            self._thread = threading.Thread(target=self._run, name="audit", daemon=True)
            self._thread.start()

    def write(self, line: EventLine) -> None:
        """Puts a line aside; drops the oldest one, and counts it, when too many wait."""
        if self._path is None:
            return
        data = encode_line(line)
        with self._changed:
            if len(self._queue) >= self._queue_size:
                self._queue.popleft()
                self._dropped += 1
            self._queue.append(data)
            self._changed.notify()

    def close(self, timeout_s: float = 2.0) -> bool:
        """Writes what waits and ends the thread; False when that took longer than `timeout_s`."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is None:
            return True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._closing)
                lines = list(self._queue)
                self._queue.clear()
                closing = self._closing
            written, error = self._append(lines, sync=closing)
            with self._changed:
                self._written += written
                self._put_back(lines[written:], lost=closing)
                self._say(error)
                if closing:
                    break
                if error is not None:
                    self._changed.wait_for(lambda: self._closing, self._retry_s)
        self._close_file()

    def _put_back(self, lines: list[bytes], *, lost: bool) -> None:
        """Unwritten lines wait again, before younger ones, as far as there is room."""
        room = 0 if lost else max(0, self._queue_size - len(self._queue))
        kept = lines[max(0, len(lines) - room) :] if room else []
        self._dropped += len(lines) - len(kept)
        self._queue.extendleft(reversed(kept))

    def _say(self, error: str | None) -> None:
        """Tells a change of `fault`, once."""
        if error != self._fault:
            if error is None:
                log.info("audit: writing again")
            else:
                log.error("audit: %s", error)
        self._fault = error

    def _append(self, lines: list[bytes], *, sync: bool) -> tuple[int, str | None]:
        """Writes `lines`; how many are in the file now, and what stopped the rest."""
        written = 0
        try:
            for line in lines:
                file = self._ready(len(line))
                self._put(file, line)
                written += 1
            if self._file is not None and (
                sync or time.monotonic() - self._synced_s > self._sync_s
            ):
                os.fsync(self._file.fileno())
                self._synced_s = time.monotonic()
        except _TooFullError as exc:
            self._close_file()
            return written, str(exc)
        except OSError as exc:
            self._close_file()
            return written, (
                f"{self._path}: the audit log cannot be written ({exc.strerror or exc}): "
                "make room, or set audit.path to a directory that the service may write"
            )
        except Exception as exc:  # noqa: BLE001
            # A bug must show as a fault: a thread that has died quietly would show as nothing.
            self._close_file()
            return written, f"{self._path}: the audit log failed ({type(exc).__name__}: {exc})"
        return written, None

    def _ready(self, length: int) -> BinaryIO:
        """The open file with room for `length` more bytes, rotated where needed."""
        assert self._path is not None  # noqa: S101  # the thread runs only with a path
        if self._file is not None and self._moved_away(self._path):
            self._close_file()
        if self._file is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._check_room(self._path)
            self._open(self._path)
        else:
            self._check_room(self._path)
        if self._size + length > self._max_bytes and self._size > len(self._header):
            self._close_file()
            self._rotate(self._path)
            self._open(self._path)
        assert self._file is not None  # noqa: S101  # `_open` has set it
        return self._file

    def _open(self, path: Path) -> None:
        # Unbuffered: after a failed write nothing waits in Python that close() would try again.
        self._file = path.open("ab", buffering=0)
        self._size = os.fstat(self._file.fileno()).st_size
        if self._size and not _ends_with_newline(path):
            self._put(self._file, b"\n")  # a power cut tore the last line
        self._put(self._file, self._header)

    def _put(self, file: BinaryIO, data: bytes) -> None:
        """Writes all of `data`, or nothing: a line torn by a full disk is taken back."""
        done = 0
        try:
            while done < len(data):
                done += file.write(data[done:])
        except OSError:
            if done:
                os.ftruncate(file.fileno(), self._size)
            raise
        self._size += len(data)

    def _rotate(self, path: Path) -> None:
        for number in range(self._keep, 0, -1):
            source = path if number == 1 else _numbered(path, number - 1)
            if source.exists():
                source.replace(_numbered(path, number))

    def _check_room(self, path: Path) -> None:
        free = self._free_bytes(path.parent)
        if free < self._min_free_bytes:
            raise _TooFullError(
                f"{path}: no audit log while less than audit.min_free_mb "
                f"({self._min_free_bytes / MB:g} MB) is free: make room on the disk"
            )

    def _moved_away(self, path: Path) -> bool:
        """Whether someone removed or replaced the file; what is written there would be lost."""
        assert self._file is not None  # noqa: S101  # asked only about an open file
        try:
            return not os.path.samestat(path.stat(), os.fstat(self._file.fileno()))
        except FileNotFoundError:
            return True

    def _close_file(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()  # unbuffered: nothing is left to fail


class _TooFullError(Exception):
    """Less room than the configuration wants kept."""


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.name}.{number}")


def _ends_with_newline(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"
