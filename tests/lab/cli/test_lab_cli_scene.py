"""`bikeped scene` from the outside."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import pytest

from bikeped.cli.main import main
from bikeped.lab.rendering import read_sidecar, sidecar_path
from bikeped.lab.scenarios.scenario import bundled_folder

SMALL = ("--size", "320x180")


def test_a_clip_of_a_bundled_scenario(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "clip.avi"
    arguments = ["scene", "E-Scooter", "--out", str(out), *SMALL, "--fps", "5", "--seconds", "3"]
    assert main([*arguments, "--light", "dusk", "--json", "-"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["frames"] == 15
    assert summary["seen"]["pedestrian"] == 1
    assert summary["conditions"]["light"] == "dusk"
    assert out.stat().st_size > 10_000
    assert len(read_sidecar(sidecar_path(out)).frames) == 15


def test_a_still_with_boxes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain, marked = tmp_path / "a.png", tmp_path / "b.png"
    assert main(["scene", "safe-crossing", *SMALL, "--still", "4", str(plain)]) == 0
    assert main(["scene", "safe-crossing", *SMALL, "--still", "4", str(marked), "--boxes"]) == 0
    one, two = cv2.imread(str(plain)), cv2.imread(str(marked))
    assert one is not None
    assert two is not None
    assert one.shape == (180, 320, 3)
    assert (one != two).any()
    assert "pedestrian" in capsys.readouterr().out


def test_a_data_set(tmp_path: Path) -> None:
    out = tmp_path / "set"
    assert (
        main(["scene", "--dataset", "2", "--out", str(out), *SMALL, "--lens", "rectilinear"]) == 0
    )
    assert len(list((out / "images").iterdir())) == 2
    assert main(["scene", "--dataset", "2", "--out", str(out), *SMALL]) == 2


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nobody", "--out", "x.avi"], "no bundled scenario"),
        (["safe-crossing"], "--out"),
        ([], "SCENARIO"),
        (["safe-crossing", "--out", "x.avi", "--still", "1", "y.png"], "--out"),
        (["safe-crossing", "--out", "x.mp4"], "x.mp4"),
        (["safe-crossing", "--out", "x.avi", "--size", "big"], "--size"),
        (["safe-crossing", "--out", "x.avi", "--size", "320x320"], "--size"),
        (["safe-crossing", "--out", "x.avi", "--seconds", "nan"], "--seconds"),
        (["safe-crossing", "--out", "x.avi", "--boxes"], "--boxes"),
        (["safe-crossing", "--still", "99", "y.png"], "--still"),
        (["safe-crossing", "--still", "1", "y.gif"], "y.gif"),
        (["safe-crossing", "--dataset", "2", "--out", "s"], "--dataset"),
        (["--dataset", "2"], "--dataset"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if "--size" not in arguments:
        arguments = [*arguments, *SMALL]
    assert main(["scene", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error
    assert list(tmp_path.iterdir()) == []


def test_a_scenario_is_never_written_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = tmp_path / "mine.yaml"
    shutil.copy(bundled_folder() / "safe-crossing.yaml", scenario)
    before = scenario.read_bytes()
    still = tmp_path / "mine.png"
    still.symlink_to(scenario)
    for target in (("--out", str(scenario)), ("--still", "1", str(still))):
        assert main(["scene", str(scenario), *target, *SMALL]) == 2
        assert "SCENARIO" in capsys.readouterr().err
    assert scenario.read_bytes() == before
