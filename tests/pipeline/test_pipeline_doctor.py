"""The doctor's checks with fakes: what each says of a sound part and of a broken one."""

from __future__ import annotations

import datetime as dt
import subprocess
import threading

import pytest

from bikeped.config.load import load_config
from bikeped.errors import CaptureError, FeedbackError
from bikeped.pipeline import doctor
from bikeped.pipeline.doctor import Finding, checks, run_checks
from bikeped.types import Colour, Frame

PATIENCE_S = 20.0


@pytest.fixture(autouse=True)
def no_programs(monkeypatch):
    """No system program is asked, unless a test says what it answers."""
    monkeypatch.setattr(doctor, "_output_of", lambda *command: None)


class Camera:
    name, width, height, fps, live = "/dev/video0", 96, 64, 30.0, True

    def __init__(self, clock, jpeg, step_s):
        self.clock, self.jpeg, self.step_s, self.closed = clock, jpeg, step_s, False

    def read(self):
        self.clock[0] += self.step_s
        return Frame(0, self.clock[0], self.width, self.height, jpeg=self.jpeg)

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.closed = True


@pytest.fixture
def camera(monkeypatch, small_jpegs):
    """Makes `open_source` give a camera of this rate, on a clock of its own."""

    def make(fps=30.0, jpeg=small_jpegs[0], **values):
        clock = [0.0]
        found = Camera(clock, jpeg, 1 / fps)
        for key, value in values.items():
            setattr(found, key, value)
        monkeypatch.setattr(doctor, "open_source", lambda *a, **k: found)
        monkeypatch.setattr(doctor.time, "monotonic", lambda: clock[0])
        return found

    return make


def test_a_sound_configuration(small_config):
    finding = doctor.check_configuration(load_config(small_config()))
    assert finding.status == "ok"
    assert "perspective, f = 78.4 px, 5 m up" in finding.detail


def test_a_sound_camera_is_measured_and_given_back(camera, small_config):
    found = camera(30.0)
    finding = doctor.check_camera(load_config(small_config()))
    assert finding.status == "ok"
    assert "96 x 64, 30.0 frames/s measured" in finding.detail
    assert "decoded in" in finding.detail
    assert found.closed


def test_a_slow_camera_is_a_warning(camera, small_config):
    camera(12.0)
    finding = doctor.check_camera(load_config(small_config()))
    assert finding.status == "warn"
    assert "12.0 frames/s" in finding.detail
    assert "camera.fps asks for 30" in finding.remedy


def found_by(function, config, name="camera"):
    (finding,) = run_checks(config, ((name, function, PATIENCE_S),))
    return finding


@pytest.mark.parametrize(
    ("values", "said"), [({"jpeg": b"junk"}, "JPEG"), ({"width": 64}, "other proportions")]
)
def test_a_camera_whose_pictures_are_of_no_use_fails(camera, small_config, values, said):
    camera(**values)
    finding = found_by(doctor.check_camera, load_config(small_config()))
    assert finding.status == "fail"
    assert said in finding.detail


def test_a_missing_camera_fails_with_its_mend(small_config):
    finding = doctor.check_camera(load_config(small_config("/dev/video-none")))
    assert (finding.status, finding.detail) == ("fail", "/dev/video-none: no such camera")
    assert "plug it in" in finding.remedy


def test_what_the_running_service_holds_is_a_warning(small_config, monkeypatch):
    monkeypatch.setattr(doctor, "_output_of", lambda *command: "active")

    def busy(*a, **k):
        raise CaptureError("/dev/video0: busy; who uses it?")

    monkeypatch.setattr(doctor, "open_source", busy)
    finding = doctor.check_camera(load_config(small_config()))
    assert finding.status == "warn"
    assert "systemctl stop bikeped" in finding.remedy


def test_a_recording_in_the_cameras_place_is_a_warning(make_clip, small_config):
    finding = doctor.check_camera(load_config(small_config(make_clip("c.avi", 4))))
    assert finding.status == "warn"
    assert "a recording" in finding.detail


def test_a_model_is_loaded_and_timed(small_config):
    finding = doctor.check_model(load_config(small_config(), ["camera.fps=1"]))
    assert finding.status == "ok"
    assert "pedestrian.onnx" in finding.detail
    assert "ms a frame" in finding.detail


def test_a_slow_model_is_a_warning_and_a_missing_one_fails(small_config, monkeypatch):
    class Slow:
        name = "slow"

        def decode_size(self, width, height):
            return width, height

        def detect(self, picture):
            clock[0] += 0.05

    clock = [0.0]
    monkeypatch.setattr(doctor.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(doctor, "load_detector_pool", lambda loaded: Slow())
    finding = doctor.check_model(load_config(small_config()))
    assert finding.status == "warn"
    assert finding.detail.startswith("slow: 50.0 ms a frame")
    monkeypatch.undo()
    finding = found_by(doctor.check_model, load_config(small_config(model="/nowhere/m.onnx")))
    assert finding.status == "fail"
    assert "/nowhere/m.onnx" in finding.detail


class Lamps:
    def __init__(self):
        self.shown, self.closed = [], False

    def set(self, colour):
        self.shown.append(colour)

    def close(self):
        self.closed = True


def test_every_colour_is_shown_and_then_dark(small_config, monkeypatch):
    lamps = Lamps()
    monkeypatch.setattr(doctor, "open_light", lambda feedback: lamps)
    monkeypatch.setattr(doctor.time, "sleep", lambda s: None)
    config = load_config(small_config(), ["feedback.light=usb"])
    assert doctor.check_light(config).status == "ok"
    assert lamps.shown == [Colour.RED, Colour.ORANGE, Colour.GREEN, Colour.BLUE]
    assert lamps.closed
    assert doctor.check_light(load_config(small_config())).status == "warn"  # simulated


def test_a_light_that_fails_midway_is_darkened(small_config, monkeypatch):
    class Breaks(Lamps):
        def set(self, colour):
            raise FeedbackError("feedback.usb: does not answer; check the cable")

    lamps = Breaks()
    monkeypatch.setattr(doctor, "open_light", lambda feedback: lamps)
    finding = doctor.check_light(load_config(small_config()))
    assert (finding.status, finding.remedy) == ("fail", "check the cable")
    assert lamps.closed


def speaker(status, stderr=b""):
    return lambda *a, **k: subprocess.CompletedProcess(a, status, b"", stderr)


def test_the_speaker(small_config, monkeypatch):
    off, on = small_config(), ["feedback.sound.enabled=true", "feedback.sound.device=hw:7"]
    assert doctor.check_speaker(load_config(off)).status == "skipped"
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    finding = doctor.check_speaker(load_config(off, on))
    assert (finding.status, finding.remedy) == ("fail", "apt-get install alsa-utils")
    monkeypatch.setattr(doctor.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(doctor.subprocess, "run", speaker(0))
    assert doctor.check_speaker(load_config(off, on)).status == "ok"
    monkeypatch.setattr(doctor.subprocess, "run", speaker(1, b"ALSA\nno such card\n"))
    finding = doctor.check_speaker(load_config(off, on))
    assert (finding.status, finding.detail) == ("fail", "hw:7: no such card")


def test_the_broker(small_config, broker):
    config = small_config()
    assert doctor.check_broker(load_config(config)).status == "skipped"
    found = ["mqtt.enabled=true", f"mqtt.port={broker.port}", "mqtt.host=127.0.0.1"]
    finding = doctor.check_broker(load_config(config, found))
    assert finding.status == "ok"
    # A dead broker is no reason not to watch the crossing.
    found[1] = "mqtt.port=9"
    finding = doctor.check_broker(load_config(config, found))
    assert finding.status == "warn"
    assert "mqtt.host" in finding.remedy


@pytest.mark.parametrize(
    ("year", "said", "status"),
    [(2026, "yes", "ok"), (2026, "no", "warn"), (2026, None, "ok"), (1970, "yes", "warn")],
)
def test_the_clock(year, said, status, small_config, monkeypatch):
    class Then(dt.datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(year, 1, 2, tzinfo=tz)

    monkeypatch.setattr(doctor.dt, "datetime", Then)
    monkeypatch.setattr(doctor, "_output_of", lambda *command: said)
    finding = doctor.check_clock(load_config(small_config()))
    assert finding.status == status
    assert str(year) in finding.detail
    assert bool(finding.remedy) == (status == "warn")


def test_the_disk(small_config, tmp_path, monkeypatch):
    config = small_config()
    assert doctor.check_disk(load_config(config)).status == "skipped"
    path = f"audit.path={tmp_path}/new/folder/audit.jsonl"

    def free(mb):
        monkeypatch.setattr(
            doctor.shutil, "disk_usage", lambda folder: type("", (), {"free": mb * 1e6})
        )
        return doctor.check_disk(load_config(config, [path, "audit.max_mb=10", "audit.keep=9"]))

    assert free(5000).status == "ok"
    assert "nothing is logged" in free(499).detail
    finding = free(550)  # 500 to be kept free, 100 for the log
    assert finding.status == "warn"
    assert "may grow to 100 MB" in finding.detail
    monkeypatch.setattr(doctor.os, "access", lambda *a: False)
    assert "cannot be written" in free(5000).detail


def test_temperature_and_power_mode(small_config, tmp_path, monkeypatch):
    config = load_config(small_config())
    assert doctor.check_machine(config, tmp_path).status == "skipped"
    for name, text in (("thermal_zone0", "48500\n"), ("thermal_zone1", "no\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "temp").write_text(text)
    monkeypatch.setattr(doctor, "_output_of", lambda *command: "NV Power Mode: 15W\n0\n")
    finding = doctor.check_machine(config, tmp_path)
    assert (finding.status, finding.detail) == ("ok", "48 degrees C; NV Power Mode: 15W 0")
    (tmp_path / "thermal_zone0" / "temp").write_text("91000\n")
    assert doctor.check_machine(config, tmp_path).status == "warn"


def test_a_check_that_hangs_or_breaks_does_not_end_the_others(small_config):
    go = threading.Event()

    def hangs(loaded):
        go.wait(PATIENCE_S)
        return Finding("ok", "late")

    def breaks(loaded):
        raise ZeroDivisionError("a bug")

    todo = (
        ("hangs", hangs, 0.01),
        ("breaks", breaks, PATIENCE_S),
        ("works", lambda loaded: Finding("ok", "fine"), PATIENCE_S),
    )
    try:
        found = list(run_checks(load_config(small_config()), todo))
    finally:
        go.set()
    assert [(f.name, f.status) for f in found] == [
        ("hangs", "fail"),
        ("breaks", "fail"),
        ("works", "ok"),
    ]
    assert "no answer within 0.01 s" in found[0].detail
    assert "ZeroDivisionError: a bug" in found[1].detail


def test_all_that_was_promised_is_checked():
    names = {name for name, _, _ in checks()}
    assert names >= {"configuration", "camera", "model", "light", "speaker", "broker", "clock"}
    assert names >= {"disk", "machine"}
    assert all(limit_s > 0 for _, _, limit_s in checks())
