"""Is the detector blind? Known answers of a check picture, and motion on the road without any.

Pure: told of every answer and of every check, with media time in seconds, it says when the next
check is due and what its verdicts are. A blind period teaches nothing: what is known only grows
from answers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from bikeped.faults import Fault
from bikeped.geometry.boxes import iou_matrix
from bikeped.monitor.road_motion import JUMP_S
from bikeped.monitor.verdicts import Verdict
from bikeped.types import Detections

CODE = "detector.blind"
CHECK_EVERY_S = 20.0
RECHECK_S = 2.0  #: after a check that failed
FAILURES = 2  #: in a row
MATCH_IOU = 0.4
SILENT_S = 45.0  #: without any detection
MOTION_S, MOVERS = 8.0, 2  #: so much motion meanwhile, and of so many things at least

_MISSED = "The model misses what it found in the check picture; check the model and its device."
_MOVES = "Much moves on the road, and the model finds nothing; check the model and the camera."


def finds_again(known: Detections, found: Detections) -> bool:
    """Whether each known object has a box of its kind that overlaps it by `MATCH_IOU`."""
    same = known.kind[:, None] == found.kind[None, :]
    overlap = iou_matrix(known.box_px, found.box_px)
    return bool((same & (overlap >= MATCH_IOU)).any(axis=1).all())


@dataclass(frozen=True)
class DetectorNumbers:
    """What the verdicts rest on; None where there has been none yet."""

    check_age_s: float | None  #: since the last check's answer
    check_passes: int
    check_failures: int
    motion_s: float  #: within the last `road_motion.WINDOW_S`
    detection_age_s: float | None  #: since the newest detection of any kind


class DetectorCheck:
    """Keeps what the verdicts on one detector need. Times are media time and do not run back."""

    def __init__(self) -> None:
        self._failed_in_row = self._passes = self._failures = 0
        self._checked_s = math.nan
        self._next_s = math.nan
        self._since_s = math.nan  # begin of the watch, or of its newest part
        self._detected_s = math.nan
        self._time_s = math.nan
        self._motion_s, self._movers = 0.0, 0
        self._ignores_motion = False

    def answered(self, count: int, time_s: float, motion_s: float = 0.0, movers: int = 0) -> None:
        """The model found `count` road users in the frame of `time_s`.

        `motion_s`, `movers`: as `RoadMotion.motion` returns them.
        """
        if not 0 <= time_s - self._time_s <= JUMP_S:  # also at the first
            self._since_s = time_s
        if not self._next_s <= time_s + CHECK_EVERY_S:  # also when time ran back
            self._next_s = time_s + CHECK_EVERY_S
        self._time_s, self._motion_s, self._movers = time_s, motion_s, movers
        if count:
            self._detected_s, self._ignores_motion = time_s, False
        elif self._silent_s() >= SILENT_S and movers >= MOVERS and motion_s >= MOTION_S:
            self._ignores_motion = True

    def due(self, waits_s: float = 0.0) -> bool:
        """Whether a check should be made now, at the latest `waits_s` after its time."""
        return self._time_s - self._next_s >= waits_s

    def checked(self, passed: bool) -> None:
        """What came of a check, with the newest frame's time."""
        self._checked_s = self._time_s
        if passed:
            self._failed_in_row = 0
            self._passes += 1
            # Nothing moves any more, and the model finds people: the street is empty.
            if self._motion_s < MOTION_S:
                self._ignores_motion = False
        else:
            self._failed_in_row += 1
            self._failures += 1
        self._next_s = self._time_s + (CHECK_EVERY_S if passed else RECHECK_S)

    @property
    def trusted(self) -> bool:
        """Whether the model may be learnt from: no check has failed, no motion was ignored."""
        return not (self._failed_in_row or self._ignores_motion)

    @property
    def verdict(self) -> Verdict:
        """Failures in a row or seconds of motion, the worse, as a share of what may not be."""
        failed, moved = self._failed_in_row / FAILURES, 0.0
        if self._silent_s() >= SILENT_S and self._movers >= MOVERS:
            moved = self._motion_s / MOTION_S
        missed = failed >= 1
        active = missed or self._ignores_motion
        text = _MISSED if missed else _MOVES
        return Verdict(CODE, max(failed, moved), 1.0, 0.0, active, text)

    @property
    def fault(self) -> Fault | None:
        """The fault to report, if there is one."""
        verdict = self.verdict
        return Fault("detector", CODE, verdict.detail) if verdict.active else None

    @property
    def numbers(self) -> DetectorNumbers:
        """The numbers for health and metrics."""

        def age_s(since_s: float) -> float | None:
            age_s = self._time_s - since_s
            return max(0.0, age_s) if math.isfinite(age_s) else None

        return DetectorNumbers(
            age_s(self._checked_s),
            self._passes,
            self._failures,
            self._motion_s,
            age_s(self._detected_s),
        )

    def _silent_s(self) -> float:
        """Seconds watched without a detection: a pause of the camera does not count."""
        since_s = self._since_s
        if self._detected_s > since_s:
            since_s = self._detected_s
        return self._time_s - since_s
