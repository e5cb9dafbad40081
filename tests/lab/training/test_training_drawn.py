"""Sets of drawn pictures: their cameras, their seeds, and one data set out of many parts."""

from __future__ import annotations

import hashlib

import pytest

from bikeped.config.load import load_config
from bikeped.errors import DataSetError
from bikeped.lab.rendering.render_camera import DEFAULT_POSE
from bikeped.lab.training.coco import read_coco, read_picture
from bikeped.lab.training.drawn import DrawnSettings, draw_training_set, part_camera

LOADED = load_config(None)


def hashes(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_parts_have_cameras_of_their_own():
    settings = DrawnSettings(seed=3, configured=0.6, large=0.5)
    cameras = [part_camera(settings, number, LOADED) for number in range(60)]
    placed = [camera for camera, _ in cameras if camera is not None]
    assert 25 <= len(placed) <= 47
    assert len({camera.pose for camera in placed}) == len(placed)
    for camera in placed:
        assert abs(camera.pose.x_m - DEFAULT_POSE.x_m) <= 2.5
        assert camera.camera.lens == placed[0].camera.lens
    assert {size for _, size in cameras} == {(1280, 720), (1920, 1080)}
    again = part_camera(settings, 7, LOADED)
    assert again[1] == cameras[7][1]
    assert (again[0] is None) == (cameras[7][0] is None)


@pytest.mark.slow
def test_a_set_is_the_same_whoever_draws_it(tmp_path):
    settings = DrawnSettings(pictures=3, seed=5, part=2, large=0, processes=2)
    seen = []
    file = draw_training_set(tmp_path / "a", settings, LOADED, seen.append)
    assert seen == [2, 3]
    data = read_coco(file)
    assert [image.file_name for image in data.images] == [
        "0000/images/000000.jpg",
        "0000/images/000001.jpg",
        "0001/images/000000.jpg",
    ]
    assert list(data.categories.values()) == ["pedestrian", "cyclist", "vehicle"]
    assert read_picture(data.images[2]).shape == (720, 1280, 3)
    alone = DrawnSettings(pictures=3, seed=5, part=2, large=0, processes=1)
    draw_training_set(tmp_path / "b", alone, LOADED)
    assert hashes(tmp_path / "a") == hashes(tmp_path / "b")


def test_a_folder_that_is_taken_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(DataSetError, match="is there already"):
        draw_training_set(tmp_path, DrawnSettings(pictures=1), LOADED)
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
    with pytest.raises(DataSetError, match="more than a set can have"):
        draw_training_set(tmp_path / "new", DrawnSettings(pictures=10**6), LOADED)
