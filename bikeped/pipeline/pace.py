"""Whether frames and answers keep their pace: degraded is named, the light is left alone."""

from __future__ import annotations

from collections import deque

from bikeped.faults import Fault
from bikeped.pipeline.feed import Feed

WINDOW_S = 1.0  #: over which rate and latency are taken
SLOW_SHARE = 0.5  #: of the camera's rate; below it the camera is slow
STEADY_SHARE = 0.6  #: of it; from here on it is not
STEADY_S = 1.0  #: how long a good pace must last before a notice ends


class Pace:
    """Notices of a live pipeline: `camera.slow` and `service.slow`.

    `budget_s` is how old a frame may be when its decision is shown, at the 99th percentile (which
    is the highest of a second's frames). A notice keeps the number that it began with, so that it
    is logged once. Times are seconds on one monotonic clock.
    """

    def __init__(self, budget_s: float) -> None:
        self._budget_s = budget_s
        self._ages: deque[tuple[float, float]] = deque(maxlen=512)  # when shown, and how old then
        self._notices: dict[str, tuple[Fault, float]] = {}  # by code, with the last bad moment

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The notices of now."""
        return tuple(fault for fault, _ in self._notices.values())

    def answered(self, now_s: float, age_s: float) -> None:
        """A decision was made from a frame of this age."""
        self._ages.append((now_s, age_s))

    def check(self, now_s: float, feed: Feed) -> None:
        """Takes stock; call it several times a second."""
        rate = feed.rate(now_s, WINDOW_S)
        if rate is not None:
            per_s, nominal = rate
            share = STEADY_SHARE if "camera.slow" in self._notices else SLOW_SHARE
            text = f"{per_s:.3g} frames/s arrive, not {nominal:g}: is it dark, is the network slow?"
            slow = Fault("camera", "camera.slow", text)
            self._judge(slow, per_s < share * nominal, now_s)
        ages = sorted(age_s for at_s, age_s in self._ages if now_s - at_s <= WINDOW_S)
        if ages:
            text = (
                f"decisions come {ages[-1] * 1e3:.0f} ms after the picture at the 99th percentile"
            )
            late = Fault("service", "service.slow", f"{text}, over {self._budget_s * 1e3:.0f} ms")
            # One late frame among many is no lasting condition.
            self._judge(late, ages[-2 if len(ages) > 1 else -1] > self._budget_s, now_s)

    def _judge(self, fault: Fault, bad: bool, now_s: float) -> None:
        known = self._notices.get(fault.code)
        if bad:
            self._notices[fault.code] = (known[0] if known else fault, now_s)
        elif known and now_s - known[1] >= STEADY_S:
            del self._notices[fault.code]
