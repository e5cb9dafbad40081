"""Builds the tracks message and event lines of the types in `schema`, and encodes all. Pure.

Positions are rounded to a millimetre, so that files read well and two replays of one recording
agree byte for byte. Only `latency_ms` and `started_at` differ between two runs; they come
last in their line, and `decision_view` leaves them out.
"""

from __future__ import annotations

import datetime as dt
import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

import msgspec
import numpy as np
import numpy.typing as npt

from bikeped.errors import TelemetryError
from bikeped.faults import Fault
from bikeped.monitor.camera_drift import Drift
from bikeped.monitor.detector_check import DetectorNumbers
from bikeped.monitor.verdicts import Verdict
from bikeped.telemetry import schema as messages
from bikeped.telemetry.schema import EventHeader, EventLine, EventTrack, KindLabel, ShownState
from bikeped.types import Decision, Detections, FloatArray, Kind, KindArray, State, Tracks

VOLATILE_KEYS = ("latency_ms", "started_at")  #: the only keys that differ between two replays

_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder()


def encode(message: msgspec.Struct) -> bytes:
    """The JSON payload of a message."""
    return _encoder.encode(message)


def encode_line(message: EventHeader | EventLine) -> bytes:
    """The JSON line of an event, newline included."""
    return _encoder.encode(message) + b"\n"


def rfc3339(unix_s: float) -> str:
    """Seconds since 1970 (UTC) as RFC 3339 to the nearest millisecond."""
    whole_s, ms = divmod(round(unix_s * 1000), 1000)
    stamp = dt.datetime.fromtimestamp(whole_s, tz=dt.timezone.utc).replace(tzinfo=None)
    return f"{stamp.isoformat()}.{ms:03d}Z"


def tracks_message(
    *,
    unix_s: float,
    frame_number: int,
    state: ShownState,
    tracks: Tracks,
    history: Mapping[int, Sequence[Sequence[float]] | FloatArray],
) -> messages.TracksMessage:
    """The tracks message of one frame captured at `unix_s` (seconds since 1970).

    `history` maps a track id to its recent [x, y] in metres, oldest first; a track that it does not
    name gets none. Tracks without finite numbers are left out.
    """
    tracks = finite_tracks(tracks)
    distance_m = _rounded(np.hypot(*tracks.xy_m.T), 3)
    speed_mps = _rounded(np.hypot(*tracks.velocity_mps.T), 3)
    objects = [
        messages.TrackedObject(
            track_id=track.id,
            class_=track.kind,
            position=messages.Position(x=track.x, y=track.y, distance=distance),
            velocity=messages.Velocity(x=track.vx, y=track.vy, speed=speed),
            history=_points(history.get(track.id, ())),
        )
        for track, distance, speed in zip(track_records(tracks), distance_m, speed_mps, strict=True)
    ]
    return messages.TracksMessage(
        timestamp=rfc3339(unix_s), frame_number=frame_number, state=state, objects=objects
    )


def finite_tracks(tracks: Tracks) -> Tracks:
    """The tracks with finite numbers: others have no place on a map, and JSON has no NaN."""
    numbers = np.concatenate([tracks.xy_m, tracks.velocity_mps], axis=1)
    return tracks.take(np.isfinite(numbers).all(axis=1))


def track_records(tracks: Tracks) -> list[EventTrack]:
    """Finite tracks as they stand in event lines, rounded to a millimetre."""
    rows = zip(
        tracks.id.tolist(),
        _labels(tracks.kind),
        _rounded(tracks.xy_m, 3),
        _rounded(tracks.velocity_mps, 3),
        (tracks.unseen_s > 0).tolist(),
        strict=True,
    )
    return [
        EventTrack(id=track_id, kind=kind, x=x, y=y, vx=vx, vy=vy, lost=lost)
        for track_id, kind, (x, y), (vx, vy), lost in rows
    ]


def check_status(verdict: Verdict) -> messages.CheckStatus:
    """A check of the picture as it stands in the health message."""
    return messages.CheckStatus(
        code=verdict.code,
        value=json_number(verdict.value, 4),
        threshold=json_number(verdict.threshold, 4),
        hold_s=verdict.hold_s,
        active=verdict.active,
    )


def watch_status(numbers: DetectorNumbers) -> messages.DetectorWatchStatus:
    """The watch over the detector as it stands in the health message."""
    values = {k: round(v, 1) if isinstance(v, float) else v for k, v in vars(numbers).items()}
    return msgspec.convert(values, messages.DetectorWatchStatus)


def drift_status(drift: Drift) -> messages.DriftStatus:
    """The camera's drift as it stands in the health message."""
    values = {name: getattr(drift, name) for name in messages.DriftStatus.__struct_fields__}
    numbers = {k: json_number(v, 3) for k, v in values.items() if not isinstance(v, bool)}
    return messages.DriftStatus(**{**values, **numbers})


def event_line(
    *,
    t_s: float,
    frame: int,
    decision: Decision,
    tracks: Tracks,
    detections: Detections,
    latency_ms: Mapping[str, float],
    light: ShownState | None = None,
    faults: Sequence[Fault] = (),
) -> EventLine:
    """The event line of one frame, `t_s` seconds after the start.

    `light` is what the light showed, None where that is what was decided. Tracks without finite
    numbers are left out, as in `tracks_message`.
    """
    pair = decision.pair
    return EventLine(
        t=json_number(t_s, 4) or 0.0,
        frame=frame,
        state=_state(decision.state),
        light=light or _state(decision.state),
        faults=[
            messages.EventFault(source=fault.source, code=fault.code, detail=fault.detail)
            for fault in faults
        ],
        pair=None if pair is None else (pair.cyclist_id, pair.pedestrian_id),
        tracks=track_records(finite_tracks(tracks)),
        detections=[
            messages.EventDetection(kind=kind, confidence=confidence, box=tuple(box))
            for kind, confidence, box in zip(
                _labels(detections.kind),
                _rounded(detections.confidence, 4),
                _rounded(detections.box_px, 1),
                strict=True,
            )
        ],
        sentence=decision.sentence,
        detail=decision.detail,
        raw_state=_state(decision.state if decision.raw is None else decision.raw),
        latency_ms={stage: json_number(ms, 3) or 0.0 for stage, ms in latency_ms.items()},
    )


def parse_event(line: bytes | str) -> EventHeader | EventLine:
    """One line of an event file, header or frame.

    Raises TelemetryError, saying which key is wrong, for a line that is neither.
    """
    try:
        raw = _decoder.decode(line)
        if isinstance(raw, dict) and "format" in raw:
            return msgspec.convert(raw, EventHeader)
        return msgspec.convert(raw, EventLine)
    except msgspec.MsgspecError as exc:
        raise TelemetryError(
            f"not an event line ({exc}): give a file that --events or the audit log wrote"
        ) from exc


def decision_view(line: bytes | str) -> bytes:
    """An event line without what differs between two runs of one recording (`VOLATILE_KEYS`).

    Two replays of one recording with one configuration are equal line by line in this view.
    Raises TelemetryError for a line that is not a JSON object.
    """
    try:
        raw: Any = _decoder.decode(line)
    except msgspec.DecodeError as exc:
        raise TelemetryError(f"not an event line ({exc}): give a file of event lines") from exc
    if not isinstance(raw, dict):
        raise TelemetryError("not an event line (no JSON object): give a file of event lines")
    return _encoder.encode({key: value for key, value in raw.items() if key not in VOLATILE_KEYS})


def decision_digest(lines: Iterable[bytes | str]) -> str:
    """SHA-256, in hexadecimal, of the `decision_view` of all lines; blank lines do not count.

    Equal digests mean equal decisions; an opened event file is such an iterable.
    """
    digest = hashlib.sha256()
    for line in lines:
        if line.strip():
            digest.update(decision_view(line) + b"\n")
    return digest.hexdigest()


def _state(state: State) -> ShownState:
    return cast(ShownState, state.name)


def _labels(kinds: KindArray) -> list[KindLabel]:
    return [cast(KindLabel, Kind(kind).label) for kind in kinds.tolist()]


def _rounded(values: npt.NDArray[Any] | Sequence[Any], decimals: int) -> list[Any]:
    # + 0.0 turns -0.0 into 0.0: two ways of computing one position must not differ in a sign.
    rounded: list[Any] = (np.round(np.asarray(values, np.float64), decimals) + 0.0).tolist()
    return rounded


def _points(values: Sequence[Sequence[float]] | FloatArray) -> list[tuple[float, float]]:
    if len(values) == 0:
        return []
    array = np.asarray(values, np.float64)
    return [(x, y) for x, y in _rounded(array[np.isfinite(array).all(axis=1)], 3)]


def json_number(value: float, decimals: int) -> float | None:
    """`value` rounded, or None where JSON has no number for it."""
    return round(float(value), decimals) + 0.0 if math.isfinite(value) else None
