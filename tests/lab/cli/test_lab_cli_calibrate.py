"""`bikeped calibrate` from files to files, on drawn boards and on the real ones."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from board_render import RenderStyle, draw_picture
from shared_inputs import SHARED, missing
from synthetic_boards import BoardPose, DrawnCamera, spread_poses, turn

from bikeped.cli.main import main
from bikeped.config.build import ground_camera
from bikeped.config.load import load_config
from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern, BoardView
from bikeped.lab.calibration.solver.lens_model import CornerObservations
from bikeped.lab.cli.calibrate_run import partial_board_lines

PATTERN = BoardPattern(8, 6, 0.1)
REAL = SHARED / "media" / "fisheye-checkerboard"
LENS = Lens("equidistant", 150.0, math.radians(92))
CAMERA = DrawnCamera(LENS, 243.0, 246.0, 480, 480)
STYLE = RenderStyle(samples=2)


def draw(folder: Path, camera: DrawnCamera, poses: list[BoardPose], start: int = 0) -> list[Path]:
    """Pictures of one board each."""
    paths = []
    for number, pose in enumerate(poses):
        picture = draw_picture(camera, PATTERN, pose, style=STYLE, seed=start + number)
        paths.append(folder / f"board{start + number:02d}.png")
        cv2.imwrite(str(paths[-1]), picture)
    return paths


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight boards through a known lens."""
    folder = tmp_path_factory.mktemp("boards")
    draw(folder, CAMERA, spread_poses(CAMERA, PATTERN, 8, seed=3, span_deg=(45, 75)))
    return folder


@pytest.fixture
def calibrate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Runs the command in an empty folder: status, standard output, standard error."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)

    def run(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = main(["calibrate", *(str(a) for a in arguments)])
        said = capsys.readouterr()
        return status, said.out, said.err

    return run


Run = Callable[..., tuple[int, str, str]]


def test_pictures_become_a_file_a_page_and_figures(calibrate: Run, pictures: Path) -> None:
    status, out, err = calibrate(
        pictures, "--pattern", "8x6", "--compare", "--json", "o.json", "--report", "r.html"
    )
    assert status == 0, err
    data = json.loads(Path("o.json").read_text())
    assert data["boards_used"] == data["boards_total"] == 8
    assert data["best_one_parameter_model"] == "equidistant"
    assert data["fits"]["equidistant"]["f"] == pytest.approx(150.0, rel=0.002)
    lens = json.loads(Path("camera_calibration.json").read_text())
    assert lens["model"] == "equidistant"
    assert lens["cx"] == pytest.approx(243.0, abs=0.3)
    assert lens["cy"] == pytest.approx(246.0, abs=0.3)
    assert (lens["frame_width"], lens["frame_height"]) == (480, 480)
    assert lens["pad_size"] is None
    assert lens["fov_deg"] == pytest.approx(184, abs=3)  # the drawn circle's edge
    assert data["recommended"].startswith(lens["model"])
    for text in ("8 of 8 boards", "recommended: ", "equidistant+k4", "wrote r.html"):
        assert text in out
    assert "<html" in Path("r.html").read_text()
    assert sorted(p.name for p in Path().iterdir()) == [
        "camera_calibration.json",
        "o.json",
        "r.html",
    ]


def test_the_file_works_in_a_configuration(calibrate: Run, pictures: Path) -> None:
    status, _, err = calibrate(pictures, "--pattern", "8x6", "--terms", "2", "--out", "lens.json")
    assert status == 0, err
    Path("config.yaml").write_text(
        "camera: {calibration: lens.json, width: 480, height: 480, pad_size: null, "
        "crop_size: null}\n"
    )
    camera = ground_camera(load_config(Path("config.yaml")))
    theta = np.linspace(0, math.radians(85), 30)
    np.testing.assert_allclose(camera.lens.radius(theta), LENS.radius(theta), atol=0.3)


def test_json_alone_on_standard_output(calibrate: Run, pictures: Path) -> None:
    status, out, _ = calibrate(pictures, "--pattern", "8X6", "--terms", "0", "--json", "-")
    assert status == 0
    data = json.loads(out)
    assert list(data["fits"]) == ["equidistant"]
    assert data["recommended"] == data["chosen"] == "equidistant"


def test_a_former_file_is_only_replaced_when_named_and_kept(calibrate: Run, pictures: Path) -> None:
    Path("camera_calibration.json").write_text("{}")
    status, out, _ = calibrate(pictures, "--pattern", "8x6")
    assert status == 0
    assert Path("camera_calibration.json").read_text() == "{}"
    assert "was left as it is" in out
    status, out, _ = calibrate(
        pictures, "--pattern", "8x6", "--model", "equalarea", "--out", "camera_calibration.json"
    )
    assert status == 0
    assert json.loads(Path("camera_calibration.json").read_text())["model"] == "equisolid"
    assert Path("camera_calibration.json.bak").read_text() == "{}"
    assert "camera_calibration.json.bak" in out


def test_sensor_frames_are_calibrated_in_the_crop(calibrate: Run, tmp_path: Path) -> None:
    Path("config.yaml").write_text(
        "camera: {calibration: none-yet.json, width: 640, height: 360, pad_size: 640, "
        "crop_size: 600, radius_px: 300}\n"
    )
    lens = Lens("equidistant", 190.0, math.radians(95))
    sensor = DrawnCamera(lens, 322.0, 181.5, 640, 360)
    folder = tmp_path / "frames"
    folder.mkdir()
    draw(folder, sensor, spread_poses(sensor, PATTERN, 6, seed=2, span_deg=(40, 55)))
    status, out, err = calibrate(
        folder, "--pattern", "8x6", "--terms", "0", "-c", "config.yaml", "--out", "none-yet.json"
    )
    assert status == 0, err
    data = json.loads(Path("none-yet.json").read_text())
    assert data["cx"] == pytest.approx(322.0 - 20, abs=0.5)
    assert data["cy"] == pytest.approx(181.5 + 120, abs=0.5)
    assert (data["frame_width"], data["frame_height"]) == (640, 360)
    assert (data["pad_size"], data["crop_size"]) == (640, 600)
    assert "camera.radius_px" in out  # it would override the measured focal length
    assert load_config(Path("config.yaml")).calibration is not None


Spoil = Callable[[Path, Path], list[object]]


def none(folder: Path, pictures: Path) -> list[object]:
    cv2.imwrite(str(folder / "wall.png"), np.full((480, 480), 120, np.uint8))
    return [folder]


def one(folder: Path, pictures: Path) -> list[object]:
    return [min(pictures.iterdir())]


def alike(folder: Path, pictures: Path) -> list[object]:
    pose = spread_poses(CAMERA, PATTERN, 8, seed=3, span_deg=(45, 75))[1]
    poses = [replace(pose, translation_m=pose.translation_m * (1 + 0.02 * n)) for n in range(4)]
    draw(folder, CAMERA, poses)
    return [folder]


def mixed(folder: Path, pictures: Path) -> list[object]:
    for path in sorted(pictures.iterdir())[:4]:
        shutil.copy(path, folder)
    cv2.imwrite(str(folder / "z.png"), np.zeros((100, 200), np.uint8))
    return [folder]


def unreadable(folder: Path, pictures: Path) -> list[object]:
    for path in sorted(pictures.iterdir())[:4]:
        shutil.copy(path, folder)
    (folder / "broken.png").write_bytes(b"no picture at all")
    return [folder]


def ordinary(folder: Path, pictures: Path) -> list[object]:
    lens = Lens("perspective", 240 / math.tan(math.radians(32)), math.radians(44))
    camera = DrawnCamera(lens, 239.5, 239.5, 480, 480)
    poses = [
        BoardPose(
            turn([0.5 * math.cos(2.4 * n), 0.5 * math.sin(2.4 * n), 0.3 * n]),
            np.array([0.12 * math.sin(n), 0.12 * math.cos(1.7 * n), 1.3 + 0.08 * n]),
        )
        for n in range(7)
    ]
    draw(folder, camera, poses)
    return [folder]


def nowhere(folder: Path, pictures: Path) -> list[object]:
    return [folder / "no-such-folder"]


def empty(folder: Path, pictures: Path) -> list[object]:
    return [folder]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (none, "no board of 8x6"),
        (one, "one board"),
        (alike, "alike"),
        (mixed, "200x100"),
        (unreadable, "broken.png"),
        (ordinary, "not a fisheye"),
        (nowhere, "no-such-folder"),
        (empty, "no pictures"),
    ],
)
def test_what_cannot_be_calibrated_is_refused_in_one_line(
    calibrate: Run, pictures: Path, tmp_path: Path, spoil: Spoil, said: str
) -> None:
    folder = tmp_path / "given"
    folder.mkdir()
    given = spoil(folder, pictures)
    status, out, err = calibrate(
        *given, "--pattern", "8x6", "--compare", "--json", "o.json", "--report", "r.html"
    )
    assert status == 2
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert out == ""
    assert list(Path().iterdir()) == []


def test_a_wrong_pattern_is_refused(calibrate: Run, pictures: Path) -> None:
    status, _, err = calibrate(min(pictures.iterdir()), "--pattern", "11x9")
    assert status == 2
    assert "no board of 11x9" in err
    assert "--pattern" in err
    assert list(Path().iterdir()) == []


def test_boards_in_part_are_named_with_their_corners() -> None:
    pattern = BoardPattern(4, 3)
    views = [
        BoardView(name, np.arange(count), np.zeros((count, 2)), 640, 480)
        for name, count in (("a/whole.png", 12), ("a/[b].png", 11), ("c.png", 7))
    ]
    assert partial_board_lines(CornerObservations.of(pattern, views)) == [
        "  in part: c.png, 7 of 12 corners",
        "  in part: \\[b].png, 11 of 12 corners",
    ]
    many = CornerObservations.of(pattern, [views[1]] * 11)
    assert partial_board_lines(many)[8:] == ["  and 3 more boards in part (--json, --report)"]


def test_a_board_to_print(calibrate: Run) -> None:
    status, out, err = calibrate("--board", "b.pdf", "--pattern", "8x6", "--page", "a3")
    assert status == 0, err
    assert Path("b.pdf").read_bytes().startswith(b"%PDF")
    assert "squares of " in out
    status, _, err = calibrate("--board", "c.pdf", "--pattern", "8x6", "--square", "0.2")
    assert status == 2
    assert "--square" in err
    assert not Path("c.pdf").exists()


def test_live_guides_keeps_and_calibrates(calibrate: Run, tmp_path: Path) -> None:
    folder = tmp_path / "camera"
    folder.mkdir()
    poses = spread_poses(CAMERA, PATTERN, 5, seed=3, span_deg=(45, 75))
    # Each board is held still for two frames.
    draw(folder, CAMERA, [pose for pose in poses for _ in range(2)])
    settings = [f"camera.source={folder}", "camera.width=480", "camera.height=480"]
    settings += ["camera.pad_size=null", "camera.crop_size=null", "web.port=0"]
    given = [part for setting in settings for part in ("--set", setting)]
    status, out, err = calibrate(
        "taken", "--live", "--pattern", "8x6", "--terms", "0", "--out", "lens.json", *given
    )
    assert status == 0, err
    assert len(list(Path("taken").glob("board-*.png"))) == 5
    assert "kept as board 1" in out
    assert json.loads(Path("lens.json").read_text())["focal_length"] == pytest.approx(150, rel=0.01)


def test_ctrl_c_again_and_again_ends_it_in_one_line(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (1200, 1600)).astype(np.uint8)
    for number in range(12):  # without a board the search takes seconds each
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.roll(noise, number))
    (tmp_path / "config.yaml").write_text("camera: {width: 1600, height: 1200}\n")
    run = subprocess.Popen(
        [
            *(sys.executable, "-m", "bikeped.cli.main", "calibrate", str(tmp_path)),
            *("--live", "--pattern", "8x6", "-c", str(tmp_path / "config.yaml")),
            *("--set", f"camera.source={tmp_path}", "--set", "web.port=0"),
        ],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert run.stdout is not None
    while "pictures go into" not in (line := run.stdout.readline()):
        assert line, run.communicate()[1]
    while True:
        run.send_signal(signal.SIGINT)
        try:
            _, err = run.communicate(timeout=0.2)
            break
        except subprocess.TimeoutExpired:
            continue
    assert run.returncode in (130, -signal.SIGINT)
    said = [line for line in err.splitlines() if "calibrating from what was kept" not in line]
    assert said == ["bikeped: interrupted"], err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["{pictures}"], "--pattern"),
        (["--pattern", "8x6"], "IMAGES"),
        (["{pictures}", "--pattern", "8by6"], "COLUMNSxROWS"),
        (["{pictures}", "--pattern", "2x6"], "8x6"),
        (["{pictures}", "--pattern", "8x6", "--terms", "3"], "--terms"),
        (["{pictures}", "--pattern", "8x6", "--square", "-1"], "--square"),
        (["{pictures}", "--pattern", "8x6", "--folds", "1"], "--folds"),
        (["{pictures}", "--pattern", "8x6", "--out", "no/such/folder.json"], "--out"),
        (["{pictures}", "--pattern", "8x6", "--report", "{pictures}/board00.png"], "--report"),
        (["{pictures}", "--pattern", "8x6", "--report", "a", "--json", "a"], "own file"),
        (["{pictures}", "--pattern", "8x6", "-c", "nothing.yaml"], "nothing.yaml"),
        (["a", "b", "--live", "--pattern", "8x6"], "one folder"),
        (["--board", "no/such/b.pdf", "--pattern", "8x6"], "--board"),
    ],
)
def test_wrong_options_are_refused_in_one_line(
    calibrate: Run, pictures: Path, arguments: list[str], said: str
) -> None:
    before = {p.name: hashlib.sha256(p.read_bytes()).digest() for p in pictures.iterdir()}
    status, out, err = calibrate(*(a.format(pictures=pictures) for a in arguments))
    assert status == 2
    assert said in err
    assert len(err.strip().splitlines()) == 1
    assert out == ""
    assert list(Path().iterdir()) == []
    after = {p.name: hashlib.sha256(p.read_bytes()).digest() for p in pictures.iterdir()}
    assert before == after


@pytest.mark.skipif(bool(missing(REAL / "Fisheye1_1.jpg")), reason=missing(REAL / "Fisheye1_1.jpg"))
def test_the_real_pictures(calibrate: Run) -> None:
    status, _, err = calibrate(
        *sorted(REAL.glob("*.jpg")), "--pattern", "8x6", "--compare", "--json", "o.json"
    )
    assert status == 0, err
    data = json.loads(Path("o.json").read_text())
    assert data["boards_used"] == data["boards_total"] == 15
    assert data["corners"] == 15 * 48
    assert data["corners_left_out"] == []
    fits = data["fits"]
    assert fits["equidistant+k4"]["rms_px"] <= 0.385
    assert fits["equidistant+k4"]["cross_validated_px"] <= 0.405
    assert fits["equidistant+k4+board"]["cross_validated_px"] <= 0.27
    assert data["best_one_parameter_model"] == "equidistant"
    for other in ("equisolid", "stereographic", "orthographic"):
        assert fits["equidistant"]["cross_validated_px"] < fits[other]["cross_validated_px"]
    assert data["recommended"] == "equidistant+k4+board"
