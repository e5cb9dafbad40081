"""Event lines on disk: the file that `--events` writes, and the rotating audit log."""

from __future__ import annotations

import logging
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import BinaryIO

from bikeped.config.output_sections import AuditConfig
from bikeped.errors import TelemetryError
from bikeped.faults import Fault
from bikeped.telemetry.builders import encode_line
from bikeped.telemetry.schema import EventHeader, EventLine

log = logging.getLogger(__name__)

MB = 1_000_000  #: bytes


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

    def __enter__(self) -> EventWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()

    def _error(self, exc: OSError) -> TelemetryError:
        return TelemetryError(
            f"{self.partial_path}: the events cannot be written ({exc.strerror}): "
            "give --events a file in a directory that has room and that you may write"
        )


class AuditLog:
    """Appends event lines to `config.path`; does nothing without a path. No method raises OSError.

    `write` only queues a line; a thread writes. While it cannot (disk full or read-only, directory
    gone) it sets `fault` and tries again; the queue keeps the newest lines and counts the rest.

    `header` is written whenever a file is opened. At `max_mb` the file becomes `<name>.1`, the
    former `.1` becomes `.2`, and so on up to `keep`. `queue_size` bounds the lines that wait,
    `retry_s` is the pause after a failure, `sync_s` the time between two fsyncs (what a power cut
    may cost). `free_bytes` returns the free bytes on a directory's disk.
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
        self.dropped = 0  #: lines lost since the start
        self.written = 0  #: lines written since the start, without headers
        self._closing = False
        self.fault: Fault | None = None  #: why nothing can be written; None while it can
        self._thread: threading.Thread | None = None

        # Only the thread touches these.
        self._file: BinaryIO | None = None
        self._size = 0
        self._synced_s = 0.0

    def start(self) -> None:
        """Starts the thread: a daemon, so that a hung disk cannot keep the process alive."""
        if self._path is not None and self._thread is None:
            self._thread = threading.Thread(target=self._run, name="audit", daemon=True)
            self._thread.start()

    def write(self, line: EventLine) -> None:
        """Queues a line; drops and counts the oldest one when the queue is full."""
        if self._path is None:
            return
        data = encode_line(line)
        with self._changed:
            if len(self._queue) >= self._queue_size:
                self._queue.popleft()
                self.dropped += 1
            self._queue.append(data)
            self._changed.notify()

    def close(self, timeout_s: float = 2.0) -> bool:
        """Writes the queue and ends the thread; False if that takes longer than `timeout_s`."""
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
                self.written += written
                self._requeue(lines[written:], lost=closing)
                self._log_fault_change(error)
                if closing:
                    break
                if error is not None:
                    self._changed.wait_for(lambda: self._closing, self._retry_s)
        self._close_file()

    def _requeue(self, lines: list[bytes], *, lost: bool) -> None:
        """Puts unwritten lines back before newer ones, as far as there is room."""
        room = 0 if lost else max(0, self._queue_size - len(self._queue))
        kept = lines[max(0, len(lines) - room) :] if room else []
        self.dropped += len(lines) - len(kept)
        self._queue.extendleft(reversed(kept))

    def _log_fault_change(self, error: str | None) -> None:
        fault = None if error is None else Fault("audit", "audit.error", error)
        if fault != self.fault:
            if fault is None:
                log.info("audit: writing again")
            else:
                log.error("%s", fault)
        self.fault = fault

    def _append(self, lines: list[bytes], *, sync: bool) -> tuple[int, str | None]:
        """Writes `lines`; returns how many were written, and the error that stopped the rest."""
        written = 0
        try:
            for line in lines:
                file = self._open_file(len(line))
                self._write_all(file, line)
                written += 1
            if self._file is not None and (
                sync or time.monotonic() - self._synced_s > self._sync_s
            ):
                os.fsync(self._file.fileno())
                self._synced_s = time.monotonic()
        except _DiskFullError as exc:
            self._close_file()
            return written, str(exc)
        except OSError as exc:
            self._close_file()
            return written, (
                f"{self._path}: the audit log cannot be written ({exc.strerror or exc}): "
                "make room, or set audit.path to a directory that the service may write"
            )
        except Exception as exc:  # noqa: BLE001
            # A bug must become a fault: a thread that died would not be noticed.
            self._close_file()
            return written, f"{self._path}: the audit log failed ({type(exc).__name__}: {exc})"
        return written, None

    def _open_file(self, length: int) -> BinaryIO:
        """The open file, rotated first where `length` more bytes exceed its limit."""
        assert self._path is not None  # noqa: S101  # the thread runs only with a path
        if self._file is not None and self._was_replaced(self._path):
            self._close_file()
        if self._file is None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._check_free_space(self._path)
            self._open(self._path)
        else:
            self._check_free_space(self._path)
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
        whole = _whole_lines(path) if self._size else 0
        if whole < self._size:
            lost = self._size - whole
            log.warning("audit: %s: cut %d bytes of a torn last line (power cut?)", path, lost)
            os.ftruncate(self._file.fileno(), whole)
            self._size = whole
        self._write_all(self._file, self._header)

    def _write_all(self, file: BinaryIO, data: bytes) -> None:
        """Writes all of `data`, or nothing: a partial line is truncated again."""
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

    def _check_free_space(self, path: Path) -> None:
        free = self._free_bytes(path.parent)
        if free < self._min_free_bytes:
            raise _DiskFullError(
                f"{path}: no audit log while less than audit.min_free_mb "
                f"({self._min_free_bytes / MB:g} MB) is free: make room on the disk"
            )

    def _was_replaced(self, path: Path) -> bool:
        """Whether the file was removed or replaced: lines written to it would be lost."""
        assert self._file is not None  # noqa: S101  # asked only about an open file
        try:
            return not os.path.samestat(path.stat(), os.fstat(self._file.fileno()))
        except FileNotFoundError:
            return True

    def _close_file(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()  # unbuffered: nothing is left to fail


class _DiskFullError(Exception):
    """Less than `audit.min_free_mb` is free."""


def _numbered(path: Path, number: int) -> Path:
    return path.with_name(f"{path.name}.{number}")


def _whole_lines(path: Path) -> int:
    """Bytes up to the end of the last whole line: after a power cut half a line or zeros follow."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        return data.rfind(b"\n") + 1
