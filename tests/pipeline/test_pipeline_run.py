"""`bikeped run` as systemd runs it: a real process with a real model, stopped by a signal."""

from __future__ import annotations

import json
import re
import shutil
import signal
import time
import urllib.error
import urllib.request
from pathlib import Path

import jsonschema
import pytest
from small_crossing import PATIENCE_S

SCHEMAS = Path(__file__).parents[2] / "docs" / "messages"


def test_a_recording_in_the_cameras_place_ready_watched_and_stopped(start, make_clip, small_config):
    service = start(small_config(make_clip("day.avi", 900)))
    service.until_told("READY=1")
    service.until_told("WATCHDOG=1")
    service.until_said("SAFE: ")
    service.until_said("simulated light: green")
    service.until_said(r"health: .*latency p50/p95/p99 ms: acquire .*capture_age")
    assert service.stop() == 0
    service.until_told("STOPPING=1")
    log = service.log
    assert re.search(r"bikeped \d+\.\d+.*configuration [0-9a-f]{64} .*calibration none", log)
    assert re.search(r"detector: pedestrian\.onnx .*sha256 [0-9a-f]{64}", log)
    assert log.index("FAULT: ") < log.index("SAFE: ")
    assert log.index("simulated light: orange") < log.index("simulated light: green")
    assert re.search(r"latency\nstage, ms +mean +p50 +p95 +p99 +max\nacquire", log)
    # Dark is the last that the light does, and the last that the service says.
    assert "simulated light: off" in service.lines[-2]
    assert "the light is off" in service.lines[-1]
    assert log.rindex("simulated light: green") < log.rindex("simulated light: off")


def test_the_end_of_a_rehearsal_is_a_clean_end(start, make_clip, small_config):
    service = start(small_config(make_clip("short.avi", 15)))
    assert service.wait() == 0
    assert "the light is off" in service.lines[-1]


def test_a_missing_camera_is_a_fault_and_not_the_end(start, small_config):
    service = start(small_config("/dev/video-none"))
    service.until_told("READY=1")
    service.until_said("FAULT: camera: no frame yet.*no such camera; plug it in")
    service.until_told("WATCHDOG=1")  # systemd has no reason to end it
    assert service.process.poll() is None
    assert service.stop(signal.SIGINT) == 0
    assert "green" not in service.log
    assert "blue" not in service.log


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["detection.model=/nowhere/model.onnx"], r"/nowhere/model\.onnx"),
        (["detection.model=null"], r"small\.yaml.*detection\.model"),
        (["feedback.light=gpio"], r"feedback\.gpio\.chip: missing"),
        (["feedback.light=gpio", "feedback.gpio.chip=x"], r"feedback\.gpio: no red lamp"),
        (["decision.memory_frames=0"], r"decision\.memory_frames: 0"),
        (["camera.pad_size=100", "camera.crop_size=200"], r"camera\.crop_size"),
        (["mqtt.enabled=true", "mqtt.password_file=/nowhere/pw"], r"mqtt\.password_file"),
        (
            ["feedback.sound.enabled=true", "feedback.sound.bell=/nowhere/b.wav"],
            r"feedback\.sound\.bell",
        ),
    ],
)
def test_what_needs_a_person_ends_with_2_and_one_line(start, small_config, options, said):
    service = start(small_config(), *[part for o in options for part in ("--set", o)])
    assert service.wait() == 2
    (line,) = [line for line in service.lines if line.startswith("bikeped: ")]
    assert re.search(said, line)
    assert "Traceback" not in service.log


HANGS = """
import sys, threading
from bikeped.cli.main import main
from bikeped.detection.detector import DetectionResult
from bikeped.types import Detections
import bikeped.pipeline.run as run

class FrameDetector:
    name, model_hash, cyclist_box_includes_rider, calls = "hangs", None, False, 0
    def decode_size(self, width, height):
        return width, height
    def detect(self, picture):
        self.calls += 1
        if self.calls > 20:
            threading.Event().wait()  # for ever, as a driver may
        return DetectionResult(Detections.empty(), 0.0, 0.0, 0.0)

run.load_detector_pool = lambda loaded: FrameDetector()
sys.exit(main(sys.argv[1:]))
"""


def test_a_hung_detector_is_a_fault_and_then_a_fresh_process(start, make_clip, small_config):
    service = start(
        small_config(make_clip("day.avi", 900)),
        *("--set", "detection.hang_after_s=1.5"),
        program=HANGS,
    )
    service.until_said("IDLE: ")
    service.until_said("FAULT: .*detector: no answer for more than 0.5 s")
    assert service.wait() == 75
    assert "detector: has not returned for 1.5 s" in service.log
    assert "the light is off" in service.lines[-1]


LOADS_FOR_EVER = """
import sys, threading
from bikeped.cli.main import main
import bikeped.pipeline.run as run
run.load_detector_pool = lambda loaded: threading.Event().wait()
sys.exit(main(sys.argv[1:]))
"""


def test_stopping_while_the_model_loads_is_prompt(start, small_config):
    service = start(small_config(), program=LOADS_FOR_EVER)
    service.until_told("STATUS=loading the model")
    service.until_said("simulated light: orange")
    assert service.stop() == 0
    assert "the light is off" in service.lines[-1]


def until_safe(address: str) -> dict[str, object]:
    """The health report of a moment that is SAFE: on a busy machine frames come late at times."""
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        try:
            answer = urllib.request.urlopen(address, timeout=PATIENCE_S)
        except urllib.error.HTTPError as error:
            answer = error
        with answer:
            health = json.load(answer)
        assert (answer.status == 503) == (health["state"] == "FAULT")
        if health["state"] == "SAFE":
            return health
        assert time.monotonic() < deadline_s, health


def test_everything_but_camera_and_light_is_broken(start, make_clip, small_config, tmp_path):
    """A dead broker, a full disk, no sound: the crossing is watched all the same."""
    if shutil.disk_usage(tmp_path).free >= 1e12:
        pytest.skip("this disk has more room than audit.min_free_mb can ask for")
    config = small_config(
        make_clip("day.avi", 900),
        more="  enabled: true\n  host: 127.0.0.1\n  port: 9\n"
        "web: {enabled: true, port: 0}\n"
        "audit: {path: audit.jsonl, min_free_mb: 1000000}\n"
        "feedback: {light: simulated, sound: {enabled: true, device: none}}\n",
    )
    service = start(config)
    service.until_told("READY=1")
    service.until_said("SAFE: ")
    base = "http://127.0.0.1:" + service.until_said(r"serving http://127\.0\.0\.1:(\d+)")[1]
    service.until_said("audit: .*no audit log while less than")
    service.until_said("mqtt: .*trying again")
    health = until_safe(f"{base}/healthz")
    jsonschema.validate(health, json.loads((SCHEMAS / "health.schema.json").read_text()))
    assert any(fault.startswith("audit: ") for fault in health["faults"])
    assert health["counters"]["frames"] > 0
    assert set(health["latency_ms"]) >= {"acquire", "inference", "total", "capture_age"}
    with urllib.request.urlopen(f"{base}/metrics", timeout=PATIENCE_S) as answer:
        assert b"bikeped_frames_total" in answer.read()
    assert not (tmp_path / "audit.jsonl").exists()
    assert service.stop() == 0


def test_a_light_that_is_absent_at_the_start_is_fault_and_503(start, make_clip, small_config):
    config = small_config(
        make_clip("day.avi", 900),
        more="web: {enabled: true, port: 0}\nfeedback: {light: usb, usb: {device: relay}}\n",
    )
    service = start(config)
    service.until_said(r"FAULT: light: feedback\.usb\.device: no HID relay board")
    service.until_said(r"health: FAULT.*[1-9]\d* processed")  # frames come, and are decided
    base = "http://127.0.0.1:" + service.until_said(r"serving http://127\.0\.0\.1:(\d+)")[1]
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(f"{base}/healthz", timeout=PATIENCE_S)
    assert caught.value.code == 503
    health = json.load(caught.value)
    caught.value.close()
    assert (health["state"], health["light"]["ok"]) == ("FAULT", False)
    assert "light.error" in health["fault_codes"]
    assert service.stop() == 0
    assert "SAFE" not in service.log


async def test_telemetry_of_the_service_from_the_first_fault_to_off(
    broker, listen, start, make_clip, small_config, tmp_path
):
    config = small_config(
        make_clip("day.avi", 900),
        more=f"  enabled: true\n  host: 127.0.0.1\n  port: {broker.port}\n  site: whole\n"
        "audit: {path: audit.jsonl, min_free_mb: 0}\n",
    )
    async with listen(broker.port, "bikeped/whole/#") as listener:
        service = start(config)
        await listener.until(
            lambda received: (
                any(t.endswith("/tracks") for t, _, _ in received)
                and any(t.endswith("/state") and b'"SAFE"' in p for t, p, _ in received)
            )
        )
        service.process.send_signal(signal.SIGTERM)
        await listener.until(
            lambda received: any(
                t.endswith("/availability") and p == b"offline" for t, p, _ in received
            )
        )
        assert service.wait() == 0
    for topic, payload, _ in listener.received:
        suffix = topic.rpartition("/")[2]
        schema = json.loads((SCHEMAS / f"{suffix}.schema.json").read_text())
        message = payload.decode() if suffix == "availability" else json.loads(payload)
        jsonschema.validate(message, schema)
    states = [json.loads(p)["state"] for p in listener.payloads("state")]
    assert states[0] == "FAULT"
    assert "SAFE" in states
    assert states[-1] == "OFF"
    assert json.loads(listener.payloads("health")[-1])["state"] == "OFF"
    assert listener.payloads("availability") == [b"online", b"offline"]
    lines = (tmp_path / "audit.jsonl").read_bytes().splitlines()
    header = json.loads((SCHEMAS / "event-header.schema.json").read_text())
    frame = json.loads((SCHEMAS / "event-frame.schema.json").read_text())
    jsonschema.validate(json.loads(lines[0]), header)
    for line in lines[1:]:
        jsonschema.validate(json.loads(line), frame)
    assert len(lines) > 5
