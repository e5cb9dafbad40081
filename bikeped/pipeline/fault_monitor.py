"""What is wrong now: ages of frames and answers, failing stages, hanging calls.

The light must not trust a decision that is older than the camera or the detector may be silent;
single bad frames between good ones are no fault. What each fault does is in `bikeped.faults`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from bikeped.errors import GeometryError
from bikeped.faults import Effect, Fault
from bikeped.pipeline.feed import Feed
from bikeped.pipeline.runtime import WorkerThread

#: Frames that do not decode for this long: the camera is opened anew.
RESTART_AFTER_S = 5.0


class StageHangError(Exception):
    """A stage that cannot be ended does not return, or only fails: only a new process helps."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(str(fault))
        self.fault = fault


@dataclass(frozen=True)
class Limits:
    """Times that lead to a fault, in seconds."""

    stale_after_s: float = 0.5  #: no frame: FAULT
    silent_after_s: float = 0.5  #: no answer of the detector: FAULT
    hang_after_s: float = 15.0  #: a call that does not return, a detector that only fails: end
    tick_s: float = 0.1  #: between two checks
    close_s: float = 2.0  #: how long a thread may take to end


DEFAULT_LIMITS = Limits()

#: Code of the fault of an age -> its source, and what is missing.
_AGED = {"camera.no_frame": ("camera", "frame"), "detector.no_answer": ("detector", "answer")}


@dataclass(frozen=True)
class _Since:
    """The first fault of an unbroken run of failures, so that one run is one fault."""

    fault: Fault
    began_s: float


class FaultMonitor:
    """Collects the faults of a live pipeline; a recording has none.

    `sources` are asked for faults of other parts: a fault made there reaches light and health as
    the table in `bikeped.faults` says.
    """

    def __init__(
        self, feed: Feed, limits: Limits, sources: Sequence[Callable[[], Fault | None]] = ()
    ) -> None:
        self._feed, self._limits = feed, limits
        self._sources = tuple(sources)
        self._frame_size: Fault | None = None
        self._undecodable: _Since | None = None
        self._failing: _Since | None = None
        self._answered_s: float | None = None

    def decoded(self) -> None:
        self._undecodable = None

    def not_decoded(self, error: Exception, now_s: float) -> None:
        if self._undecodable is None:
            detail = f"frames do not decode ({error})"
            self._undecodable = _Since(Fault("camera", "camera.undecodable", detail), now_s)

    def sized(self, error: GeometryError | None) -> None:
        """A frame has the configured proportions (None), or `error` says why not."""
        self._frame_size = (
            None if error is None else Fault("geometry", "camera.frame_size", str(error))
        )

    def answered(self) -> None:
        self._failing = None

    def not_answered(self, error: Exception, now_s: float) -> None:
        if self._failing is None:
            self._failing = _Since(Fault("detector", "detector.error", str(error)), now_s)

    def processed(self, captured_s: float) -> None:
        """The frame captured at `captured_s` led to a decision."""
        self._answered_s = captured_s

    def faults(self, now_s: float) -> tuple[Fault, ...]:
        """The faults with which the light must show FAULT; empty when the decision holds."""
        if not self._feed.live:
            return ()
        error, limits = self._feed.error(), self._limits
        faults: list[Fault | None] = [
            _age_fault("camera.no_frame", now_s, self._feed.newest_s(now_s), limits.stale_after_s),
            _age_fault("detector.no_answer", now_s, self._answered_s, limits.silent_after_s),
            self._frame_size,
            None if error is None else Fault("camera", "camera.error", error),
            *self._from_sources(Effect.FAULT),
        ]
        if any(faults):  # the cause, where a stage fails; one bad frame among good ones is no fault
            faults += [run.fault for run in (self._undecodable, self._failing) if run is not None]
        return tuple(fault for fault in faults if fault is not None)

    def notices(self) -> tuple[Fault, ...]:
        """The faults of other parts that leave the light as decided."""
        return tuple(self._from_sources(Effect.NOTICE))

    def _from_sources(self, effect: Effect) -> Iterable[Fault]:
        faults = (source() for source in self._sources)
        return (fault for fault in faults if fault is not None and fault.kind.effect is effect)

    def check_stages(self, now_s: float, workers: Sequence[WorkerThread]) -> None:
        """Raises StageHangError for a stage that hangs; asks for a new capture when none decodes.

        `workers` run the decoder and the detector.
        """
        limit_s = self._limits.hang_after_s
        if self._feed.hung_s(now_s) > limit_s:
            detail = f"a read has not returned for {limit_s:g} s"
            raise StageHangError(Fault("camera", "camera.hang", detail))
        if max(worker.busy_s(now_s) for worker in workers) > limit_s:
            detail = f"has not returned for {limit_s:g} s"
            raise StageHangError(Fault("detector", "detector.hang", detail))
        # A GPU that has failed once may fail until the process ends.
        if self._failing is not None and now_s - self._failing.began_s > limit_s:
            detail = f"{self._failing.fault.detail} (for {limit_s:g} s)"
            raise StageHangError(Fault("detector", "detector.failing", detail))
        run = self._undecodable
        if run is not None and now_s - run.began_s > RESTART_AFTER_S:
            self._undecodable = _Since(run.fault, now_s)
            self._feed.restart()


def _age_fault(code: str, now_s: float, newest_s: float | None, limit_s: float) -> Fault | None:
    """The fault of a newest frame or answer: `code` if missing or too old, or a future time."""
    component, what = _AGED[code]
    age_s = math.nan if newest_s is None else now_s - newest_s
    if age_s < -limit_s:
        problem = f"no {what} with a usable time: the newest lies in the future"
        return Fault(component, f"{component}.future_time", problem)
    if age_s <= limit_s:  # false for a NaN age, so that it is a fault, too
        return None
    problem = f"no {what} yet" if newest_s is None else f"no {what} for more than {limit_s:g} s"
    return Fault(component, code, problem)
