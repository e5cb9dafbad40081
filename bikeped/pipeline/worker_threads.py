"""A thread for calls that may take long, or never return.

Not a ThreadPoolExecutor: Python joins an executor's threads when it exits, so one call that hangs
in a driver would keep the process from ending and systemd from starting a fresh one.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import functools
import queue
import threading
import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

_Job = tuple["concurrent.futures.Future[Any]", Callable[[], Any]]


class WorkerThread:
    """One daemon thread that runs calls one after another and measures the one in progress."""

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
