"""Messages and event lines: exact keys, rounding, schemas, and equality between two runs."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
import math
import re
from pathlib import Path

import jsonschema
import msgspec
import numpy as np
import pytest
import reference_pages
from hypothesis import given
from hypothesis import strategies as st

from bikeped.errors import TelemetryError
from bikeped.faults import Fault
from bikeped.monitor.camera_drift import Drift
from bikeped.monitor.detector_check import DetectorNumbers
from bikeped.monitor.verdicts import Verdict
from bikeped.telemetry import builders as m
from bikeped.telemetry import schema as wire
from bikeped.types import Decision, Detections, PairMetrics, State, Tracks

DOCS = Path(__file__).parents[2] / "docs" / "messages"
NOON = 1_767_268_800.0  # 2026-01-01T12:00:00Z

PAIR = PairMetrics(
    cyclist_id=7,
    pedestrian_id=3,
    distance_m=4.56789,
    distance_then_m=6.0,
    lookback_s=0.5,
    displacement_m=2.0,
    speed_mps=4.0,
    d_min_m=1.0,
    d_max_m=8.0,
)
ALERT = Decision(1.0, State.ALERT, "Cyclist 7 comes towards pedestrian 3.", PAIR)
IDLE = Decision(1.0, State.IDLE, "Nobody is near.")
TRACKS = Tracks(
    time_s=1.0,
    id=np.array([3, 7]),
    kind=np.array([0, 1], np.int8),
    xy_m=np.array([[3.0, 4.0], [-0.00001, 12.34567]]),
    velocity_mps=np.array([[0.0, -0.0], [3.0, -4.0]]),
    unseen_s=np.array([0.2, 0.0]),
    detection=np.array([-1, 0]),
)
DETECTIONS = Detections(
    np.array([1], np.int8),
    np.array([0.1], np.float32),
    np.array([[1.04, 2.06, 3.0, 4.0]], np.float32),
)
COUNTERS = wire.Counters(
    received=13,
    frames=9,
    dropped=1,
    undecodable=0,
    failed=2,
    out_of_order=1,
    alerts=2,
    mqtt_dropped=0,
    audit_dropped=0,
)


def tracks_message(**changes) -> wire.TracksMessage:
    values = {
        "unix_s": NOON,
        "frame_number": 42,
        "state": "ALERT",
        "tracks": TRACKS,
        "history": {7: [[0.0, 12.0], [1.23456, 12.1]], 3: np.zeros((0, 2))},
    }
    return m.tracks_message(**{**values, **changes})


BLURRED = Verdict("picture.blurred", 1.23456, 1.0, 2.5, True, "The picture is blurred.")
HEALTH = wire.HealthMessage(
    timestamp=m.rfc3339(NOON),
    state="FAULT",
    version="0.1.0",
    config_hash="c0ffee",
    uptime_s=12.3,
    fps=30.0,
    latency_ms={"total": wire.StageLatency(p50=1.23, p95=2.0, p99=3.0, max=4.0)},
    camera=wire.CameraHealth(ok=False, detail="no frame for 2 s", capture_age_ms=None),
    detector=wire.ComponentStatus(ok=True, detail="onnxruntime, CPU"),
    detector_watch=m.watch_status(DetectorNumbers(12.34, 3, 0, 4.56, None)),
    light=wire.ComponentStatus(ok=True, detail="gpio"),
    picture=wire.ComponentStatus(ok=False, detail="The picture is blurred."),
    checks=[m.check_status(BLURRED)],
    drift=m.drift_status(Drift(pixels=4.5678, degrees=0.3, metres_at_10m=0.16)),
    faults=["camera: no frame for 2 s"],
    fault_codes=["camera.no_frame"],
    counters=COUNTERS,
    instance="3f9a1c0b",
)
STATE = wire.StateMessage(
    state="ALERT",
    since=m.rfc3339(NOON),
    pair=(7, 3),
    distance_m=4.568,
    config_hash="c",
    sentence="Cyclist 7 comes towards pedestrian 3.",
)


def event_line(**changes) -> wire.EventLine:
    values = {
        "t_s": 1.23456,
        "frame": 42,
        "decision": ALERT,
        "tracks": TRACKS,
        "detections": DETECTIONS,
        "latency_ms": {"pre": 1.23456, "total": 20.0},
    }
    return m.event_line(**{**values, **changes})


def event_header(started_unix_s: float = NOON) -> wire.EventHeader:
    return wire.EventHeader(
        format="bikeped-events/1",
        config_hash="c0ffee",
        calibration_hash=None,
        model_hash="abc",
        version="0.1.0",
        started_at=m.rfc3339(started_unix_s),
    )


REAL = {
    "tracks": [tracks_message(), tracks_message(tracks=Tracks.empty(1.0), history={})],
    "state": [
        STATE,
        *(
            msgspec.structs.replace(STATE, state=state, pair=None, distance_m=None)
            for state in ("IDLE", "FAULT", "OFF")
        ),
    ],
    "health": [
        HEALTH,
        msgspec.structs.replace(
            HEALTH,
            camera=wire.CameraHealth(ok=True, detail="frames arrive", capture_age_ms=12.0),
            latency_ms={},
            checks=[],
            drift=None,
            faults=[],
            fault_codes=[],
        ),
    ],
    "event-header": [event_header()],
    "event-frame": [
        event_line(),
        event_line(decision=IDLE, tracks=Tracks.empty(0.0), detections=Detections.empty()),
    ],
}


def validator(name: str) -> jsonschema.Draft202012Validator:
    schema = json.loads((DOCS / f"{name}.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(
        schema, format_checker=jsonschema.Draft202012Validator.FORMAT_CHECKER
    )


def keys(value: object) -> object:
    """The key names of nested JSON, values dropped; of a list, those of its first element."""
    if isinstance(value, dict):
        return {name: keys(inner) for name, inner in value.items()}
    if isinstance(value, list) and value:
        return [keys(value[0])]
    return None


def test_tracks_message_exactly():
    assert json.loads(m.encode(tracks_message())) == {
        "timestamp": "2026-01-01T12:00:00.000Z",
        "frame_number": 42,
        "state": "ALERT",
        "objects": [
            {
                "track_id": 3,
                "class": "pedestrian",
                "position": {"x": 3.0, "y": 4.0, "distance": 5.0},
                "velocity": {"x": 0.0, "y": 0.0, "speed": 0.0},
                "history": [],
            },
            {
                "track_id": 7,
                "class": "cyclist",
                "position": {"x": 0.0, "y": 12.346, "distance": 12.346},
                "velocity": {"x": 3.0, "y": -4.0, "speed": 5.0},
                "history": [[0.0, 12.0], [1.235, 12.1]],
            },
        ],
    }
    assert b"-0.0" not in m.encode(tracks_message())


def test_a_track_without_finite_numbers_or_history_is_left_out_of_the_map():
    bad = dataclasses.replace(TRACKS, xy_m=np.array([[np.nan, 4.0], [1.0, 2.0]]))
    message = tracks_message(tracks=bad, history={7: [[np.nan, 1.0], [2.0, 3.0]]})
    assert [item.track_id for item in message.objects] == [7]
    assert message.objects[0].history == [(2.0, 3.0)]
    assert [track.id for track in event_line(tracks=bad).tracks] == [7]


def test_the_numbers_of_checks_and_drift():
    health = json.loads(m.encode(HEALTH))
    blurred = {"code": "picture.blurred", "value": 1.2346, "threshold": 1.0}
    assert health["checks"] == [{**blurred, "hold_s": 2.5, "active": True}]
    assert (health["drift"]["pixels"], health["drift"]["roll_deg"]) == (4.568, None)


def test_event_line_exactly_and_in_order():
    line = m.encode_line(event_line())
    assert line == (
        b'{"t":1.2346,"frame":42,"state":"ALERT","raw_state":"ALERT","light":"ALERT",'
        b'"faults":[],"pair":[7,3],"tracks":['
        b'{"id":3,"kind":"pedestrian","x":3.0,"y":4.0,"vx":0.0,"vy":0.0,"lost":true},'
        b'{"id":7,"kind":"cyclist","x":0.0,"y":12.346,"vx":3.0,"vy":-4.0,"lost":false}],'
        b'"detections":[{"kind":"cyclist","confidence":0.1,"box":[1.0,2.1,3.0,4.0]}],'
        b'"sentence":"Cyclist 7 comes towards pedestrian 3.","detail":"",'
        b'"latency_ms":{"pre":1.235,"total":20.0}}\n'
    )
    assert m.parse_event(line) == event_line()


def test_the_light_of_an_event_line_may_differ_from_the_decision():
    line = event_line(light="FAULT", faults=[Fault("camera", "camera.error", "unplugged")])
    assert (line.state, line.light, line.pair) == ("ALERT", "FAULT", (7, 3))
    assert line.faults == [
        wire.EventFault(source="camera", code="camera.error", detail="unplugged")
    ]


def test_event_header_and_the_keys_that_interfaces_promise():
    header = json.loads(m.encode_line(event_header()))
    promised = {"config_hash", "calibration_hash", "model_hash", "version", "started_at"}
    assert promised <= header.keys()
    assert list(header)[-1] == "started_at"
    assert m.parse_event(m.encode_line(event_header())) == event_header()


def test_two_runs_agree_but_for_the_volatile_keys():
    first = [
        m.encode_line(event_header(NOON)),
        m.encode_line(event_line(latency_ms={"total": 1.0})),
    ]
    second = [
        m.encode_line(event_header(NOON + 60)),
        m.encode_line(event_line(latency_ms={"total": 2.0, "pre": 1.0})),
    ]
    assert first != second
    assert [m.decision_view(line) for line in first] == [m.decision_view(line) for line in second]
    assert m.decision_digest(first) == m.decision_digest([*second, b"\n"])
    for key in m.VOLATILE_KEYS:
        assert all(key.encode() not in m.decision_view(line) for line in first)
    # A millimetre is another record.
    other = dataclasses.replace(TRACKS, xy_m=TRACKS.xy_m + 0.001)
    assert m.decision_digest([m.encode_line(event_line(tracks=other))]) != m.decision_digest(
        [m.encode_line(event_line())]
    )


def test_the_view_keeps_all_else_byte_for_byte():
    line = m.encode_line(event_line())
    assert m.decision_view(line) == re.sub(rb',"latency_ms":.*\}\n$', b"}", line)


@pytest.mark.parametrize("line", [b"", b"{", b"[]", b"7", b"{}", b'{"format":"other"}', "nonsense"])
def test_what_is_not_an_event_line_is_refused_in_words(line):
    with pytest.raises(TelemetryError, match="not an event line"):
        m.parse_event(line)


@pytest.mark.parametrize("line", [b"{", b"[]", b"7"])
def test_a_view_of_what_is_not_an_object_is_refused(line):
    with pytest.raises(TelemetryError, match="not an event line"):
        m.decision_view(line)


@given(st.floats(0, 4_000_000_000))
def test_timestamps_are_within_half_a_millisecond_and_valid(unix_s: float):
    text = m.rfc3339(unix_s)
    back = dt.datetime.fromisoformat(text.replace("Z", "+00:00")).timestamp()
    assert abs(back - unix_s) <= 0.0005 + 1e-6
    jsonschema.validate(
        {**json.loads(m.encode(tracks_message())), "timestamp": text},
        reference_pages.message_schema("tracks"),
    )


finite = st.floats(-1e4, 1e4)


@given(st.lists(st.tuples(finite, finite, finite, finite), max_size=5))
def test_written_numbers_are_exact_to_half_a_millimetre_and_read_back_the_same(rows):
    n = len(rows)
    array = np.array(rows, np.float64).reshape(n, 4)
    tracks = Tracks(
        0.0,
        np.arange(n),
        np.ones(n, np.int8),
        array[:, :2],
        array[:, 2:],
        np.zeros(n),
        np.full(n, -1),
    )
    line = m.encode_line(event_line(tracks=tracks))
    parsed = m.parse_event(line)
    assert isinstance(parsed, wire.EventLine)
    for row, track in zip(rows, parsed.tracks, strict=True):
        for wanted, got in zip(row, (track.x, track.y, track.vx, track.vy), strict=True):
            assert abs(wanted - got) <= 0.0005 + 1e-9
            assert len(repr(got).partition(".")[2]) <= 3
            assert not (got == 0 and math.copysign(1, got) < 0)
    assert m.encode_line(parsed) == line


@pytest.mark.parametrize("name", list(REAL))
def test_real_messages_follow_the_published_schemas(name: str):
    check = validator(name)
    for message in REAL[name]:
        value = json.loads(m.encode(message))
        check.validate(value)
        for key in value:  # a key that is missing is noticed
            with pytest.raises(jsonschema.ValidationError):
                check.validate({k: v for k, v in value.items() if k != key})
    with pytest.raises(jsonschema.ValidationError):
        check.validate({**value, "state": "PANIC", "format": "other"})


def test_availability_follows_its_schema():
    check = validator("availability")
    check.validate("online")
    check.validate("offline")
    with pytest.raises(jsonschema.ValidationError):
        check.validate("away")


def test_the_examples_in_the_documentation_are_valid_and_complete():
    text = (DOCS / "README.md").read_text(encoding="utf-8")
    examples = re.findall(r"<!-- schema: ([\w-]+) -->\s*```\w+\n(.*?)```", text, re.DOTALL)
    assert {name for name, _ in examples} == set(reference_pages.MESSAGES)
    for name, example in examples:
        value = example.strip() if name == "availability" else json.loads(example)
        validator(name).validate(value)
        if name in REAL:  # no key that the code does not write, none left out
            assert keys(value).keys() == keys(json.loads(m.encode(REAL[name][0]))).keys()
            msgspec.convert(value, reference_pages.MESSAGES[name])
    for name in reference_pages.MESSAGES:
        assert f"{name}.schema.json" in text
