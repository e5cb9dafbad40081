"""Log lines through a bounded queue, so that a blocked standard error blocks no other thread.

A pipe without a reader, or a journal that hangs, stops a `write` for ever. Only one daemon thread
of this module writes; a logging call puts its line into a queue, and drops it when that is full.
When there is room again, one line names how many were lost.
"""

from __future__ import annotations

import io
import logging
import logging.handlers
import os
import queue
import threading
import time
from typing import Any

#: Lines that wait: minutes of a service in trouble, and well below a megabyte.
LINES = 2000
#: How long the end of the process waits for the last lines.
FLUSH_S = 0.5
#: A line is cut here: a traceback of thousands of characters must not fill the memory.
_LONGEST = 16_384


class QueuedLog(logging.handlers.QueueHandler):
    """Takes the place of `handler`, whose format and stream it keeps; never waits for the stream.

    The stream's descriptor is written to directly: a thread that hangs in Python's own
    `sys.stderr` would hold its lock and keep the interpreter from ending.
    """

    def __init__(self, handler: logging.StreamHandler[Any], lines: int = LINES) -> None:
        self._lines: queue.Queue[str] = queue.Queue(lines)
        super().__init__(self._lines)
        self.setFormatter(handler.formatter)
        self.setLevel(handler.level)
        self.dropped = 0  #: lines lost since the start
        self._stream, self._descriptor = handler.stream, _own_descriptor(handler.stream)
        threading.Thread(target=self._write_lines, name="log", daemon=True).start()

    def prepare(self, record: logging.LogRecord) -> Any:
        return self.format(record)[:_LONGEST]

    def enqueue(self, record: Any) -> None:
        try:
            self._lines.put_nowait(record)
        except queue.Full:
            self.dropped += 1

    def flush(self) -> None:
        """Waits until all lines are written, at most FLUSH_S; `logging.shutdown` calls it."""
        end_s = time.monotonic() + FLUSH_S
        with self._lines.all_tasks_done:
            while self._lines.unfinished_tasks and (rest_s := end_s - time.monotonic()) > 0:
                self._lines.all_tasks_done.wait(rest_s)

    def _write_lines(self) -> None:
        named = 0
        while True:
            line = self._lines.get()
            lost = self.dropped - named
            if lost:
                named += lost
                line = f"{lost} log lines were lost: standard error did not take them\n{line}"
            try:
                self._write(f"{line}\n")
            except (OSError, ValueError):  # the reader is gone, the disk full, the stream closed
                self.dropped += 1
                named += 1
            finally:
                self._lines.task_done()

    def _write(self, text: str) -> None:
        if self._descriptor is None:
            self._stream.write(text)
            self._stream.flush()
            return
        data = memoryview(text.encode("utf-8", "backslashreplace"))
        while data:
            data = data[os.write(self._descriptor, data) :]


def log_through_queue() -> None:
    """Puts a queue before every stream that the root logger writes to; again: no effect."""
    root = logging.getLogger()
    for handler in root.handlers[:]:
        if type(handler) is logging.StreamHandler:
            root.addHandler(QueuedLog(handler))
            root.removeHandler(handler)
            logging.captureWarnings(True)  # else Python's own warnings are written directly


def dropped_lines() -> int:
    """Log lines lost since the start."""
    return sum(h.dropped for h in logging.getLogger().handlers if isinstance(h, QueuedLog))


def _own_descriptor(stream: Any) -> int | None:
    """A copy of the stream's file descriptor; None where it has none."""
    try:
        return os.dup(stream.fileno())
    except (OSError, ValueError, AttributeError, io.UnsupportedOperation):
        return None
