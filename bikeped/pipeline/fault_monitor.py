"""What is wrong now: ages of frames and answers, failing stages, hanging calls.

The light must not trust a decision that is older than the camera or the detector may be silent;
single bad frames between good ones are no fault. What each fault does is in `bikeped.faults`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from bikeped.faults import Effect, Fault
from bikeped.pipeline.feed import Feed
from bikeped.pipeline.pace import Pace
from bikeped.pipeline.picture_monitor import NO_CHECKS, PictureChecks
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
    hang_after_s: float = 15.0  #: a detector that does not return, or only fails: end
    tick_s: float = 0.1  #: between two checks
    close_s: float = 2.0  #: how long a thread may take to end


DEFAULT_LIMITS = Limits()


@dataclass(frozen=True)
class _Failure:
    """The first fault of an unbroken run of failures, so that one run is one fault."""

    fault: Fault
    began_s: float


class FaultMonitor:
    """Collects the faults of a pipeline; a recording has those of its pictures and its detector.

    `sources` are asked for faults of other parts: a fault made there reaches light and health as
    the table in `bikeped.faults` says.
    """

    def __init__(
        self, feed: Feed, limits: Limits, sources: Sequence[Callable[[], Fault | None]] = ()
    ) -> None:
        self._feed, self._limits = feed, limits
        self._sources = tuple(sources)
        self._failures: dict[str, _Failure] = {}  # by code
        self._answered_s = -math.inf  # capture time of the newest processed frame
        self._pace = Pace(limits.silent_after_s / 2)
        self.picture = NO_CHECKS  #: of the newest processed frame

    def record(self, code: str, source: str, detail: str | None, now_s: float) -> None:
        """What a stage did with a frame: it failed as `detail` says, or did well (None)."""
        if detail is None:
            self._failures.pop(code, None)
        elif code not in self._failures:
            self._failures[code] = _Failure(Fault(source, code, detail), now_s)

    def processed(
        self, captured_s: float, checks: PictureChecks = NO_CHECKS, now_s: float | None = None
    ) -> None:
        """The frame captured at `captured_s` led to a decision; `checks`: of its picture."""
        self._answered_s, self.picture = captured_s, checks
        if now_s is not None:
            self._pace.answered(now_s, now_s - captured_s)

    def faults(self, now_s: float) -> tuple[Fault, ...]:
        """The faults that the light shows; empty when the decision holds."""
        if not self._feed.live:
            checks = self._from_checks(Effect.FAULT, Effect.WITHHELD)
            return (*checks, *self._from_sources(Effect.WITHHELD))
        error, limits = self._feed.error, self._limits
        faults: list[Fault | None] = [
            _age_fault("camera", "frame", self._feed.age_s(now_s), limits.stale_after_s),
            _age_fault("detector", "answer", now_s - self._answered_s, limits.silent_after_s),
            *self._failed("camera.frame_size"),
            None if error is None else Fault("camera", "camera.error", str(error)),
            *self._from_sources(Effect.FAULT),
            *self._from_checks(Effect.FAULT),
        ]
        if any(faults):  # the cause, where a stage fails; one bad frame among good ones is no fault
            faults += self._failed("camera.undecodable", "detector.error")
        faults += self._from_sources(Effect.WITHHELD)
        faults += self._from_checks(Effect.WITHHELD)
        return tuple(fault for fault in faults if fault is not None)

    def notices(self) -> tuple[Fault, ...]:
        """The faults that leave the light as decided."""
        pace = self._pace.faults
        return (*self._from_checks(Effect.NOTICE), *pace, *self._from_sources(Effect.NOTICE))

    def _failed(self, *codes: str) -> list[Fault]:
        return [self._failures[code].fault for code in codes if code in self._failures]

    def _from_checks(self, *effects: Effect) -> Iterable[Fault]:
        return (fault for fault in self.picture.faults() if fault.kind.effect in effects)

    def _from_sources(self, effect: Effect) -> Iterable[Fault]:
        faults = (source() for source in self._sources)
        return (fault for fault in faults if fault is not None and fault.kind.effect is effect)

    def check_stages(self, now_s: float, workers: Sequence[WorkerThread]) -> None:
        """Raises StageHangError for a stage that hangs; asks for a new capture when none decodes.

        `workers` run the decoder and the detector.
        """
        if (problem := self._feed.replace_hung(now_s)) is not None:
            raise StageHangError(Fault("camera", "camera.hang", problem))
        self._pace.check(now_s, self._feed)
        limit_s, busy_s = self._limits.hang_after_s, max(w.busy_s(now_s) for w in workers)
        hung = [("detector.hang", busy_s, "has not returned")]
        if (failing := self._failures.get("detector.error")) is not None:
            # A GPU that has failed once may fail until the process ends.
            lasted_s = now_s - failing.began_s
            hung.append(("detector.failing", lasted_s, failing.fault.detail))
        for code, lasted_s, text in hung:
            if lasted_s > limit_s:
                raise StageHangError(Fault("detector", code, f"{text} for {limit_s:g} s"))
        undecodable = self._failures.get("camera.undecodable")
        if undecodable is not None and now_s - undecodable.began_s > RESTART_AFTER_S:
            self._failures["camera.undecodable"] = _Failure(undecodable.fault, now_s)
            self._feed.restart()


def _age_fault(source: str, what: str, age_s: float, limit_s: float) -> Fault | None:
    """`camera.no_frame` or `detector.no_answer` for none yet or an old one, or `future_time`."""
    if age_s < -limit_s:
        problem = f"no {what} with a usable time: the newest lies in the future"
        return Fault(source, f"{source}.future_time", problem)
    if age_s <= limit_s:  # false for a NaN age, so that it is a fault, too
        return None
    problem = f"no {what} yet" if age_s == math.inf else f"no {what} for more than {limit_s:g} s"
    return Fault(source, f"{source}.no_{what}", problem)
