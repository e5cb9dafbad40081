"""`bikeped align`: the fit and the grid without a browser, and the page's server."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from urllib.request import urlopen

import cv2
import msgspec
import numpy as np
import pytest

from bikeped.cli.main import main
from bikeped.config.build import framing, ground_camera
from bikeped.config.load import load_config
from bikeped.geometry.alignment import Alignment

#: Metres ahead and to the right; the small camera looks down at them.
AT = ((4.0, -1.0), (6.0, 1.5), (9.0, -2.0), (12.0, 3.0))


@pytest.fixture
def site(tmp_path: Path, small_config: Callable[..., Path], make_clip: Callable[..., Path]):
    """A clip of the small camera, its configuration, and points as a camera 5.6 m high, pitched
    -31 degrees, sees them."""
    config = small_config()
    clip = make_clip("site.avi", 5)
    loaded = load_config(config)
    camera = ground_camera(loaded)
    truth = replace(Alignment.of(camera), height_m=5.6, pitch_deg=-31.0).camera(camera)
    uv = framing(loaded).crop_to_frame(truth.project(AT)[0])
    points = {
        "frame": {"width": 96, "height": 64},
        "mark_px": 0.05,
        "marks": [
            {
                "name": str(i + 1),
                "u": u,
                "v": v,
                "distance_m": float(np.hypot(*AT[i])),
                "right_m": AT[i][1],
            }
            for i, (u, v) in enumerate(uv.tolist())
        ],
    }
    file = tmp_path / "points.json"
    file.write_text(json.dumps(points))
    return clip, config, file, points


def run(*arguments: object) -> int:
    return main([str(a) for a in ("align", *arguments)])


def test_a_points_file_gives_the_fit(site, capsys: pytest.CaptureFixture[str]) -> None:
    clip, config, points, _ = site
    assert run(clip, "-c", config, "--points", points, "--json", "-") == 0
    data = json.loads(capsys.readouterr().out)
    assert data["values"]["height_m"] == pytest.approx(5.6, abs=1e-3)
    assert data["values"]["pitch_deg"] == pytest.approx(-31, abs=1e-2)
    assert data["agrees"]
    assert data["spare_measurements"] == 6
    assert run(clip, "-c", config, "--points", points) == 0
    out = capsys.readouterr().out
    assert "camera.height_m" in out
    assert "5.6000" in out
    assert "a mark at 10 m reads 10 m +/-" in out


def test_names_of_marks_are_text_whatever_they_look_like(site, capsys) -> None:
    clip, config, points, written = site
    names = ("[/nope]", "[red]", "[bold]kerb", "4")
    for mark, name in zip(written["marks"], names, strict=False):
        mark["name"] = name
    points.write_text(json.dumps(written))
    assert run(clip, "-c", config, "--points", points) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in names[: len(written["marks"])])


def test_save_writes_the_fit_and_keeps_the_file_before(site, capsys) -> None:
    clip, config, points, _ = site
    before = config.read_text()
    assert run(clip, "-c", config, "--points", points, "--save") == 0
    assert "wrote camera.height_m, camera.pitch_deg" in capsys.readouterr().out
    assert load_config(config).config.camera.height_m == pytest.approx(5.6, abs=1e-3)
    [backup] = config.parent.glob("small.yaml.*.bak")
    assert backup.read_text() == before


def test_marks_that_disagree_end_with_1(site, capsys) -> None:
    clip, config, points, data = site
    data["marks"][3]["distance_m"] += 5
    points.write_text(json.dumps(data))
    assert run(clip, "-c", config, "--points", points) == 1
    assert "the others agree without mark 4" in capsys.readouterr().out


def test_the_grid_is_drawn_over_a_frame(site, tmp_path: Path) -> None:
    clip, config, points, _ = site
    plain, fitted = tmp_path / "plain.png", tmp_path / "fitted.jpg"
    assert run(clip, "-c", config, "--grid", plain, "--at", 0.1) == 0
    assert run(clip, "-c", config, "--grid", fitted, "--points", points) == 0
    for file in (plain, fitted):
        assert cv2.imread(str(file)).shape == (64, 96, 3)
    assert not np.array_equal(cv2.imread(str(plain)), cv2.imread(str(fitted)))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("nothing.jpg",), "nothing.jpg: no such file"),
        (("{clip}", "--at", "99"), "ends before 99 s"),
        (("{clip}", "--save"), "--points: missing"),
        (("{clip}", "--grid", "{folder}/a.gif"), "name a .png or .jpg"),
        (("{clip}", "--grid", "{clip}"), "is FRAME, which would be overwritten"),
        (("{clip}", "--points", "{points}", "--json", "{points}"), "is --points, which would be"),
        (("{clip}", "--points", "{folder}/none.json"), "none.json: cannot be read"),
        (("{clip}", "--points", "{config}"), "export the marks from the align page anew"),
        (("{clip}", "--set", "camera.width=120", "--points", "{points}"), "camera.width"),
        (("{clip}", "--set", "web.host=0.0.0.0"), "web.token_file"),
    ],
)
def test_bad_input_ends_in_one_line(site, tmp_path: Path, capsys, arguments, says) -> None:
    clip, config, points, _ = site
    names = {"clip": clip, "folder": tmp_path, "points": points, "config": config}
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()}
    assert run(*(a.format(**names) for a in arguments), "-c", config) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()} == before


def test_marks_that_do_not_tell_end_with_2(site, capsys) -> None:
    clip, config, points, data = site
    for change, says in (
        ({"marks": data["marks"][:1], "free": ["height_m", "pitch_deg", "cx"]}, "add 1 more"),
        ({"marks": [data["marks"][0]] * 2}, "1 occurs twice"),
        ({"between": [{"first": "1", "second": "9", "distance_m": 2}]}, "no mark 9"),
        (
            {
                "values": {
                    **dict.fromkeys(("radius_px", "cx", "cy"), 50),
                    "height_m": 500,
                    "pitch_deg": 0,
                }
            },
            "height_m",
        ),
        ({"frame": {"width": 100, "height": 100}}, "camera.width"),
        ({"surprise": 1}, "surprise"),
    ):
        points.write_text(json.dumps({**data, **change}))
        assert run(clip, "-c", config, "--points", points) == 2
        assert says in capsys.readouterr().err


def test_the_page_is_served_until_interrupted(site) -> None:
    clip, config, _, _ = site
    command = [sys.executable, "-m", "bikeped.cli.main", "align", str(clip), "-c", str(config)]
    with subprocess.Popen(
        [*command, "--no-browser"],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("site.avi: http://127.0.0.1:")
        url = line.split()[1]
        with urlopen(url.replace("/align", "/align/frame.jpg")) as answer:
            assert answer.read(2) == b"\xff\xd8"
        with urlopen(url.replace("/align", "/align/state")) as answer:
            state = msgspec.json.decode(answer.read())
        assert not state["live"]
        assert state["cannot_save"] is None
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
