"""No command writes over what it reads."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from bikeped.cli.main import main


@pytest.fixture
def config(tmp_path: Path) -> Path:
    file = tmp_path / "pole.yaml"
    file.write_text("camera: {radius_px: 1750, fov_deg: 197.9}\n", encoding="utf-8")
    return file


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(a) for a in arguments]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err


@pytest.mark.parametrize("option", ["--overlay", "--events", "--json"])
def test_a_recording_is_not_written_over(capsys, tmp_path, option):
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"a recording")
    assert "would be overwritten" in refused(capsys, "replay", clip, option, clip)
    link = tmp_path / "link.mp4"
    link.symlink_to(clip)
    assert "would be overwritten" in refused(capsys, "replay", link, option, clip)
    assert "would be overwritten" in refused(capsys, "replay", clip, option, link)
    assert clip.read_bytes() == b"a recording"


def test_nor_by_the_names_in_an_output_folder(capsys, tmp_path):
    clip = tmp_path / "overlay.mp4"
    clip.write_bytes(b"a recording")
    assert "would be overwritten" in refused(capsys, "replay", clip, "--out", tmp_path)
    assert clip.read_bytes() == b"a recording"


def test_a_folder_of_pictures_is_not_written_into(capsys, tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    (folder / "1.json").write_text("kept")
    assert "lies in VIDEO" in refused(capsys, "replay", folder, "--json", folder / "1.json")
    assert (folder / "1.json").read_text() == "kept"


@pytest.mark.parametrize(
    "arguments",
    [
        ("config", "show", "--json"),
        ("config", "check", "--json"),
        ("conformance", "compare", "--json"),
        ("conformance", "register", "--out"),
        ("conformance", "run", "--audit"),
    ],
)
def test_a_configuration_is_not_written_over(capsys, config, arguments):
    *command, option = arguments
    before = config.read_text()
    assert "is -c, which would be overwritten" in refused(
        capsys, *command, "-c", config, option, config
    )
    assert config.read_text() == before


def test_two_outputs_need_two_files(capsys, tmp_path):
    clip = tmp_path / "clip.avi"
    clip.write_bytes(b"x")
    one = tmp_path / "out.json"
    assert "is also --json" in refused(capsys, "replay", clip, "--json", one, "--events", one)
    assert not one.exists()


def test_an_output_that_is_a_folder_is_refused_before_any_work(capsys, tmp_path):
    clip = tmp_path / "clip.avi"
    clip.write_bytes(b"x")
    assert "--events" in refused(capsys, "replay", clip, "--events", tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["clip.avi"]


def test_seconds_must_be_a_number(capsys, tmp_path):
    out = tmp_path / "out"
    assert "--seconds" in refused(capsys, "demo", "--seconds", math.nan, "--out", out)
    assert not out.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ("testbench", "export", "{file}", "-c", "{file}"),
        ("conformance", "register", "-c", "{file}", "--out", "{file}"),
        ("conformance", "optimize", "-c", "{file}", "--out", "{file}"),
        ("calibrate", "{pictures}", "--pattern", "8x6", "-c", "{file}", "--out", "{file}"),
        ("calibrate", "{file}", "--pattern", "8x6", "--out", "{file}"),
        ("scene", "safe-crossing", "-c", "{file}", "--out", "{file}"),
    ],
)
def test_a_file_without_a_suffix_is_a_file_all_the_same(capsys, tmp_path, config, arguments):
    file, pictures = tmp_path / "pole", tmp_path / "pictures"
    file.write_text(config.read_text())
    pictures.mkdir()
    words = [a.format(file=file, pictures=pictures) for a in arguments]
    assert "would be overwritten" in refused(capsys, *words)
    assert file.read_text() == config.read_text()


def test_a_calibration_is_no_folder(capsys, tmp_path):
    pictures, out = tmp_path / "pictures", tmp_path / "out"
    pictures.mkdir()
    out.mkdir()
    told = refused(capsys, "calibrate", pictures, "--pattern", "8x6", "--out", out)
    assert "cannot be written" in told
    assert list(out.iterdir()) == []


def test_the_lens_that_a_calibration_writes_by_itself_is_an_output_too(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    words = ("calibrate", pictures, "--pattern", "8x6")
    lens = tmp_path / "camera_calibration.json"
    for option in ("--json", "--report"):
        assert "the lens" in refused(capsys, *words, option, lens)
        assert not lens.exists()
    lens.write_text("deployed")
    assert "the lens" in refused(capsys, *words, "--json", lens)
    told = refused(capsys, *words, "--out", lens, "--json", f"{lens}.bak")
    assert "the former lens" in told
    assert lens.read_text() == "deployed"


def test_the_demo_does_not_write_over_its_configuration_or_its_own_files(capsys, tmp_path, config):
    out = tmp_path / "out"
    out.mkdir()
    own = out / "summary.json"
    own.write_text(config.read_text())
    assert "is -c" in refused(capsys, "demo", "--out", out, "-c", own, "--seconds", "0.2")
    assert own.read_text() == config.read_text()
    told = refused(capsys, "demo", "--out", out, "--json", out / "events.jsonl")
    assert "is also --out" in told
    assert [p.name for p in out.iterdir()] == ["summary.json"]


def test_the_boxes_beside_a_clip_are_an_output_too(capsys, tmp_path):
    words = ("scene", "safe-crossing", "--out", tmp_path / "c.avi", "--size", "320x180")
    told = refused(capsys, *words, "--json", tmp_path / "c.boxes.jsonl")
    assert "boxes" in told
    assert list(tmp_path.iterdir()) == []


def test_an_equals_sign_in_a_folder_is_no_name(tmp_path):
    folder = tmp_path / "seed=1"
    folder.mkdir()
    board = folder / "board.pdf"
    assert main(["calibrate", "--board", str(board), "--pattern", "8x6"]) == 0
    assert board.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", ".", "--pattern", "8x6", "--square", "nan"),
        ("model", "evaluate", "m.onnx", "data", "--confidence", "nan"),
        ("model", "evaluate", "m.onnx", "data", "--iou", "nan"),
        ("conformance", "montecarlo", "--burst", "nan"),
    ],
)
def test_what_is_no_number_is_in_no_range(capsys, words):
    assert "nan is not a number" in refused(capsys, *words)


def test_a_scenario_counts_once(capsys, tmp_path):
    words = ("conformance", "pixels", "--scenario", "E-Scooter", "--scenario", "E-Scooter")
    assert "twice" in refused(capsys, *words)


def test_a_folder_for_figures_that_cannot_be_is_told_before_anything_is_drawn(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    told = refused(capsys, "conformance", "pixels", "--figures", tmp_path / "file" / "figures")
    assert "choose another --figures" in told


def test_a_pipe_is_written_to_not_replaced(tmp_path):
    import os
    import stat
    import threading

    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()))
    reader.start()
    assert main(["config", "check", "--json", str(pipe)]) == 0
    reader.join(20)
    assert read
    assert '"' in read[0]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
