"""Clips, their boxes beside them, and data sets: whole or not there, and readable by others."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bikeped.capture.recordings import VideoSource
from bikeped.config.load import load_config
from bikeped.errors import BikepedError, CaptureError
from bikeped.lab.rendering import (
    Conditions,
    ScenePainter,
    read_sidecar,
    scene_camera,
    sidecar_path,
    write_clip,
)
from bikeped.lab.rendering.dataset import write_dataset
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenario
from bikeped.types import Kind

SIZE = (320, 180)
_HEADER = '{"format": "bikeped drawn boxes 2", "frames": 1, "width": 1, "height": 1}'


@pytest.fixture(scope="module")
def painter() -> ScenePainter:
    scenario = load_scenario(bundled_folder() / "wheelchair-user.yaml")
    view = scene_camera(load_config(None, ()), SIZE)
    return ScenePainter(scenario, view, Conditions(seed=2))


@pytest.fixture(scope="module")
def clip(painter: ScenePainter, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clip") / "wheelchair.avi"
    assert write_clip(painter, path, fps=10, seconds=1.2) == sidecar_path(path)
    return path


def test_opencv_reads_what_was_drawn(painter: ScenePainter, clip: Path) -> None:
    video = cv2.VideoCapture(str(clip))
    assert video.get(cv2.CAP_PROP_FPS) == 10
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 12
    for i in range(12):
        good, bgr = video.read()
        assert good
        if i % 5 == 0:
            drawn = painter.frame(i / 10)
            assert np.abs(bgr[..., ::-1].astype(int) - drawn).mean() < 4
    assert not video.read()[0]
    video.release()


def test_the_service_reads_it(clip: Path) -> None:
    source = VideoSource(str(clip))
    frames = 0
    while (frame := source.read()) is not None:
        assert (frame.width, frame.height) == SIZE
        assert frame.captured_s == pytest.approx(frames / 10, abs=1e-3)
        frames += 1
    source.close()
    assert frames == 12


def test_boxes_come_back_as_they_were(painter: ScenePainter, clip: Path) -> None:
    truth = read_sidecar(sidecar_path(clip))
    assert truth.size == SIZE
    assert truth.header["scenario"] == "Wheelchair User"
    assert truth.header["conditions"]["seed"] == 2
    assert len(truth.frames) == len(truth.times_s) == 12
    for t, frame in zip(truth.times_s, truth.frames, strict=True):
        drawn = painter.objects(t)
        assert [item.id for item in frame] == [item.id for item in drawn]
        for read, item in zip(frame, drawn, strict=True):
            assert read.kind == item.kind
            assert read.label is item.label
            assert read.box_px == pytest.approx(item.box_px, abs=1e-3)
            assert read.xy_m == pytest.approx(item.xy_m, abs=1e-3)
            assert read.visible == pytest.approx(item.visible, abs=1e-3)


def test_the_same_clip_twice_is_the_same_bytes(
    painter: ScenePainter, clip: Path, tmp_path: Path
) -> None:
    again = tmp_path / "again.avi"
    write_clip(painter, again, fps=10, seconds=1.2)
    assert again.read_bytes() == clip.read_bytes()
    assert sidecar_path(again).read_bytes() == sidecar_path(clip).read_bytes()


def test_a_clip_that_fails_leaves_nothing(painter: ScenePainter, tmp_path: Path) -> None:
    def fail(done: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_clip(painter, tmp_path / "a.avi", fps=10, seconds=1, progress=fail)
    with pytest.raises(CaptureError, match="avi name"):
        write_clip(painter, tmp_path / "a.mp4")
    with pytest.raises(CaptureError, match="leaves no frame"):
        write_clip(painter, tmp_path / "a.avi", seconds=0.0)
    with pytest.raises(CaptureError, match="another folder"):
        write_clip(painter, tmp_path / "no" / "a.avi", seconds=0.1)
    # The boxes cannot be written: no clip without them.
    (tmp_path / "b.boxes.jsonl").mkdir()
    with pytest.raises(BikepedError, match=r"b\.boxes\.jsonl"):
        write_clip(painter, tmp_path / "b.avi", seconds=0.1)
    assert [path.name for path in tmp_path.iterdir()] == ["b.boxes.jsonl"]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "not a file of drawn boxes"),
        ('{"format": "other"}', "is not 'bikeped drawn boxes 2'"),
        ('{"format": "bikeped drawn boxes 2", "frames": 3, "width": 1, "height": 1}', "holds 0"),
        ("[1]", "not a file of drawn boxes"),
        (_HEADER + '\n{"t": 0, "objects": [{"id": 1}]}', "not a file of drawn boxes"),
    ],
)
def test_a_file_that_is_no_sidecar_is_refused(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "x.boxes.jsonl"
    path.write_text(text)
    with pytest.raises(CaptureError, match=match):
        read_sidecar(path)
    with pytest.raises(CaptureError, match="cannot be read"):
        read_sidecar(tmp_path / "missing.jsonl")


def test_a_data_set_is_coco_and_repeats(tmp_path: Path) -> None:
    first = write_dataset(tmp_path / "a", 5, 3, size=SIZE)
    data = json.loads(first.read_text())
    assert [c["name"] for c in data["categories"]] == [kind.label for kind in Kind]
    assert len(data["images"]) == 5
    assert {n["category_id"] for n in data["annotations"]} <= {1, 2, 3}
    for image in data["images"]:
        assert image["furniture"]
        assert all(set(thing) == {"what", "bbox"} for thing in image["furniture"])
    assert len({n["id"] for n in data["annotations"]}) == len(data["annotations"]) > 5
    for note in data["annotations"]:
        u, v, w, h = note["bbox"]
        assert 0 <= u < u + w <= SIZE[0] + 0.01
        assert 0 <= v < v + h <= SIZE[1] + 0.01
        assert note["area"] == pytest.approx(w * h, abs=0.2 + 0.02 * (w + h))
        assert 0 <= note["visible"] <= 1
        assert note["distance_m"] > 0
        assert note["iscrowd"] == int(note["visible"] < 0.3 or min(w, h) < 5)
    for image in data["images"]:
        picture = cv2.imread(str(tmp_path / "a" / "images" / image["file_name"]))
        assert picture is not None
        assert picture.shape[:2] == (image["height"], image["width"])
    write_dataset(tmp_path / "b", 5, 3, size=SIZE)
    for path in sorted((tmp_path / "a").rglob("*.*")):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes()
    # A smaller set is the beginning of a larger one; another seed is another set.
    small = json.loads(write_dataset(tmp_path / "c", 2, 3, size=SIZE).read_text())
    assert small["images"] == data["images"][:2]
    other = json.loads(write_dataset(tmp_path / "d", 2, 4, size=SIZE).read_text())
    assert other["annotations"] != small["annotations"]


def test_a_data_set_is_whole_or_not_there(tmp_path: Path) -> None:
    def fail(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_dataset(tmp_path / "a", 3, size=SIZE, progress=fail)
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "x").touch()
    with pytest.raises(BikepedError, match="is there already"):
        write_dataset(tmp_path / "taken", 1)
    with pytest.raises(BikepedError, match="count"):
        write_dataset(tmp_path / "a", 0)
    with pytest.raises(BikepedError, match="seed"):
        write_dataset(tmp_path / "a", 1, -1)
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
