"""Windows to learn from: boxes stay on what they box, whatever is done to the picture."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from coco_sets import annotation, edit, write_set

from bikeped.detection.preprocess import PAD
from bikeped.errors import DataSetError
from bikeped.lab.training.coco import read_coco
from bikeped.lab.training.crops import (
    Cropper,
    CropSettings,
    Sample,
    class_ids,
    object_centres,
    read_sample,
)

PLAIN = CropSettings(
    view=(320, 192), window=(160, 96), light=0, cover=0, around_object=1, around_usual=0
)
NOWHERE = np.zeros((0, 2))


def one_box(box=(100.0, 60.0, 140.0, 100.0), crowd=0):
    """A white box on black."""
    rgb = np.zeros((192, 320, 3), np.uint8)
    u1, v1, u2, v2 = (int(side) for side in box)
    rgb[v1:v2, u1:u2] = 255
    return Sample(rgb, np.array([box]), np.array([2]), np.array([crowd]))


def extent(rgb):
    """The white box, to parts of a pixel: u1, v1, u2, v2."""
    light = rgb[..., 0] / 255.0
    across, down = light.max(axis=0), light.max(axis=1)
    u = np.flatnonzero(across > 0.02)
    v = np.flatnonzero(down > 0.02)
    return (
        u[0] + 1 - across[u[0]],
        v[0] + 1 - down[v[0]],
        u[-1] + across[u[-1]],
        v[-1] + down[v[-1]],
    )


@pytest.mark.parametrize("flip", [0.0, 1.0])
@pytest.mark.parametrize("scale", [(1.0, 1.0), (0.7, 0.7), (1.6, 1.6)])
def test_a_box_stays_on_its_object(flip, scale):
    cropper = Cropper(replace(PLAIN, flip=flip, scale=scale), 0, NOWHERE)
    random = np.random.default_rng(5)
    seen = 0
    for _ in range(40):
        crop = cropper(one_box(), random)
        inside = crop.box_px[
            (crop.box_px[:, :2] > 1).all(1) & (crop.box_px[:, 2:] < (159, 95)).all(1)
        ]
        if len(inside) == 1:
            seen += 1
            np.testing.assert_allclose(extent(crop.rgb), inside[0], atol=0.6)
            assert crop.class_id.tolist() == [2]
    assert seen > 5


def test_a_window_around_an_object_holds_some_of_it():
    cropper = Cropper(PLAIN, 0, NOWHERE)
    random = np.random.default_rng(1)
    for _ in range(30):
        crop = cropper(one_box(), random)
        assert len(crop.box_px) + len(crop.ignored_px) == 1
        assert crop.rgb.shape == (96, 160, 3)


def test_what_is_mostly_outside_or_a_crowd_is_not_asked_for():
    cropper = Cropper(PLAIN, 0, NOWHERE)
    random = np.random.default_rng(2)
    crop = cropper(one_box(crowd=1), random)
    assert len(crop.box_px) == 0
    assert len(crop.ignored_px) == 1
    tiny = Sample(
        np.zeros((192, 320, 3), np.uint8), np.array([[50, 50, 53, 53.0]]), *np.zeros((2, 1), int)
    )
    crop = cropper(tiny, random)
    assert (len(crop.box_px), len(crop.ignored_px)) == (0, 1)


def test_windows_are_cut_where_others_have_objects():
    settings = replace(PLAIN, around_object=0, around_usual=1, scale=(1, 1), flip=0)
    view = Sample(np.zeros((192, 320, 3), np.uint8), np.zeros((0, 4)), *np.zeros((2, 0), int))
    view.rgb[150:160, 280:290] = 200
    cropper = Cropper(settings, 0, np.array([[285.0, 155.0]]))
    random = np.random.default_rng(3)
    assert all(cropper(view, random).rgb.max() == 200 for _ in range(20))


def test_light_and_cover_change_the_picture_and_not_the_boxes():
    plain = Cropper(PLAIN, 0, NOWHERE)
    other = Cropper(replace(PLAIN, light=1, cover=1), 0, NOWHERE)
    a = plain(one_box(), np.random.default_rng(4))
    b = other(one_box(), np.random.default_rng(4))
    np.testing.assert_array_equal(a.box_px, b.box_px)
    assert (a.rgb != b.rgb).any()


def test_the_same_seed_gives_the_same_windows():
    settings = CropSettings(view=(320, 192), window=(160, 96))
    a, b = (Cropper(settings, 7, NOWHERE)(one_box(), np.random.default_rng(8)) for _ in range(2))
    np.testing.assert_array_equal(a.rgb, b.rgb)
    np.testing.assert_array_equal(a.box_px, b.box_px)


def test_a_view_is_letterboxed_as_the_detector_does(tmp_path):
    # 320 x 240 into 320 x 192: four fifths of the size, 32 grey columns on either side.
    file = write_set(tmp_path / "set", [annotation(7, 1, 2, [10, 20, 30, 40])])
    data = read_coco(file)
    view = read_sample(data, data.images[0], (320, 192))
    assert view.rgb.shape == (192, 320, 3)
    assert (view.rgb[:, :32] == PAD).all()
    assert (view.rgb[:, 288:] == PAD).all()
    np.testing.assert_allclose(view.box_px, [[40, 16, 64, 48]], atol=1e-4)
    assert view.class_id.tolist() == [1]
    assert class_ids(data) == {1: 0, 2: 1, 3: 2}
    np.testing.assert_allclose(object_centres(data, (320, 192)), [[52, 32]], atol=1e-4)


def test_furniture_is_read_where_the_data_tell(tmp_path):
    file = write_set(tmp_path / "set", [])
    entry = read_coco(file).images[0].entry
    things = [
        {"what": "sign", "bbox": [10, 20, 30, 40]},
        {"what": "tree", "bbox": [300, 200, 60, 60]},
        {"what": "tree", "bbox": [400, 20, 30, 40]},  # beside the picture
    ]
    edit(file, images=[{**entry, "furniture": things}])
    data = read_coco(file)
    found = read_sample(data, data.images[0], (320, 192)).furniture_px
    assert sorted(found) == ["sign", "tree"]
    np.testing.assert_allclose(found["sign"], [[40, 16, 64, 48]], atol=1e-4)
    np.testing.assert_allclose(found["tree"], [[272, 160, 288, 192]], atol=1e-4)
    edit(file, images=[{**entry, "furniture": [{"what": "sign"}]}])
    data = read_coco(file)
    with pytest.raises(DataSetError, match=r"001\.jpg: its `furniture` \(image 1\)"):
        read_sample(data, data.images[0], (320, 192))


def test_a_damaged_picture_is_named(tmp_path):
    file = write_set(tmp_path / "set", [])
    data = read_coco(file)
    data.images[0].path.write_bytes(b"\xff\xd8 no picture")
    with pytest.raises(DataSetError, match=r"001\.jpg: is no whole picture"):
        read_sample(data, data.images[0], (320, 192))
    data.images[0].path.unlink()
    with pytest.raises(DataSetError, match=r"001\.jpg: cannot be read"):
        read_sample(data, data.images[0], (320, 192))


def test_a_png_is_read_too(tmp_path):
    file = write_set(tmp_path / "set", [])
    data = read_coco(file)
    path = data.images[0].path
    picture = cv2.imread(str(path))
    assert picture is not None
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())  # under a JPEG's name
    assert read_sample(data, data.images[0], (320, 192)).rgb.shape == (192, 320, 3)
