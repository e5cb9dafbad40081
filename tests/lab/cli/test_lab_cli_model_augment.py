"""`bikeped model augment` on the command line."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest
from coco_sets import annotation, write_set

from bikeped.cli.main import main

SMALL = ("--size", "96", "--processes", "1")


@pytest.fixture
def file(tmp_path):
    return write_set(tmp_path / "set", [annotation(1, 1, 1, [60, 40, 200, 160])], images=2)


def test_augment_writes_a_set_and_says_so(file, tmp_path, capsys):
    out, told = tmp_path / "out", tmp_path / "told.json"
    given = "--copies 2 --projection equisolid --fov-deg 190 200 --seed 7 --picture-fov-deg 90 100"
    level = "--yaw-deg 0 0 --pitch-deg 0 0"
    words = [str(file.parent), "--out", str(out), "--json", str(told), *SMALL]
    status = main(["model", "augment", *words, *given.split(), *level.split()])
    assert status == 0
    text = capsys.readouterr().out
    assert "2 pictures became 4" in text
    assert "seed 7" in text
    assert "person" in text
    summary = json.loads(told.read_text())
    assert (summary["pictures"], summary["objects"], summary["seed"]) == (4, 2, 7)
    new = json.loads((out / "annotations.json").read_text())
    assert {i["warp"]["projection"] for i in new["images"]} == {"equisolid"}
    assert all(190 <= i["warp"]["fov_deg"] <= 200 for i in new["images"])
    assert all(i["warp"]["yaw_deg"] == 0 for i in new["images"])


def test_json_alone_on_standard_output(file, tmp_path, capsys):
    given = ["model", "augment", str(file), "--out", str(tmp_path / "o"), "--json", "-", *SMALL]
    assert main(given) == 0
    assert json.loads(capsys.readouterr().out)["pictures"] == 2


def test_json_never_over_the_data(file, tmp_path, capsys):
    for target in (file, file.parent / "images" / "001.jpg"):
        given = ["model", "augment", str(file.parent), "--out", str(tmp_path / "o")]
        before = target.read_bytes()
        assert main([*given, "--json", str(target), *SMALL]) == 2
        assert target.read_bytes() == before
        assert "would" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["none", "--out", "o"], "none: does not exist"),
        (["{set}", "--out", "{set}"], "exists already"),
        (["{set}", "--out", "{set}/new"], "the data's own folder"),
        (["{set}"], "--out"),
        (["{set}", "--out", "o", "--fov-deg", "200", "100"], "fov-deg: 200 to 100"),
        (["{set}", "--out", "o", "--fov-deg", "x", "100"], "x"),
        (["{set}", "--out", "o", "--copies", "0"], "copies"),
        (["{set}", "--out", "o", "--seed", "-1"], "seed"),
        (["{set}", "--out", "o", "--projection", "fish"], "projection"),
        (["{set}", "--out", "o", "--images", "nowhere"], "nowhere: is no folder"),
    ],
)
def test_bad_input_is_one_line_and_status_2(file, tmp_path, monkeypatch, capsys, given, message):
    monkeypatch.chdir(tmp_path)
    words = [word.format(set=file.parent) for word in given]
    assert main(["model", "augment", *words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("bikeped: ")
    assert error.count("\n") == 1
    assert message in error
    assert not (tmp_path / "o").exists()


def test_the_help_tells_the_defaults_of_the_code():
    from bikeped.lab.cli.model_augment import command
    from bikeped.lab.training.augment import AugmentSettings
    from bikeped.lab.training.warp import WarpRanges

    ranges = WarpRanges()
    told = {option.name: option for option in command.params}
    for name, value in asdict(ranges).items():
        if name == "projections":
            assert told[name].type.choices == list(value) or tuple(told[name].type.choices) == value
        elif name == "size_px":
            assert told[name].default == value
        else:
            least, most = value
            assert told[name].help.endswith(f"Default: {least:g} {most:g}.")
    assert told["least_share"].default == AugmentSettings().least_share
    assert told["processes"].default == AugmentSettings().processes
