"""Worker processes that use one core each and end when the user interrupts.

Ctrl-C reaches every process of a terminal. Left alone, workers die in the middle of their queues,
and `ProcessPoolExecutor` (of Python 3.10 and 3.11) may then wait for ever. So a worker lets an
interruption end its job, refuses the jobs after it, and leaves in good order.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

#: Environment that keeps numerical libraries on one core.
_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
_SIGINT = {signal.SIGINT}


class WorkerPool:
    """What `worker_pool` yields: `submit` as an executor has it."""

    def __init__(self, executor: ProcessPoolExecutor) -> None:
        self._executor = executor

    def submit(self, job: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        """Runs `job` in one of the processes."""
        # Submitting may start a process: until it is ready, an interruption has to wait.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGINT)
        try:
            return self._executor.submit(functools.partial(_run, job, *args, **kwargs))
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def worker_pool(processes: int) -> Iterator[WorkerPool]:
    """Processes started afresh: a fork would copy the locks of our threads."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    executor = ProcessPoolExecutor(
        processes, multiprocessing.get_context("spawn"), initializer=_begin
    )
    try:
        yield WorkerPool(executor)
    finally:
        executor.shutdown(cancel_futures=True)
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


class _State:
    """Of one worker process."""

    busy = False
    interrupted = False


def _begin() -> None:
    signal.signal(signal.SIGINT, _interrupt)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGINT)


def _interrupt(number: int, frame: object) -> None:
    _State.interrupted = True
    if _State.busy:
        raise KeyboardInterrupt


def _run(job: Callable[..., T], *args: object, **kwargs: object) -> T:
    if _State.interrupted:
        raise KeyboardInterrupt
    _State.busy = True
    try:
        return job(*args, **kwargs)
    finally:
        _State.busy = False
