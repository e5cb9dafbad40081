"""Data sets in COCO's format: what is read, and what is refused with a line that helps."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from coco_sets import CATEGORIES, annotation, edit, picture, write_set
from hypothesis import given
from hypothesis import strategies as st

from bikeped.errors import DataSetError
from bikeped.lab.training.coco import CocoImage, read_coco, read_picture, write_annotations


def entry(**changes):
    return {"id": 1, "file_name": "images/001.jpg", "width": 320, "height": 240, **changes}


@pytest.fixture
def file(tmp_path):
    return write_set(tmp_path / "set", [annotation(7, 1, 2, [10, 20, 30, 40])])


def test_a_plain_folder_is_read(file):
    data = read_coco(file.parent)
    assert data.source == file
    assert [image.id for image in data.images] == [1]
    (thing,) = data.objects[1]
    assert (thing.id, thing.category_id, thing.box_px) == (7, 2, (10, 20, 40, 60))
    assert data.categories == {1: "person", 2: "bicycle", 3: "car"}
    assert data.header["licenses"][0]["name"] == "CC BY"
    assert data.images[0].entry["coco_url"] == "file:001.jpg"
    assert data.count == 1


def test_cocos_own_layout_is_read_from_the_folder_and_from_the_file(tmp_path):
    file = write_set(tmp_path / "coco", [], images=2, layout="coco")
    for name in (file, tmp_path / "coco"):
        data = read_coco(name)
        assert data.images[1].path == tmp_path / "coco" / "tiny" / "002.jpg"
        assert data.objects == {1: (), 2: ()}


def test_pictures_elsewhere_are_named(file, tmp_path):
    (file.parent / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(DataSetError, match=r"001\.jpg is missing in .*--images"):
        read_coco(file)
    edit(file, images=[entry(file_name="001.jpg")])
    assert read_coco(file, tmp_path / "elsewhere").images[0].path.is_file()
    with pytest.raises(DataSetError, match="no folder"):
        read_coco(file, tmp_path / "nowhere")


def test_several_sets_in_one_folder_ask_for_one(tmp_path):
    file = write_set(tmp_path / "coco", [], layout="coco")
    (file.parent / "instances_other.json").write_text(file.read_text())
    with pytest.raises(DataSetError, match=r"instances_other\.json, instances_tiny\.json"):
        read_coco(tmp_path / "coco")


def test_boxes_are_clipped_and_those_without_area_counted(file):
    edit(
        file,
        annotations=[
            annotation(1, 1, 1, [-5, 230, 20, 20]),
            annotation(2, 1, 1, [10, 10, 0, 5]),
            annotation(3, 1, 1, [400, 10, 5, 5]),
        ],
    )
    data = read_coco(file)
    assert [thing.box_px for thing in data.objects[1]] == [(0, 230, 15, 240)]
    assert data.empty == 2


def test_outlines_and_crowds(file):
    triangle = [0, 0, 10, 0, 0, 10]
    rle = {"counts": [1, 2], "size": [240, 320]}
    edit(
        file,
        annotations=[
            annotation(1, 1, 1, [0, 0, 10, 10], segmentation=[triangle, [1, 2]]),
            annotation(2, 1, 1, [0, 0, 10, 10], segmentation=rle, iscrowd=1),
        ],
    )
    one, many = read_coco(file).objects[1]
    assert [ring.tolist() for ring in one.polygons] == [[[0, 0], [10, 0], [0, 10]]]
    assert (one.crowd, many.crowd, many.polygons) == (False, True, ())


def bad(**changes):
    return [annotation(1, 1, 1, [0, 0, 5, 5]) | changes]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"images": [entry(), entry()]}, r"images\[1\]\.id: 1 is images\[0\]'s, too"),
        ({"images": [entry(), entry(id=2)]}, r"images\[1\]\.file_name: .* is images\[0\]'s, too"),
        ({"images": [entry(id=-1)]}, r"images\[0\]\.id: -1 is negative"),
        ({"images": [entry(id="a")]}, r"Expected `int`, got `str` - at `\$\.images\[0\]\.id`"),
        ({"images": []}, "images: is empty"),
        ({"images": [entry(file_name="../secret.jpg")]}, "leads out of the pictures' folder"),
        ({"images": [entry(file_name="a/../../b.jpg")]}, "leads out of the pictures' folder"),
        ({"images": [entry(file_name="/etc/passwd")]}, "leads out of the pictures' folder"),
        ({"images": [entry(file_name="..\\b.jpg")]}, "leads out of the pictures' folder"),
        ({"images": [entry(file_name="C:\\b.jpg")]}, "leads out of the pictures' folder"),
        ({"images": [entry(file_name="")]}, "leads out of the pictures' folder"),
        ({"images": [entry(file_name=".")]}, "leads out of the pictures' folder"),
        ({"images": [entry(file_name="a\0b")]}, "leads out of the pictures' folder"),
        ({"images": [entry(width=0)]}, "0 x 240 is no picture's size"),
        ({"images": [entry(width=30000, height=30000)]}, "pixels are more than"),
        ({"images": [entry(width=10**9)]}, "is no picture's size"),
        ({"images": [entry(), entry(id=2, file_name="images/9.jpg")]}, r"9\.jpg: is missing"),
        ({"annotations": bad(image_id=5)}, r"annotations\[0\]\.image_id: there is no image 5"),
        ({"annotations": bad(category_id=9)}, r"\.category_id: there is no category 9"),
        ({"annotations": bad(bbox=[0, 0, -5, 5])}, r"\.bbox: .* is no box"),
        ({"annotations": bad(bbox=[0, 0, 5])}, r"annotations\[0\]\.bbox"),
        ({"annotations": bad(bbox=[0, 0, "5", 5])}, r"annotations\[0\]\.bbox\[2\]"),
        ({"annotations": bad(iscrowd=3)}, r"\.iscrowd: 3"),
        ({"annotations": bad(segmentation=[["x"]])}, r"\.segmentation"),
        ({"annotations": bad() * 2}, r"annotations\[1\]\.id: 1 is annotations\[0\]'s"),
        ({"categories": CATEGORIES + CATEGORIES[:1]}, r"categories\[3\]\.id: 1"),
        ({"categories": [*CATEGORIES, {"id": 9, "name": "car"}]}, r"categories\[3\]\.name: 'car'"),
        ({"categories": None}, r"\$\.categories"),
    ],
)
def test_what_is_wrong_is_named(file, parts, message):
    edit(file, **parts)
    with pytest.raises(DataSetError, match=message) as caught:
        read_coco(file)
    assert str(file) in str(caught.value) or "missing" in message
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '{"images": [NaN]}', "[" * 100_000, "\xff"])
def test_files_that_are_no_coco_are_refused(file, text):
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(DataSetError, match=r"annotations\.json: is"):
        read_coco(file)


def test_nothing_there_is_said(tmp_path):
    with pytest.raises(DataSetError, match="does not exist"):
        read_coco(tmp_path / "none")
    with pytest.raises(DataSetError, match="holds neither"):
        read_coco(tmp_path)


@given(st.binary(max_size=200))
def test_no_bytes_end_in_anything_but_our_error(tmp_path_factory, content):
    file = tmp_path_factory.mktemp("bytes") / "annotations.json"
    file.write_bytes(content)
    with pytest.raises(DataSetError):
        read_coco(file)


def test_pictures_are_read_whole_or_refused(tmp_path):
    bgr = picture(64, 48)
    for name in ("a.png", "a.jpg", "a.bmp"):
        cv2.imwrite(str(tmp_path / name), bgr)
        read = read_picture(CocoImage(1, name, 64, 48, tmp_path / name))
        assert read.shape == (48, 64, 3)
        assert np.abs(read[..., ::-1].astype(int) - bgr).mean() < 4
    whole = (tmp_path / "a.jpg").read_bytes()
    for name, content, why in (
        ("cut.jpg", whole[: len(whole) // 2], "no whole picture"),
        ("empty.jpg", b"", "no whole picture"),
        ("text.png", b"hello", "no whole picture"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataSetError, match=why):
            read_picture(CocoImage(1, name, 64, 48, tmp_path / name))
    with pytest.raises(DataSetError, match="64 x 48 pixels, but the data say 48 x 64"):
        read_picture(CocoImage(1, "a.png", 48, 64, tmp_path / "a.png"))
    with pytest.raises(DataSetError, match="64 x 48 pixels, but the data say 48 x 64"):
        read_picture(CocoImage(1, "a.bmp", 48, 64, tmp_path / "a.bmp"))
    with pytest.raises(DataSetError, match="cannot be read"):
        read_picture(CocoImage(1, "a.png", 48, 64, tmp_path))


def test_a_picture_that_claims_to_be_huge_is_refused_by_its_header(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), picture(64, 48))
    content = bytearray((tmp_path / "a.png").read_bytes())
    content[16:24] = (60000).to_bytes(4, "big") * 2
    (tmp_path / "a.png").write_bytes(bytes(content))
    with pytest.raises(DataSetError, match="60000 x 60000 pixels, but the data say"):
        read_picture(CocoImage(1, "a.png", 64, 48, tmp_path / "a.png"))


def test_what_is_written_is_read_again(file):
    data = read_coco(file)
    again = file.parent / "again.json"
    body = json.loads(file.read_text())
    write_annotations(again, data.header, body["images"], body["annotations"])
    assert json.loads(again.read_text()) == body
