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
    assert "is --json, too" in refused(capsys, "replay", clip, "--json", one, "--events", one)
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
