"""replay, demo, config and doctor from the command line, when all is well."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import cv2
import jsonschema
import pytest

from bikeped.cli.main import main
from bikeped.pipeline import doctor as checks
from bikeped.pipeline.doctor import Finding

SCHEMAS = Path(__file__).parents[2] / "docs" / "messages"


def validate_events(path: Path) -> list[dict[str, object]]:
    header, frame = (
        json.loads((SCHEMAS / f"event-{name}.schema.json").read_text())
        for name in ("header", "frame")
    )
    lines = [json.loads(line) for line in path.read_bytes().splitlines()]
    jsonschema.validate(lines[0], header)
    for line in lines[1:]:
        jsonschema.validate(line, frame)
    return lines[1:]


def test_replay_leaves_overlay_events_and_summary(make_clip, small_config, tmp_path, capsys):
    clip, out = make_clip("c.avi", 20), tmp_path / "out"
    assert main(["replay", str(clip), "-c", str(small_config()), "--out", str(out)]) == 0
    assert sorted(p.name for p in out.iterdir()) == ["events.jsonl", "overlay.mp4", "summary.json"]
    assert len(validate_events(out / "events.jsonl")) == 20
    video = cv2.VideoCapture(str(out / "overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 20
    video.release()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["tracks"] == {"pedestrian": 1}
    text = capsys.readouterr().out
    assert "20 frames, 0.6 s of recording" in text
    assert "tracks: 1 pedestrian" in text
    stages = ("acquire", "pre", "inference", "post", "track", "decide", "feedback", "total")
    for stage in (*stages, "capture_age"):
        assert f"\n{stage} " in text
    for figure in ("mean", "p50", "p95", "p99", "max"):
        assert figure in text


def test_json_to_standard_output_is_nothing_but_json(make_clip, small_config, capsys, tmp_path):
    clip, config = make_clip("c.avi", 5), str(small_config())
    events = str(tmp_path / "e.jsonl")
    replay = ["replay", str(clip), "-c", config, "--events", events, "--json", "-"]
    for command in (
        replay,
        ["config", "check", "-c", config, "--json", "-"],
        ["config", "show", "-c", config, "--json", "-"],
        ["config", "schema", "--json", "-"],
        ["doctor", "-c", config, "--no-light", "--json", "-"],
    ):
        main(command)
        assert isinstance(json.loads(capsys.readouterr().out), dict)


def test_json_to_a_file_keeps_the_table(make_clip, small_config, capsys, tmp_path):
    clip, target = make_clip("c.avi", 5), tmp_path / "s.json"
    command = ["replay", str(clip), "-c", str(small_config()), "--json", str(target)]
    assert main(command) == 0
    assert json.loads(target.read_text())["frames"] == 5
    assert "5 frames" in capsys.readouterr().out


def test_a_folder_of_pictures_is_a_recording(small_jpegs, small_config, tmp_path, capsys):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for n, jpeg in enumerate(small_jpegs):
        (folder / f"{n}.jpg").write_bytes(jpeg)
    assert main(["replay", str(folder), "-c", str(small_config())]) == 0
    assert f"{len(small_jpegs)} frames" in capsys.readouterr().out


def test_a_demo_whose_page_finds_its_port_taken_says_so_before_it_draws(tmp_path, capsys):
    out = tmp_path / "demo"
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["demo", "--web", str(port), "--out", str(out)]) == 2
    assert f":{port}" in capsys.readouterr().err
    assert not out.exists()


def test_the_demo_end_to_end_in_short(tmp_path, capsys, caplog):
    out = tmp_path / "demo"
    assert main(["demo", "--seconds", "0.5", "--out", str(out), "--json", "-"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frames"] == 15
    assert "small-int8.onnx" in summary["detector"]
    assert "must not" in summary["notice"]
    assert "latency_ms" in summary
    assert len(validate_events(out / "events.jsonl")) == 15
    names = {p.name for p in out.iterdir()}
    assert names == {
        "crossing.avi",
        "crossing.boxes.jsonl",
        "events.jsonl",
        "overlay.mp4",
        "summary.json",
        "summary.txt",
    }
    assert json.loads((out / "summary.json").read_text()) == summary
    assert "must not" in (out / "summary.txt").read_text()
    assert caplog.records == [], "the drawn clip is the configured camera's: nothing to warn of"


def test_config_check_and_show(small_config, capsys):
    config = str(small_config())
    assert main(["config", "check", "-c", config]) == 0
    assert "valid; configuration" in capsys.readouterr().out
    assert main(["config", "show", "-c", config, "--set", "camera.fps=25"]) == 0
    assert "fps: 25" in capsys.readouterr().out
    assert main(["config", "schema"]) == 0
    schema = json.loads(capsys.readouterr().out)
    jsonschema.Draft202012Validator.check_schema(schema)


@pytest.fixture
def findings(monkeypatch):
    """Makes the doctor find what the test says."""

    def find(*found: Finding) -> None:
        todo = tuple((f.name, lambda loaded, f=f: f, 20) for f in found)
        monkeypatch.setattr("bikeped.cli.doctor.checks", lambda **options: todo)

    return find


FINE = Finding("ok", "30 frames/s [measured]", name="camera")
ODD = Finding("warn", "not synchronised", "timedatectl set-ntp true", "clock")
BAD = Finding("fail", "no such file", "name one", "model")


def test_doctor_says_what_to_do_and_fails_only_for_what_the_service_needs(
    findings, small_config, capsys, tmp_path
):
    config = ["-c", str(small_config())]
    findings(FINE, ODD)
    assert main(["doctor", *config]) == 0
    text = capsys.readouterr().out
    assert "30 frames/s [measured]" in text
    assert "-> timedatectl set-ntp true" in text
    findings(FINE, BAD, ODD)
    target = tmp_path / "doctor.json"
    assert main(["doctor", *config, "--json", str(target)]) == 1
    assert "fail" in capsys.readouterr().out
    report = json.loads(target.read_text())
    assert not report["ok"]
    assert report["checks"][1] == {
        "name": "model",
        "status": "fail",
        "detail": "no such file",
        "remedy": "name one",
        "mend": "name one",
    }


def test_doctor_on_a_broken_configuration_is_a_finding(small_config, capsys):
    config = small_config(more="tracking: {match_radius: 3}\n")
    assert main(["doctor", "-c", str(config), "--json", "-"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert [c["name"] for c in report["checks"]] == ["configuration"]
    assert "tracking.match_radius" in report["checks"][0]["detail"]


def test_doctor_leaves_lamps_and_speaker_alone_when_asked(monkeypatch, small_config, capsys):
    touched = []
    monkeypatch.setattr(checks, "open_light", touched.append)
    command = ["doctor", "-c", str(small_config()), "--no-light", "--no-sound", "--json", "-"]
    assert main(command) == 1  # there is no camera
    report = {c["name"]: c for c in json.loads(capsys.readouterr().out)["checks"]}
    assert report["light"]["status"] == report["speaker"]["status"] == "skipped"
    assert report["camera"]["status"] == "fail"
    assert touched == []
