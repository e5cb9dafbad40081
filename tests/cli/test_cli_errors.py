"""Bad input: one clear line on standard error, exit status 2, nothing half-written."""

from __future__ import annotations

import re

import pytest

from bikeped.cli.main import COMMANDS, main


@pytest.fixture
def refused(capsys):
    """Runs a command line that must be refused; the one line that it says."""

    def run(*arguments):
        assert main([str(a) for a in arguments]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        lines = err.strip().splitlines()
        assert len(lines) == 1, err
        assert lines[0].startswith("bikeped: ")
        return lines[0]

    return run


def test_unknown_command_and_option(refused):
    assert "'fly'" in refused("fly")
    assert "bikeped replay --help" in refused("replay", "x.avi", "--fast")
    assert "VIDEO" in refused("replay")
    assert "log-level" in refused("--log-level", "loud", "config", "check")


def test_without_a_command_the_help_is_shown(capsys):
    assert main([]) == 2
    assert "Commands:" in capsys.readouterr().err
    assert main(["config"]) == 2
    assert "schema" in capsys.readouterr().err


def test_help_lists_every_command_and_each_has_one(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in COMMANDS:
        assert re.search(rf"^  {name} ", text, re.MULTILINE)
        assert main([name, "--help"]) == 0
        assert "Usage: bikeped" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["run", "replay", "doctor", "config check", "demo"])
def test_a_configuration_that_is_not_there(refused, command, tmp_path):
    words = command.split() + (["x.avi"] if command == "replay" else [])
    assert "none.yaml" in refused(*words, "-c", tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("camera.wdith=3", r"camera\.wdith.*width"),
        ("nothing=3", "nothing"),
        ("camera.fps", "camera.fps"),
        ("camera.fps=fast", r"camera\.fps"),
        ("camera.fps=-1", r"camera\.fps"),
        ("camera=3", "camera"),
    ],
)
def test_a_bad_override_names_its_key(refused, small_config, override, said):
    for command in (["config", "check"], ["doctor"], ["replay", "x.avi"]):
        assert re.search(said, refused(*command, "-c", small_config(), "--set", override))


def test_a_key_that_is_unknown_names_file_and_key(refused, small_config):
    config = small_config(more="tracking: {match_radius: 3}\n")
    assert re.search(
        r"small\.yaml.*tracking\.match_radius", refused("config", "check", "-c", config)
    )


def test_the_video(refused, small_config, make_clip, tmp_path):
    config = small_config()
    assert "none.avi" in refused("replay", tmp_path / "none.avi", "-c", config)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "holds no images" in refused("replay", empty, "-c", config)
    text = tmp_path / "text.avi"
    text.write_text("this is no video\n" * 100)
    assert "text.avi" in refused("replay", text, "-c", config)
    zero = tmp_path / "zero.mp4"
    zero.write_bytes(b"")
    assert "zero.mp4" in refused("replay", zero, "-c", config)


def test_the_model(refused, small_config, make_clip, tmp_path):
    clip = make_clip("c.avi", 3)
    out = tmp_path / "out"

    def replayed(model):
        line = refused("replay", clip, "-c", small_config(model=model), "--out", out)
        assert list(out.iterdir()) == []
        return line

    assert "/nowhere/m.onnx" in replayed("/nowhere/m.onnx")
    assert "detection.model" in replayed("null")
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no model")
    assert "broken.onnx" in replayed(broken)
    assert "neither .onnx nor .engine" in replayed(clip)


def test_other_proportions(refused, small_config, make_clip):
    line = refused(
        "replay", make_clip("c.avi", 3), "-c", small_config(), "--set", "camera.height=96"
    )
    assert re.search(r"small\.yaml.*c\.avi.*camera\.width", line)


def test_outputs_that_cannot_be_written_are_refused_before_the_work(
    refused, small_config, make_clip, tmp_path
):
    clip, config = make_clip("c.avi", 3), small_config()
    file = tmp_path / "file"
    file.write_text("")
    replay = ("replay", clip, "-c", config)
    assert "file" in refused(*replay, "--out", file)
    assert "below" in refused(*replay, "--out", file / "below")
    assert "none" in refused(*replay, "--events", tmp_path / "none" / "e.jsonl")
    assert "none" in refused(*replay, "--overlay", tmp_path / "none" / "o.mp4")
    assert ".mp4" in refused(*replay, "--overlay", tmp_path / "o.avi")
    assert "--json" in refused(*replay, "--json", tmp_path / "none" / "s.json")
    assert "--json" in refused("doctor", "-c", config, "--json", tmp_path / "none" / "s.json")
    assert "--out" in refused("demo", "--out", file / "below")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c.avi", "file", "small.yaml"]


def test_an_interrupt_ends_with_130(monkeypatch, capsys, small_config, make_clip):
    def interrupted(*a, **k):
        raise KeyboardInterrupt

    monkeypatch.setattr("bikeped.cli.run.load_config", interrupted)
    assert main(["replay", "x.avi"]) == 130
    assert "interrupted" in capsys.readouterr().err
