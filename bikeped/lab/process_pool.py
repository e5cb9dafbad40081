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
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")
#: Called with the number of finished steps.
ProgressCallback = Callable[[int], None]

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


def no_progress(done: int) -> None:
    """A ProgressCallback that does nothing."""


def run_jobs(
    job: Callable[P, T],
    arguments: Sequence[tuple[Any, ...]],
    processes: int = 1,
    progress: ProgressCallback = no_progress,
) -> list[T]:
    """`job(*a)` for each `a` of `arguments`, in their order; started in that order, in `processes`
    processes (one: in this process)."""
    if processes == 1 or len(arguments) < 2:
        results = []
        for given in arguments:
            results.append(job(*given))  # type: ignore[call-arg]
            progress(len(results))
        return results
    with worker_pool(min(processes, len(arguments))) as pool:
        futures = [pool.submit(job, *given) for given in arguments]  # type: ignore[call-arg]
        for count, future in enumerate(as_completed(futures), 1):
            future.result()  # an error ends the whole
            progress(count)
        return [future.result() for future in futures]


class _State:
    """State of one worker process."""

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
