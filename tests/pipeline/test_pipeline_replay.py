"""`replay` as a function: the same decisions twice, whole files or none, warnings that help."""

from __future__ import annotations

import json
import logging
import os
import signal
from pathlib import Path

import pytest
from pipeline_fakes import FakeDetector, seen

from bikeped.capture.base import FrameSource
from bikeped.config.load import load_config
from bikeped.errors import BikepedError, CaptureError, GeometryError, TelemetryError
from bikeped.pipeline.replay import replay
from bikeped.telemetry.builders import decision_digest, decision_view, parse_event
from bikeped.types import Detections, Kind


class Script(FakeDetector):
    """A cyclist rides up to a waiting pedestrian; what is seen depends on the frame alone."""

    def detect(self, picture):
        n = picture.frame.number
        self.answer = seen((Kind.PEDESTRIAN, 30, 30), (Kind.CYCLIST, 90 - n, 31 + n % 3))
        return super().detect(picture)


def lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines()


def test_two_replays_decide_the_same_byte_for_byte(make_clip, small_config, tmp_path):
    clip = make_clip("ride.avi", 45)
    loaded = load_config(small_config(clip), ["decision.d_min_m=0.1"])
    digests, views = set(), set()
    for run in range(2):
        events = tmp_path / f"{run}.jsonl"
        result = replay(loaded, str(clip), detector=Script(), events=events)
        assert result.frames == 45
        found = lines(events)
        assert len(found) == 46
        assert [parse_event(line).frame for line in found[1:]] == list(range(45))
        digests.add(decision_digest(found))
        views.add(b"\n".join(map(decision_view, found)))
    assert len(digests) == len(views) == 1
    assert b'"ALERT"' in views.pop()


def test_the_realtime_replay_decides_the_same(make_clip, small_config, tmp_path):
    clip = make_clip("ride.avi", 15)
    loaded = load_config(small_config(clip))
    views = []
    for run, realtime in enumerate((False, True)):
        events = tmp_path / f"{run}.jsonl"
        replay(loaded, str(clip), detector=Script(), events=events, realtime=realtime)
        # Paced frames carry the clock's time: the header and `t` agree to the tenth of a ms.
        views.append([decision_view(line) for line in lines(events)][1:])
    assert views[0] == views[1]


def test_a_real_model_decodes_detects_and_says_safe(make_clip, small_config, tmp_path):
    clip = make_clip("c.avi", 12)
    events, overlay = tmp_path / "e.jsonl", tmp_path / "o.mp4"
    result = replay(load_config(small_config(clip)), str(clip), events=events, overlay=overlay)
    summary = result.as_dict()
    assert summary["tracks"] == {"pedestrian": 1}
    assert summary["states"] == {"IDLE": 1, "SAFE": 11}  # a track counts from its second sight
    assert summary["not_on_ground"] == 0
    assert summary["detections"] == 12
    assert summary["warnings"] == []
    assert set(summary["latency_ms"]) >= {"acquire", "pre", "inference", "total", "capture_age"}
    assert overlay.stat().st_size > 1000
    header = json.loads(lines(events)[0])
    assert len(header["model_hash"]) == 64
    assert header["config_hash"] == summary["config_hash"]


def test_junk_among_the_frames_is_counted_and_skipped(make_clip, small_config, small_jpegs):
    pictures = [small_jpegs[0], small_jpegs[1], small_jpegs[2][:300], b"\xff\xd8junk"]
    clip = make_clip("junk.avi", 20, pictures)
    result = replay(load_config(small_config(clip)), str(clip), detector=FakeDetector())
    assert (result.frames, result.undecodable) == (10, 10)


def test_nothing_that_decodes_is_an_error_and_leaves_no_file(
    make_clip, small_config, small_jpegs, tmp_path
):
    # The first picture must be whole for the file to be taken as a video at all.
    clip = make_clip("junk.avi", 3, [b"\xff\xd8\xff\xe0" + b"junk" * 50])
    out = tmp_path / "out"
    out.mkdir()
    files = {"events": out / "e.jsonl", "overlay": out / "o.mp4"}
    with pytest.raises(BikepedError, match=r"junk\.avi"):
        replay(load_config(small_config(clip)), str(clip), detector=FakeDetector(), **files)
    assert list(out.iterdir()) == []


def test_an_error_in_the_middle_leaves_no_half_written_file(
    make_clip, small_config, small_jpegs, tmp_path
):
    class Fails(FakeDetector):
        def detect(self, picture):
            if picture.frame.number == 7:
                raise CaptureError("the model file went away")
            return super().detect(picture)

    out = tmp_path / "out"
    out.mkdir()
    files = {"events": out / "e.jsonl", "overlay": out / "o.mp4"}
    clip = make_clip("c.avi", 10)
    with pytest.raises(CaptureError, match="went away"):
        replay(load_config(small_config(clip)), str(clip), detector=Fails(), **files)
    assert list(out.iterdir()) == []


def test_other_proportions_are_refused_with_both_files_named(make_clip, small_config):
    clip = make_clip("c.avi", 3)
    loaded = load_config(small_config(clip), ["camera.height=96"])
    with pytest.raises(GeometryError, match=r"small\.yaml.*c\.avi.*camera\.width"):
        replay(loaded, str(clip), detector=FakeDetector())


def test_a_scaled_copy_is_said_once_with_the_remedy(make_clip, small_config, caplog):
    clip = make_clip("c.avi", 9)
    loaded = load_config(
        small_config(clip), ["camera.width=192", "camera.height=128", "camera.radius_px=116"]
    )
    with caplog.at_level(logging.WARNING):
        result = replay(loaded, str(clip))
    said = [r.getMessage() for r in caplog.records if "scaled copies" in r.getMessage()]
    assert len(said) == 1
    assert "96 x 64" in said[0]
    assert "set camera.width" in said[0]
    assert result.warnings == said
    assert result.as_dict()["tracks"] == {"pedestrian": 1}  # the scale is right all the same


def test_detections_in_the_sky_mean_wrong_camera_settings(make_clip, small_config, caplog):
    clip = make_clip("c.avi", 25)
    loaded = load_config(small_config(clip), ["camera.pitch_deg=45"])
    with caplog.at_level(logging.WARNING):
        result = replay(loaded, str(clip))
    assert result.as_dict()["not_on_ground"] == 25
    assert "pitch_deg" in result.warnings[0]
    assert caplog.text.count("25 of 25 detections") == 1


def test_a_few_in_the_sky_mean_nothing(make_clip, small_config):
    clip = make_clip("c.avi", 25)
    detector = FakeDetector(seen((Kind.PEDESTRIAN, 48, 40), (Kind.PEDESTRIAN, 40, 45)))
    result = replay(load_config(small_config(clip)), str(clip), detector=detector)
    assert result.warnings == []


def test_the_lamps_of_the_crossing_are_not_touched(make_clip, small_config, caplog):
    clip = make_clip("c.avi", 12)
    # A relay board that is not there: `run` would report it at once.
    loaded = load_config(small_config(clip), ["feedback.light=usb"])
    with caplog.at_level(logging.INFO):
        replay(loaded, str(clip))
    assert "simulated light: green" in caplog.text
    assert "usb" not in caplog.text.lower()


def test_a_camera_is_no_recording(small_config, monkeypatch):
    class Camera(FrameSource):
        name, live = "/dev/video0", True

        def read(self):
            return None

        def close(self):
            pass

    monkeypatch.setattr("bikeped.pipeline.replay.open_source", lambda *a, **k: Camera())
    with pytest.raises(BikepedError, match="bikeped run"):
        replay(load_config(small_config()), "/dev/video0", detector=FakeDetector())


def test_without_a_model_the_key_is_named(make_clip, small_config):
    clip = make_clip("c.avi", 3)
    with pytest.raises(BikepedError, match=r"small\.yaml.*detection\.model"):
        replay(load_config(small_config(clip), ["detection.model=null"]), str(clip))


def test_an_event_file_that_cannot_be_written_stops_before_the_replay(make_clip, small_config):
    detector = FakeDetector(Detections.empty())
    events = Path("/nowhere/e.jsonl")
    clip = make_clip("c.avi", 3)
    with pytest.raises(TelemetryError, match="/nowhere"):
        replay(load_config(small_config(clip)), str(clip), detector=detector, events=events)
    assert detector.calls == 0


def test_an_interrupt_ends_with_what_there_is_and_says_so(make_clip, small_config, tmp_path):
    clip = make_clip("ride.avi", 300)
    events = tmp_path / "events.jsonl"

    def interrupt(frames: int) -> None:
        if frames == 5:
            os.kill(os.getpid(), signal.SIGINT)

    result = replay(
        load_config(small_config(clip)),
        str(clip),
        detector=Script(),
        events=events,
        progress=interrupt,
    )
    assert result.interrupted
    assert result.as_dict()["interrupted"] is True
    assert 5 <= result.frames < 300
    assert len(lines(events)) == result.frames + 1
