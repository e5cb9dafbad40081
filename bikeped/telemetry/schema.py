"""Types of every MQTT payload and event line; docs/messages has their JSON Schemas.

Other programs rely on the key names. Positions are metres in the camera ground frame (x forward,
y right).
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

ShownState = Literal["IDLE", "SAFE", "WARNING", "ALERT", "FAULT", "OFF"]
KindLabel = Literal["pedestrian", "cyclist", "vehicle"]
Availability = Annotated[
    Literal["online", "offline"],
    Meta(description="plain text, not JSON: online while connected, offline at the end or as will"),
]
Timestamp = Annotated[
    str,
    Meta(
        pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z$",
        description="RFC 3339, UTC, to the millisecond",
        extra_json_schema={"format": "date-time"},
    ),
]
Point = Annotated[tuple[float, float], Meta(description="x forward, y right, metres")]
Pair = Annotated[tuple[int, int], Meta(description="track ids: cyclist, pedestrian")]
Count = Annotated[int, Meta(ge=0)]

# No field of a message has a default, so every key is always there.


class Position(msgspec.Struct, frozen=True, kw_only=True):
    """Position of an object."""

    x: Annotated[float, Meta(description="forward of the camera, metres")]
    y: Annotated[float, Meta(description="right of the camera, metres")]
    distance: Annotated[float, Meta(ge=0, description="from the point below the lens, metres")]


class Velocity(msgspec.Struct, frozen=True, kw_only=True):
    """Velocity of an object."""

    x: Annotated[float, Meta(description="metres per second")]
    y: Annotated[float, Meta(description="metres per second")]
    speed: Annotated[float, Meta(ge=0, description="metres per second")]


class TrackedObject(msgspec.Struct, frozen=True, kw_only=True):
    """One object of the tracks message."""

    track_id: int
    class_: KindLabel = msgspec.field(name="class")
    position: Position
    velocity: Velocity
    history: Annotated[list[Point], Meta(description="recent positions, oldest first")]


class TracksMessage(msgspec.Struct, frozen=True, kw_only=True):
    """`bikeped/<site>/tracks`, at the publish interval, not retained."""

    timestamp: Timestamp
    frame_number: Count
    state: ShownState
    objects: list[TrackedObject]


class StateMessage(msgspec.Struct, frozen=True, kw_only=True):
    """`bikeped/<site>/state`, at every change, retained: what the light shows."""

    state: ShownState
    since: Timestamp
    pair: Pair | None
    distance_m: Annotated[float, Meta(ge=0)] | None
    config_hash: str
    sentence: Annotated[str, Meta(description="why, in one line for a resident")]


class StageLatency(msgspec.Struct, frozen=True, kw_only=True):
    """Percentiles of one stage over the last frames, milliseconds."""

    p50: float
    p95: float
    p99: float
    max: float


class ComponentStatus(msgspec.Struct, frozen=True, kw_only=True):
    """Status of one component: whether it works, and one line about it."""

    ok: bool
    detail: str


class CameraHealth(ComponentStatus, frozen=True, kw_only=True):
    """Status of the camera."""

    capture_age_ms: Annotated[
        float | None, Meta(description="age of the newest frame; null before the first")
    ]


class Counters(msgspec.Struct, frozen=True, kw_only=True):
    """Totals since the process started."""

    received: Annotated[Count, Meta(description="frames received from the camera")]
    frames: Annotated[Count, Meta(description="frames processed through to a decision")]
    dropped: Annotated[Count, Meta(description="frames replaced by a newer one before inference")]
    undecodable: Annotated[Count, Meta(description="frames that could not be decoded")]
    failed: Annotated[Count, Meta(description="frames for which the detector raised an error")]
    out_of_order: Annotated[
        Count, Meta(description="frames skipped because their capture time did not increase")
    ]
    alerts: Annotated[Count, Meta(description="changes into ALERT")]
    mqtt_dropped: Annotated[Count, Meta(description="messages dropped before reaching the broker")]
    audit_dropped: Annotated[Count, Meta(description="event lines not written to the audit log")]
    log_dropped: Annotated[Count, Meta(description="log lines lost: standard error took none")] = 0
    capped: Annotated[
        Count, Meta(description="frames of which not all detections were tracked")
    ] = 0


class CheckStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One check of the picture or the detector: its number now, and from where on it counts."""

    code: str
    value: Annotated[float | None, Meta(description="null while it cannot be measured")]
    threshold: Annotated[float | None, Meta(description="the value that may not be reached")]
    hold_s: Annotated[float, Meta(description="for so long it must be reached")]
    active: bool


class DriftStatus(msgspec.Struct, frozen=True, kw_only=True):
    """How far the camera is from where it was aligned; null before it was measured."""

    pixels: Annotated[float | None, Meta(description="median over the picture, sensor pixels")]
    degrees: float | None
    pitch_deg: float | None
    heading_deg: float | None
    roll_deg: float | None
    shift_m: float | None
    metres_at_10m: Annotated[
        float | None, Meta(description="largest error of a place 10 m away: 0.3 warns, 1.0 stops")
    ]
    judged: Annotated[bool, Meta(description="whether the newest picture could be compared")]
    since_start: Annotated[bool, Meta(description="no alignment saved a reference")]


class DetectorWatchStatus(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of the detector by known answers and by motion."""

    check_age_s: Annotated[float | None, Meta(description="since known answers were asked for")]
    check_passes: Count
    check_failures: Count
    motion_s: Annotated[float, Meta(description="of the last 60 s with motion on the road")]
    detection_age_s: Annotated[float | None, Meta(description="since the newest detection")]


class HealthMessage(msgspec.Struct, frozen=True, kw_only=True):
    """`bikeped/<site>/health`, every 10 s by default, retained."""

    timestamp: Timestamp
    state: ShownState
    version: str
    config_hash: str
    uptime_s: Annotated[float, Meta(ge=0)]
    fps: Annotated[float, Meta(ge=0)]
    latency_ms: Annotated[dict[str, StageLatency], Meta(description="by stage")]
    camera: CameraHealth
    picture: ComponentStatus
    checks: Annotated[
        list[CheckStatus], Meta(description="of the picture and the detector, each with its number")
    ]
    drift: DriftStatus | None
    detector: ComponentStatus
    detector_watch: DetectorWatchStatus | None
    light: ComponentStatus
    faults: Annotated[list[str], Meta(description="what is wrong, one line each; empty: nothing")]
    fault_codes: Annotated[
        list[str], Meta(description="codes of `faults`, in their order (docs/faults-reference.md)")
    ]
    counters: Counters
    instance: Annotated[str, Meta(description="of the process; others under one site are noticed")]


class EventHeader(msgspec.Struct, frozen=True, kw_only=True):
    """First line of an event file; in an audit log also the first line of every later run."""

    format: Literal["bikeped-events/1"]
    config_hash: str
    calibration_hash: str | None
    model_hash: str | None
    version: str
    started_at: Timestamp


class EventFault(msgspec.Struct, frozen=True, kw_only=True):
    """One fault of an event line."""

    source: str
    code: str
    detail: str


class EventTrack(msgspec.Struct, frozen=True, kw_only=True):
    """One track of an event line."""

    id: int
    kind: KindLabel
    x: Annotated[float, Meta(description="metres")]
    y: Annotated[float, Meta(description="metres")]
    vx: Annotated[float, Meta(description="metres per second")]
    vy: Annotated[float, Meta(description="metres per second")]
    lost: Annotated[bool, Meta(description="not seen in this frame: the position is predicted")]


class EventDetection(msgspec.Struct, frozen=True, kw_only=True):
    """One detection of an event line."""

    kind: KindLabel
    confidence: Annotated[float, Meta(ge=0, le=1)]
    box: Annotated[
        tuple[float, float, float, float], Meta(description="u1, v1, u2, v2 in sensor pixels")
    ]


class EventLine(msgspec.Struct, frozen=True, kw_only=True):
    """One frame of an event file or of the audit log."""

    t: Annotated[float, Meta(description="seconds from the start")]
    frame: Count
    state: Annotated[ShownState, Meta(description="what was decided, a held ALERT included")]
    raw_state: Annotated[ShownState, Meta(description="what the rule said of this frame alone")]
    light: Annotated[ShownState, Meta(description="what the light showed: FAULT may cover state")]
    faults: Annotated[list[EventFault], Meta(description="those that the light showed or held")]
    pair: Pair | None
    tracks: list[EventTrack]
    detections: list[EventDetection]
    sentence: str
    detail: Annotated[str, Meta(description="the numbers that the rule compared")]
    latency_ms: Annotated[dict[str, float], Meta(description="by stage")]
