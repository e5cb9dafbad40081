"""Every fault that the service can report, and what each one does.

A `Fault` is made where its cause is known. What follows from it (what the light shows, which
component's health it belongs to, how it clears, whether the process ends) stands once, in
`FAULT_KINDS`. A new fault is one line of that table and one place that makes it;
docs/faults-reference.md is made from the table.
"""

from __future__ import annotations

import enum
import logging
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Literal

#: Exit status for "start a fresh process" (EX_TEMPFAIL of sysexits.h); systemd restarts on it.
EXIT_RESTART = 75

Component = Literal["camera", "picture", "detector", "light", "speaker", "audit", "service"]


class Effect(enum.Enum):
    """What a fault does to the light."""

    FAULT = "FAULT"  #: the decision cannot be trusted: the light shows FAULT
    WITHHELD = "FAULT for IDLE and SAFE"  #: people may be missed: blue and green are not shown
    NOTICE = "none"  #: reported only (degraded): the decision still holds


class Severity(enum.IntEnum):
    """How a fault is logged; the values are those of `logging`."""

    INFO = logging.INFO  #: part of every start and recovery
    WARNING = logging.WARNING  #: the crossing is still watched and warned
    ERROR = logging.ERROR  #: the crossing is not warned, or not fully
    CRITICAL = logging.CRITICAL  #: this process cannot recover


class Clears(enum.Enum):
    """What ends a fault once its cause is gone."""

    GOOD_FRAMES = "feedback.recover_frames good frames in a row"
    AT_ONCE = "when the cause is gone"
    RESTART = "a new process"


@dataclass(frozen=True)
class FaultKind:
    """One row of the table: what a fault of this code does and means."""

    code: str  #: component and cause, as `camera.no_frame`; programs may rely on it
    component: Component  #: whose health it belongs to
    meaning: str  #: one plain sentence for people
    effect: Effect
    severity: Severity
    clears: Clears
    exit_status: int | None = None  #: of the process, where the fault ends it


#: The light shows FAULT until good frames come again.
_stops = partial(FaultKind, effect=Effect.FAULT, severity=Severity.ERROR, clears=Clears.GOOD_FRAMES)
_begins = partial(_stops, severity=Severity.INFO)
#: Only a new process helps: the light shows FAULT and the service ends.
_ends = partial(_stops, severity=Severity.CRITICAL, clears=Clears.RESTART, exit_status=EXIT_RESTART)
#: The light shows FAULT in place of blue and green.
_withholds = partial(_stops, effect=Effect.WITHHELD, clears=Clears.AT_ONCE)
#: Reported, while the light goes on showing the decision.
_minor = partial(FaultKind, effect=Effect.NOTICE, severity=Severity.WARNING, clears=Clears.AT_ONCE)

FAULT_KINDS: dict[str, FaultKind] = {
    kind.code: kind
    for kind in (
        _stops("camera.no_frame", "camera", "No frame came for camera.stale_after_s."),
        _stops("camera.future_time", "camera", "The newest frame's time lies in the future."),
        _stops("camera.error", "camera", "The camera cannot be opened or read."),
        _stops("camera.undecodable", "camera", "Frames arrive, but none can be decoded."),
        _stops("camera.frame_size", "camera", "The frame does not fit the configured camera."),
        _stops(
            "camera.moved", "camera", "The camera has moved since it was aligned; align it again."
        ),
        _ends(
            "camera.hang", "camera", "A read does not return, and the camera cannot be opened anew."
        ),
        _stops("picture.frozen", "picture", "The same pictures come again and again."),
        _stops("picture.black", "picture", "The picture is black."),
        _stops("picture.white", "picture", "The picture is white."),
        _stops("picture.one_colour", "picture", "The picture has one colour."),
        _stops("picture.covered", "picture", "Much of what the picture showed is hidden or gone."),
        _withholds("picture.blurred", "picture", "The whole picture is blurred."),
        _withholds("picture.spray", "picture", "Parts of the picture are blurred: drops or dirt."),
        _withholds("picture.check_failed", "picture", "The checks of the picture have failed."),
        _minor("picture.unchecked", "picture", "The picture is not checked: monitor.picture."),
        _minor("picture.underexposed", "picture", "The picture is very dark."),
        _minor("picture.overexposed", "picture", "Much of the picture is overexposed."),
        _stops("detector.no_answer", "detector", "No answer for detection.silent_after_s."),
        _stops("detector.future_time", "detector", "The newest answer's time is in the future."),
        _stops("detector.error", "detector", "The detector fails on every frame."),
        _ends("detector.hang", "detector", "No inference returned for detection.hang_after_s."),
        _ends("detector.failing", "detector", "Only failures for detection.hang_after_s."),
        _withholds(
            "detector.blind",
            "detector",
            "The model misses what it found in a check picture, or finds nothing while much moves.",
        ),
        _minor(
            "detector.crowded",
            "detector",
            "More road users of a kind than are tracked; the least confident are left out.",
        ),
        _begins("service.starting", "service", "The model loads, or the first frames are due."),
        _stops(
            "service.unsteady", "service", "FAULT comes and goes; a longer good time is awaited."
        ),
        _begins("service.recovering", "service", "A fault is over; good frames are counted."),
        _withholds("service.unsteady", "service", "The service ended soon after its start before."),
        _minor(
            "service.last_good_config",
            "service",
            "The configuration is broken; the last good one runs.",
            severity=Severity.ERROR,
        ),
        _stops(
            "light.not_refreshed",
            "light",
            "The service has not set the light for a second; its thread shows FAULT by itself.",
            clears=Clears.AT_ONCE,
        ),
        # What the lamp shows is not known: the service must not say SAFE for it.
        _stops("light.error", "light", "The light cannot be opened or set."),
        _stops("light.hang", "light", "The light's device does not answer."),
        _stops(
            "light.thread_ended",
            "light",
            "The light's thread has ended.",
            severity=Severity.CRITICAL,
            clears=Clears.RESTART,
        ),
        _stops(
            "lamp.latched",
            "light",
            "Heartbeats came and went, or other lamps were lit than were set; the lamp shows "
            "FAULT until `bikeped lamp reset`.",
        ),
        _stops("lamp.silent", "light", "The lamp's process does not answer."),
        _minor("camera.moved_slightly", "camera", "The camera has moved a little; align it again."),
        _minor("camera.slow", "camera", "Less than half of the camera's frames arrive."),
        _minor("service.slow", "service", "The light follows the picture too late."),
        _minor("speaker.error", "speaker", "A sound could not be played."),
        _minor("service.same_site", "service", "Another service publishes under this site's name."),
        _minor("audit.error", "audit", "The audit log cannot be written."),
    )
}


@dataclass(frozen=True)
class Fault:
    """Something that is wrong now.

    `source` is what reports it, `code` a key of `FAULT_KINDS`, `detail` one line for people. The
    detail carries no age or counter, so that a fault that lasts stays equal to itself and is
    logged once. ValueError for an unknown code.
    """

    source: str
    code: str
    detail: str

    def __post_init__(self) -> None:
        if self.code not in FAULT_KINDS:
            raise ValueError(f"{self.code!r} is not in bikeped.faults.FAULT_KINDS; add it there")

    @property
    def kind(self) -> FaultKind:
        """What this fault does."""
        return FAULT_KINDS[self.code]

    def __str__(self) -> str:
        return f"{self.source}: {self.detail}"


def fault_texts(faults: Iterable[Fault]) -> tuple[str, ...]:
    """The lines for people, in order."""
    return tuple(map(str, faults))
