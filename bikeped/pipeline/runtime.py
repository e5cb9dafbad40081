"""What the service needs of its process: threads, limited log lines, messages to systemd."""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import logging
import os
import queue
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

log = logging.getLogger(__name__)

LOG_EVERY_S = 10.0

P = ParamSpec("P")
T = TypeVar("T")

_Job = tuple["concurrent.futures.Future[Any]", Callable[[], Any]]


class WorkerThread:
    """One daemon thread that runs calls one after another and measures the one in progress.

    Not a ThreadPoolExecutor: Python joins an executor's threads when it exits, so one call that
    hangs in a driver would keep the process from ending and systemd from starting a fresh one.
    """

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._busy_since_s: float | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(
        self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> asyncio.Future[T]:
        """Calls `function` in the thread; the future is the running event loop's."""
        future: concurrent.futures.Future[T] = concurrent.futures.Future()
        self._jobs.put((future, functools.partial(function, *args, **kwargs)))
        return asyncio.wrap_future(future)

    def busy_s(self, now_s: float) -> float:
        """Seconds since the call in progress began; 0 when there is none."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else max(0.0, now_s - since_s)

    async def close(self, timeout_s: float = 2.0) -> bool:
        """Ends the thread after its queued calls; False when it hangs and is left behind."""
        self._jobs.put(None)
        await asyncio.to_thread(self._thread.join, timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            future, call = job
            if not future.set_running_or_notify_cancel():
                continue
            self._busy_since_s = self._clock()
            try:
                result = call()
            except BaseException as error:  # noqa: BLE001 - it belongs to the caller
                self._busy_since_s = None
                future.set_exception(error)
            else:
                self._busy_since_s = None
                future.set_result(result)
                del result
            # Frees the call with its frame before waiting for the next one.
            del future, call, job


class RateLimitedLogger:
    """Logs at most one line a subject every `LOG_EVERY_S`, and how many it suppressed.

    For events that may come thirty times a second for months.
    """

    def __init__(self, log: logging.Logger, clock: Callable[[], float] = time.monotonic) -> None:
        self._log, self._clock = log, clock
        self._logged: dict[str, tuple[float, int]] = {}

    def warn(self, subject: str, text: str) -> None:
        """A warning of an expected event."""
        suppressed = self._due(subject)
        if suppressed is not None:
            self._log.warning("%s%s", text, suppressed)

    def failure(self, subject: str, error: BaseException) -> None:
        """An unexpected error, with its traceback."""
        suppressed = self._due(subject)
        if suppressed is not None:
            self._log.error("%s: %s%s", subject, error, suppressed, exc_info=error)

    def _due(self, subject: str) -> str | None:
        now_s = self._clock()
        logged_s, suppressed = self._logged.get(subject, (None, 0))
        if logged_s is not None and now_s - logged_s < LOG_EVERY_S:
            self._logged[subject] = (logged_s, suppressed + 1)
            return None
        self._logged[subject] = (now_s, 0)
        return f" (and {suppressed} more since the last such line)" if suppressed else ""


def notify(*fields: str) -> None:
    """sd_notify(3): one datagram to $NOTIFY_SOCKET; without a service manager it does nothing."""
    name = os.environ.get("NOTIFY_SOCKET")
    if not name:
        return
    # An abstract socket is written with an @ and addressed with a NUL.
    address = "\0" + name[1:] if name.startswith("@") else name
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sending:
            sending.setblocking(False)
            sending.sendto("\n".join(fields).encode(), address)
    except OSError as error:  # never a reason to stop the service
        log.debug("systemd: %s", error)
