"""One measured property of the picture, and how long it has been beyond its limit."""

from __future__ import annotations

import math
from dataclasses import dataclass

_RELEASE_S = 1.0  #: a verdict ends when its value has been good for this long


@dataclass(frozen=True)
class Verdict:
    """A property of the picture with its number; `active` is what a `Fault` is made of."""

    code: str  #: a key of `bikeped.faults.FAULT_KINDS`
    value: float  #: as measured now; NaN while it cannot be measured
    threshold: float  #: the value that may not be reached, at this site and now
    hold_s: float  #: active when the threshold has been reached for this long
    active: bool
    detail: str  #: one line for people, without age or counter

    @property
    def beyond(self) -> bool:
        """Whether the threshold is reached now; never with NaN."""
        return self.value >= self.threshold


class Hold:
    """Makes verdicts of one code from values; the larger value is the worse one."""

    def __init__(self, code: str, hold_s: float, detail: str) -> None:
        self._code, self._hold_s, self._detail = code, hold_s, detail
        self.restart()

    def restart(self) -> None:
        """Forgets how long the value has been beyond its threshold: time jumped."""
        self._good_s = math.nan  #: since when the value has been good
        self._bad_s = math.nan  #: since when it has been beyond
        self._active = False

    def update(self, value: float, threshold: float, time_s: float) -> Verdict:
        """The verdict on `value` at `time_s`, which must not run backwards.

        A NaN value neither starts nor ends a verdict.
        """
        if value >= threshold:
            self._good_s = math.nan
            if math.isnan(self._bad_s):
                self._bad_s = time_s
            self._active = self._active or time_s - self._bad_s >= self._hold_s
        elif value < threshold:
            if not self._active:
                self._bad_s = math.nan
            elif math.isnan(self._good_s):
                self._good_s = time_s
            elif time_s - self._good_s >= _RELEASE_S:
                self._active, self._bad_s = False, math.nan
        return Verdict(self._code, value, threshold, self._hold_s, self._active, self._detail)
