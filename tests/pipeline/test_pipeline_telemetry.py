"""What the loop tells the world, message by message, against the published schemas."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
from pipeline_fakes import Clock, Rig, seen, small
from prometheus_client import generate_latest

from bikeped.errors import DetectorError
from bikeped.faults import FAULT_KINDS, Clears, Effect, Fault, FaultKind, Severity
from bikeped.feedback.signal_logic import SignalLogic
from bikeped.pipeline.signal_dispatcher import SignalDispatcher
from bikeped.pipeline.telemetry import Telemetry, health_line, report_health
from bikeped.telemetry.builders import encode
from bikeped.telemetry.latency import StageTimes
from bikeped.telemetry.metrics import Metrics
from bikeped.types import Colour, Decision, Kind, PairMetrics, Signal, State

SCHEMAS = Path(__file__).parents[2] / "docs" / "messages"


def valid(name, payload):
    schema = json.loads((SCHEMAS / f"{name}.schema.json").read_text())
    message = json.loads(payload)
    jsonschema.validate(
        message, schema, format_checker=jsonschema.Draft202012Validator.FORMAT_CHECKER
    )
    return message


class Publisher:
    instance = "3f9a1c0b"

    class status:  # noqa: N801
        connected, dropped = True, 3

    def __init__(self):
        self.sent = []

    def publish(self, topic, payload, *, retain=False, qos=None):
        self.sent.append((topic, payload, retain, qos))

    def of(self, topic):
        return [valid(t, payload) for t, payload, _, _ in self.sent if t == topic]


class Audit:
    dropped = 0

    def __init__(self):
        self.lines = []

    def write(self, line):
        self.lines.append(line)


class TelemetryRig(Rig):
    def start(self):
        self.publisher, self.audit, self.metrics = Publisher(), Audit(), Metrics()
        self.wall = Clock(1.7e9)
        self.interval = Clock(0.0)
        self.telemetry = Telemetry(
            self.config,
            self.track_and_decide,
            publisher=self.publisher,
            audit=self.audit,
            metrics=self.metrics,
            wall_clock=self.wall,
            clock=self.interval,
        )
        self.outputs = [self.telemetry, self.recorder]
        super().start()
        self.dispatcher._listeners = (self.telemetry, self.recorder)

    async def frames(self, count, step_s=1 / 30, **changes):
        for _ in range(count):
            self.interval.now_s += step_s
            await super().frames(1, step_s, **changes)


async def test_state_is_published_at_changes_only_and_is_retained():
    async with TelemetryRig() as rig:
        await rig.well()
        await rig.frames(30)
        rig.loop.stopping.set()
        await rig.ended()
        states = [m["state"] for m in rig.publisher.of("state")]
        assert states == ["FAULT", "IDLE", "OFF"] or states == ["FAULT", "FAULT", "IDLE", "OFF"]
        assert all(retain and qos == 1 for t, _, retain, qos in rig.publisher.sent if t == "state")
        assert rig.publisher.of("state")[-1]["pair"] is None


async def test_the_state_message_of_an_alert_has_that_frames_pair():
    rig = TelemetryRig(config=small("decision.d_min_m=0.1", "decision.min_displacement_m=0.01"))
    async with rig:
        await rig.well()
        for n in range(30):
            rig.detector.answer = seen((Kind.PEDESTRIAN, 30, 30), (Kind.CYCLIST, 80 - n, 30))
            await rig.frames(1)
            if rig.recorder.name == "ALERT":
                break
        alert = rig.publisher.of("state")[-1]
        line = rig.audit.lines[-1]
        assert alert["state"] == line.state == "ALERT"
        assert alert["pair"] == list(line.pair)
        assert rig.telemetry.health(rig.loop, "simulated").counters.alerts == 1
        for _ in range(2):
            rig.telemetry.measure(rig.loop)
        assert rig.metrics.registry.get_sample_value("bikeped_alerts_total") == 1


def test_state_message_exactly():
    pair = PairMetrics(
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
    rig = TelemetryRig()
    publisher = Publisher()
    telemetry = Telemetry(
        rig.config, rig.track_and_decide, publisher=publisher, wall_clock=Clock(1_767_268_800.0)
    )
    sentence = "Cyclist 7 comes towards pedestrian 3."
    decision = Decision(1.0, State.ALERT, sentence, pair)
    telemetry.on_signal(Signal("ALERT", Colour.RED), sentence, decision)
    telemetry.on_signal(Signal("FAULT", Colour.ORANGE), "s", decision)
    telemetry.on_signal(Signal("OFF", Colour.OFF), "o", None)
    alert, fault, off = publisher.of("state")
    assert alert == {
        "state": "ALERT",
        "since": "2026-01-01T12:00:00.000Z",
        "pair": [7, 3],
        "distance_m": 4.568,
        "config_hash": rig.config.hash,
        "sentence": sentence,
    }
    assert (fault["state"], fault["pair"], fault["distance_m"]) == ("FAULT", None, None)
    assert fault["sentence"] == "s"
    assert (off["state"], off["pair"], off["distance_m"]) == ("OFF", None, None)


async def test_health_message_keys_and_rounding():
    async with TelemetryRig() as rig:
        await rig.well()
        rig.telemetry.times = StageTimes()
        rig.telemetry.times.add({"total": 1.23456})
        rig.interval.now_s += 12.3456
        health = valid("health", encode(rig.telemetry.health(rig.loop, "simulated")))
        assert {"fps", "latency_ms", "camera", "detector", "light", "faults"} <= health.keys()
        assert health["latency_ms"] == {
            "total": {"p50": 1.23, "p95": 1.23, "p99": 1.23, "max": 1.23}
        }
        for value in (health["uptime_s"], health["camera"]["capture_age_ms"]):
            assert value == round(value, 1)


async def test_tracks_come_at_the_interval_with_the_time_of_capture():
    async with TelemetryRig() as rig:
        rig.detector.answer = seen((Kind.PEDESTRIAN, 48, 35))
        await rig.frames(60)
        messages = rig.publisher.of("tracks")
        assert 18 <= len(messages) <= 21  # two seconds, ten a second
        assert messages[-1]["objects"][0]["class"] == "pedestrian"
        assert len(messages[-1]["objects"][0]["history"]) > 10
        assert messages[-1]["timestamp"] < "2023-11-14T22:13:20.000Z"  # before now, which is this


async def test_every_frame_is_a_line_of_the_audit_log():
    async with TelemetryRig() as rig:
        await rig.frames(10)
        lines = [valid("event-frame", encode(line)) for line in rig.audit.lines]
        assert [line["frame"] for line in lines] == list(range(10))
        assert lines[0]["t"] == 0.0
        assert lines[3]["light"] == "FAULT"
        assert lines[9]["light"] == "IDLE"


async def test_health_says_what_is_wrong_and_how_old_the_newest_frame_is(small_jpegs):
    rig, audit = TelemetryRig(), [None]
    rig.fault_sources.append(lambda: audit[0])
    async with rig:
        valid("health", encode(rig.telemetry.health(rig.loop, "simulated")))  # before any frame
        await rig.well()
        await rig.frames(1, jpeg=b"junk")
        audit[0] = Fault("audit", "audit.error", "full")
        message = valid("health", encode(rig.telemetry.health(rig.loop, "gpio")))
        assert message["camera"]["ok"]
        assert message["faults"] == ["audit: full"]
        assert message["fault_codes"] == ["audit.error"]
        assert message["light"] == {"ok": True, "detail": "gpio"}
        assert message["counters"]["undecodable"] == 1
        assert message["counters"]["mqtt_dropped"] == 3
        assert message["fps"] == 3.0  # six frames in the last two seconds
        rig.clock.now_s += 3.0
        await rig.recorder.some_ticks()
        message = valid("health", encode(rig.telemetry.health(rig.loop, "simulated")))
        assert message["state"] == "FAULT"
        assert not message["camera"]["ok"]
        assert not message["detector"]["ok"]
        assert message["camera"]["capture_age_ms"] == pytest.approx(3000, abs=50)
        line = health_line(rig.telemetry.health(rig.loop, "simulated"))
        for stage in ("acquire", "pre", "inference", "post", "track", "decide", "feedback"):
            assert f"{stage} " in line
        assert "total " in line
        assert "capture_age " in line


async def test_a_geometry_fault_makes_the_cameras_health_bad_and_no_other():
    async with TelemetryRig() as rig:
        await rig.well()
        rig.clock.now_s += 0.03
        rig.feed.put(rig.clock.now_s, width=96, height=96)
        await rig.recorder.until(lambda: rig.recorder.name == "FAULT")
        message = valid("health", encode(rig.telemetry.health(rig.loop, "simulated")))
        assert not message["camera"]["ok"]
        assert "proportions" in message["camera"]["detail"]
        assert message["detector"]["ok"]
        assert message["light"]["ok"]
        assert [fault.split(":")[0] for fault in message["faults"]] == ["geometry"]
        assert message["fault_codes"] == ["camera.frame_size"]
        await rig.frames(5)
        assert json.loads(encode(rig.telemetry.health(rig.loop, "simulated")))["camera"]["ok"]


@pytest.mark.parametrize("effect", [Effect.FAULT, Effect.NOTICE])
async def test_a_new_fault_needs_a_row_of_the_table_and_a_source(monkeypatch, effect):
    """The made-up `camera.lens_wet`: light, health, message and codes follow from its row."""
    row = FaultKind(
        "camera.lens_wet",
        "camera",
        "There are drops on the lens.",
        effect,
        Severity.WARNING,
        Clears.GOOD_FRAMES,
    )
    monkeypatch.setitem(FAULT_KINDS, row.code, row)
    wet = []
    rig = TelemetryRig()
    rig.fault_sources.append(lambda: wet[0] if wet else None)
    async with rig:
        await rig.well()
        wet.append(Fault("camera", "camera.lens_wet", "drops on the lens"))
        await rig.recorder.some_ticks()
        message = valid("health", encode(rig.telemetry.health(rig.loop, "simulated")))
        assert message["faults"] == ["camera: drops on the lens"]
        assert message["fault_codes"] == ["camera.lens_wet"]
        assert message["camera"]["detail"] == "camera: drops on the lens"
        assert not message["camera"]["ok"]
        assert message["detector"]["ok"]
        expected = "FAULT" if effect is Effect.FAULT else "IDLE"
        assert rig.recorder.name == message["state"] == expected
        assert rig.publisher.of("state")[-1]["state"] == expected
        wet.clear()
        await rig.frames(5)
        assert rig.recorder.name == "IDLE"


async def test_metrics_count_what_no_single_frame_tells():
    async with TelemetryRig() as rig:
        await rig.well()
        await rig.frames(2, jpeg=b"junk")
        for _ in range(2):  # totals, not sums of totals
            rig.telemetry.measure(rig.loop, light_errors=4)
        text = generate_latest(rig.metrics.registry).decode()
        assert "bikeped_frames_undecodable_total 2.0" in text
        assert "bikeped_light_faults_total 4.0" in text
        assert "bikeped_mqtt_dropped_total 3.0" in text
        assert "bikeped_frames_total 6.0" in text
        assert 'bikeped_state{bikeped_state="IDLE"} 1.0' in text


async def test_every_lost_frame_is_in_health_metrics_and_log_line():
    async with TelemetryRig() as rig:
        await rig.well()
        await rig.frames(2, jpeg=b"junk")
        rig.detector.error = DetectorError("out of memory")
        await rig.frames(3)
        rig.detector.error = None
        rig.feed.put(rig.clock.now_s - 50)
        await rig.recorder.until(lambda: rig.loop.counts.out_of_order == 1)
        message = rig.telemetry.health(rig.loop, "simulated")
        counters = valid("health", encode(message))["counters"]
        assert {key: counters[key] for key in ("received", "frames", "undecodable")} == {
            "received": 12,
            "frames": 6,
            "undecodable": 2,
        }
        assert (counters["failed"], counters["out_of_order"]) == (3, 1)
        assert "6 processed, 0 dropped, 2 undecodable, 3 failed, 1 out of order" in health_line(
            message
        )
        rig.telemetry.measure(rig.loop)
        text = generate_latest(rig.metrics.registry).decode()
        assert "bikeped_frames_received_total 12.0" in text
        assert "bikeped_frames_failed_total 3.0" in text
        assert "bikeped_frames_out_of_order_total 1.0" in text


async def test_a_failing_health_report_costs_a_message_and_no_more(caplog, monkeypatch):
    import asyncio

    rig = TelemetryRig(config=small("mqtt.health_interval_s=0.1"))
    async with rig:
        calls = []
        health = rig.telemetry.health

        def health_with_a_bug(loop, light):
            calls.append(1)
            if len(calls) == 1:
                raise ValueError("a bug")
            return health(loop, light)

        monkeypatch.setattr(rig.telemetry, "health", health_with_a_bug)
        telling = asyncio.create_task(report_health(rig.telemetry, rig.loop, rig.light))
        try:
            while not rig.publisher.of("health"):
                assert not telling.done()
                await rig.recorder.some_ticks()
        finally:
            telling.cancel()
        assert "health: a bug" in caplog.text


def test_the_dispatcher_refreshes_what_it_shows():
    from pipeline_fakes import FakeLight

    light = FakeLight()
    dispatcher = SignalDispatcher(SignalLogic(), light)  # type: ignore[arg-type]
    dispatcher.refresh()
    assert light.shown == []
    dispatcher.switch_off()
    dispatcher.refresh()
    assert [signal.name for signal in light.shown] == ["OFF", "OFF"]


async def test_every_change_into_alert_counts_once():
    async with TelemetryRig() as rig:
        for name in ("SAFE", "ALERT", "ALERT", "WARNING", "ALERT", "FAULT"):
            rig.telemetry.on_signal(Signal(name, Colour.OFF), name, None)
        assert rig.telemetry.health(rig.loop, "simulated").counters.alerts == 2
