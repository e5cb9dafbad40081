"""Fisheye augmentation: geometry by properties, data sets by what lies in the new folder."""

from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest
from coco_sets import annotation, edit, write_set
from hypothesis import given, settings
from hypothesis import strategies as st

from bikeped.errors import DataSetError, GeometryError
from bikeped.geometry.lens import Lens
from bikeped.lab.training.augment import (
    AugmentSettings,
    augment_data,
    augment_picture,
    picture_generator,
)
from bikeped.lab.training.coco import read_coco
from bikeped.lab.training.warp import FILL, Warp, WarpRanges, sample_warp, warp_boxes, warp_picture

SMALL = WarpRanges(size_px=128)
WIDE = WarpRanges(  # what an installer can ask for at most: boxes cut by circle and picture
    fov_deg=(90, 300),
    picture_fov_deg=(20, 160),
    yaw_deg=(-120, 120),
    pitch_deg=(-90, 90),
    roll_deg=(-180, 180),
    radius_share=(0.2, 1.2),
    shift_share=(-0.3, 0.3),
    size_px=640,
)
PICTURE = (320, 240)


def straight(fov_deg=180.0, **changes):
    """A lens in the middle of a square of 400, the picture straight ahead."""
    lens = Lens.from_circle("equidistant", 200, fov_deg)
    return Warp(lens, (200, 200), 400, **{"picture_fov_deg": 90.0, **changes})


def boxes_after(box, warp, **options):
    """Boxes after the warp, and which of them are kept."""
    blank = np.zeros((PICTURE[1], PICTURE[0], 3), np.uint8)
    return augment_picture(blank, box, warp, **options)[1:]


@st.composite
def boxes_in_picture(draw):
    x1, x2 = sorted((draw(st.floats(0, PICTURE[0])), draw(st.floats(0, PICTURE[0]))))
    y1, y2 = sorted((draw(st.floats(0, PICTURE[1])), draw(st.floats(0, PICTURE[1]))))
    return [x1, y1, max(x2, x1 + 0.5), max(y2, y1 + 0.5)]


def test_the_picture_lies_where_the_lens_says():
    # 90 degrees over 320 px: f = 160; a lens of 180 degrees and radius 200: 400/pi px a radian.
    uv, seen = straight().forward(np.array([[160.0, 120], [320, 120], [160, 0]]), PICTURE)
    down = math.atan(120 / 160) * 400 / math.pi
    assert seen.all()
    assert uv == pytest.approx(np.array([[200, 200], [300, 200], [200, 200 - down]]))
    # Turned to the right, up, and clockwise.
    for change, expected in (({"yaw_deg": 45.0}, [300, 200]), ({"pitch_deg": 45.0}, [200, 100])):
        uv, _ = straight(**change).forward(np.array([[160.0, 120]]), PICTURE)
        assert uv[0] == pytest.approx(expected)
    uv, _ = straight(roll_deg=90.0).forward(np.array([[160.0, 0]]), PICTURE)
    assert uv[0] == pytest.approx([200 + down, 200])  # what was on top is on the right


def test_what_lies_beyond_the_lens_is_not_seen():
    warp = straight(fov_deg=100.0, yaw_deg=60.0)
    uv, seen = warp.forward(np.array([[160.0, 120], [20, 120]]), PICTURE)
    assert seen.tolist() == [False, True]  # the middle lies 60 degrees off, the lens ends at 50
    assert np.isfinite(uv).all()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.floats(0, 1), st.floats(0, 1))
def test_forward_and_inverse_undo_one_another(seed, across, down):
    warp = sample_warp(np.random.default_rng(seed), WIDE)
    xy = np.array([[across * PICTURE[0], down * PICTURE[1]]])
    uv, seen = warp.forward(xy, PICTURE)
    if seen[0]:
        back, _ = warp.inverse(uv, PICTURE)
        assert back == pytest.approx(xy, abs=1e-6)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32), boxes_in_picture())
def test_every_point_of_a_box_that_is_seen_lies_in_the_new_box(seed, box):
    warp = sample_warp(np.random.default_rng(seed), WIDE)
    points = np.random.default_rng(seed).uniform(box[:2], box[2:], (400, 2))
    uv, seen = warp.forward(points, PICTURE)
    (new,), (share,) = warp_boxes(warp, PICTURE, [box])
    if not seen.any():
        return
    assert share > 0 or not np.isnan(new).any()
    slack = 0.05  # pixels, of pictures of 640: the curve is sampled
    assert (uv[seen] >= new[:2] - slack).all()
    assert (uv[seen] <= new[2:] + slack).all()
    assert (new >= 0).all()
    assert (new <= 640).all()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), boxes_in_picture())
def test_the_new_box_is_tight(seed, box):
    warp = sample_warp(np.random.default_rng(seed), SMALL)
    grid = np.stack(
        np.meshgrid(np.linspace(box[0], box[2], 60), np.linspace(box[1], box[3], 60)), -1
    ).reshape(-1, 2)
    uv, seen = warp.forward(grid, PICTURE)
    (new,), _ = warp_boxes(warp, PICTURE, [box])
    if seen.all():
        spread = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
        assert new == pytest.approx(spread, abs=128 / 60)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), boxes_in_picture())
def test_an_outline_gives_a_box_within_the_boxs(seed, box):
    warp = sample_warp(np.random.default_rng(seed), WIDE)
    x1, y1, x2, y2 = box
    diamond = np.array([[(x1 + x2) / 2, y1], [x2, (y1 + y2) / 2], [(x1 + x2) / 2, y2]])
    (whole,), _ = warp_boxes(warp, PICTURE, [box])
    (tight,), (share,) = warp_boxes(warp, PICTURE, [box], [[diamond]])
    if np.isfinite(tight).all() and share > 0:
        assert (tight[:2] >= whole[:2] - 0.05).all()
        assert (tight[2:] <= whole[2:] + 0.05).all()


def test_a_bent_edge_is_not_cut_off_by_its_corners():
    box = [20, 10, 300, 230]
    warp = straight(picture_fov_deg=120.0)
    corners = np.array([[20.0, 10], [300, 10], [20, 230], [300, 230]])
    uv, _ = warp.forward(corners, PICTURE)
    (new,), _ = warp_boxes(warp, PICTURE, [box])
    # The middle of the upper edge bulges out: 110 px over f = 160/tan 60.
    top = 200 - math.atan(110 / (160 / math.tan(math.radians(60)))) * 400 / math.pi
    assert new[1] == pytest.approx(top, abs=0.01)
    assert uv[:, 1].min() - new[1] > 15


def test_the_boxes_fit_what_is_drawn():
    """A white rectangle on black, drawn and mapped: the white pixels fill the box."""
    box = [60, 90, 200, 220]
    image = np.zeros((240, 320, 3), np.uint8)
    image[box[1] : box[3], box[0] : box[2]] = 255
    for seed in range(12):
        warp = sample_warp(np.random.default_rng(seed), WarpRanges(size_px=480))
        drawn, (new,), (kept,) = augment_picture(image, [box], warp)
        rows, columns = np.nonzero(drawn[..., 0] > 140)
        if not kept:
            continue
        found = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        assert found == pytest.approx(new, abs=1.6)


def test_circle_fill_and_black():
    drawn = warp_picture(np.full((240, 320, 3), 200, np.uint8), straight(picture_fov_deg=40.0))
    assert drawn.shape == (400, 400, 3)
    assert (drawn[200, 200] == 200).all()
    assert (drawn[200, 20] == FILL).all()
    assert (drawn[3, 3] == 0).all()


def test_a_picture_out_of_sight_leaves_an_empty_circle():
    warp = straight(fov_deg=90.0, yaw_deg=150.0, picture_fov_deg=40.0)
    drawn, boxes, kept = augment_picture(
        np.full((240, 320, 3), 200, np.uint8), [[0, 0, 9, 9]], warp
    )
    assert set(np.unique(drawn)) == {0, FILL}
    assert not kept.any()
    assert np.isnan(boxes).all()


def test_shrinking_does_not_alias():
    """Stripes one pixel wide, drawn ten times smaller, are grey; reading every tenth is not."""
    image = np.zeros((2000, 2000, 3), np.uint8)
    image[:, ::2] = 255
    lens = Lens.from_circle("equidistant", 200, 180)
    drawn = warp_picture(image, Warp(lens, (200, 200), 400, 60.0))
    middle = drawn[180:220, 180:220].astype(float)
    assert np.abs(middle - 127.5).max() < 12
    axis = np.arange(180, 220) + 0.5
    xy, _ = Warp(lens, (200, 200), 400, 60.0).inverse(
        np.stack(np.meshgrid(axis, axis), -1), (2000, 2000)
    )
    x, y = (np.float32(xy[..., i] - 0.5) for i in (0, 1))
    assert cv2.remap(image, x, y, cv2.INTER_LINEAR).std() > 40


def test_enlarging_keeps_the_picture_sharp():
    image = np.zeros((100, 100, 3), np.uint8)
    image[:, 50:] = 255
    drawn = warp_picture(image, straight(picture_fov_deg=90.0))[200, :, 0].astype(int)
    assert (drawn[150:198] == 0).all()
    assert (drawn[203:250] == 255).all()


def test_what_is_kept():
    # The lens ends 50 degrees off; the picture's middle lies there, its left half is seen.
    warp = straight(fov_deg=100.0, yaw_deg=50.0)
    box = [[0, 0, 160, 240], [60, 60, 260, 180], [200, 60, 300, 180], [10, 10, 10.6, 100]]
    _, kept = boxes_after(box, warp)
    assert kept.tolist() == [True, True, False, False]
    _, share = warp_boxes(warp, PICTURE, box)
    assert share[1] == pytest.approx(0.5, abs=0.06)
    _, kept = boxes_after(box, warp, least_share=0.6)
    assert kept.tolist() == [True, False, False, False]
    _, kept = boxes_after(box, warp, least_share=0.6, crowd=[False, True, True, False])
    assert kept.tolist() == [True, True, False, False]
    boxes, kept = boxes_after([], warp)
    assert boxes.shape == (0, 4)
    assert kept.shape == (0,)


def test_projections_are_drawn_from_what_they_can_show():
    ranges = WarpRanges(projections=("orthographic",), fov_deg=(170, 220), size_px=128)
    angles = [
        2 * math.degrees(sample_warp(np.random.default_rng(n), ranges).lens.max_theta_rad)
        for n in range(20)
    ]
    assert 170 <= min(angles) <= max(angles) <= 178
    names = {sample_warp(np.random.default_rng(n), SMALL).lens.projection for n in range(40)}
    assert names == {"equidistant", "equisolid", "stereographic", "orthographic"}


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"fov_deg": (200, 180)}, "fov-deg: 200 to 180"),
        ({"fov_deg": (10, 400)}, "fov-deg"),
        ({"picture_fov_deg": (60, 175)}, "picture-fov-deg"),
        ({"yaw_deg": (float("nan"), 3)}, "yaw-deg"),
        ({"radius_share": (0, 1)}, "radius"),
        ({"projections": ()}, "projection: none"),
        ({"projections": ("perspective",)}, "no fisheye"),
        ({"projections": ("fish",)}, "unknown model"),
        ({"size_px": 10}, "size"),
    ],
)
def test_ranges_that_cannot_be_are_refused(parts, message):
    with pytest.raises(GeometryError, match=message):
        WarpRanges(**parts)


def make(tmp_path, images=3):
    things = [
        annotation(n * 10 + k, n, 1 + k % 3, [20 + 40 * k, 60, 50, 90])
        for n in range(1, images + 1)
        for k in range(4)
    ]
    things[0]["segmentation"] = [[20, 60, 70, 60, 45, 150]]
    things[5]["iscrowd"] = 1
    return write_set(tmp_path / "set", things, images=images)


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_a_data_set_is_augmented_and_read_again(tmp_path):
    file = make(tmp_path)
    before = contents(file.parent)
    data = read_coco(file)
    out = tmp_path / "new" / "fisheye"
    done = []
    summary = augment_data(data, out, AugmentSettings(SMALL, copies=2, seed=5), done.append)
    assert contents(file.parent) == before
    assert done == [1, 2, 3]
    assert sorted(path.name for path in out.parent.iterdir()) == ["fisheye"]
    new = read_coco(out)
    assert len(new.images) == summary.pictures == 6
    assert new.count == summary.objects == sum(summary.by_category.values())
    assert summary.objects + summary.dropped == 2 * data.count
    assert new.categories == data.categories
    assert new.header["licenses"] == data.header["licenses"]
    assert new.header["info"]["description"] == "made for a test"
    record = new.header["info"]["bikeped"]
    assert (record["seed"], record["source_sha256"]) == (5, data.sha256)
    for image in new.images:
        assert (image.width, image.height) == (128, 128)
        assert (image.entry["license"], image.entry["coco_url"][:5]) == (4, "file:")
        assert image.entry["source"]["id"] == image.id // 2
        assert cv2.imread(str(image.path)).shape == (128, 128, 3)
    assert any(thing.crowd for found in new.objects.values() for thing in found)


def test_a_pictures_warp_depends_on_seed_id_and_copy_alone(tmp_path):
    file = make(tmp_path)
    whole = read_coco(file)
    body = json.loads(file.read_text())
    augment_data(whole, tmp_path / "a", AugmentSettings(SMALL, seed=3))
    # Other order, and one picture less.
    edit(
        file,
        images=body["images"][:0:-1],
        annotations=[a for a in body["annotations"] if a["image_id"] != 1][::-1],
    )
    augment_data(read_coco(file), tmp_path / "b", AugmentSettings(SMALL, seed=3))
    one, two = contents(tmp_path / "a"), contents(tmp_path / "b")
    shared = {name for name in two if name.endswith(".jpg")}
    assert len(shared) == 2
    assert all(one[name] == two[name] for name in shared)
    a, b = read_coco(tmp_path / "a"), read_coco(tmp_path / "b")
    assert all(a.objects[i.id] == b.objects[i.id] for i in b.images)
    augment_data(whole, tmp_path / "c", AugmentSettings(SMALL, seed=4))
    assert contents(tmp_path / "c") != one
    draws = {
        picture_generator(*key).random() for key in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    }
    assert len(draws) == 4


def test_processes_change_nothing(tmp_path):
    data = read_coco(make(tmp_path, images=11))
    augment_data(data, tmp_path / "one", AugmentSettings(SMALL, processes=1))
    augment_data(data, tmp_path / "two", AugmentSettings(SMALL, processes=2))
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


@pytest.mark.parametrize("images", [2, 12])
def test_a_damaged_picture_leaves_nothing_behind(tmp_path, images):
    file = make(tmp_path, images)
    data = read_coco(file)
    data.images[-1].path.write_bytes(data.images[-1].path.read_bytes()[:400])
    with pytest.raises(DataSetError, match=rf"{images:03d}\.jpg: is no whole picture"):
        augment_data(data, tmp_path / "out", AugmentSettings(SMALL))
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_interruption_leaves_nothing_behind(tmp_path):
    def stop(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        augment_data(read_coco(make(tmp_path)), tmp_path / "out", AugmentSettings(SMALL), stop)
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_no_folder_that_holds_something_is_written_into(tmp_path):
    file = make(tmp_path)
    data = read_coco(file)
    before = contents(file.parent)
    for out, why in (
        (file.parent, "exists already"),
        (file.parent / "new", "the data's own folder"),
        (file.parent / "images" / "new", "the data's own folder"),
        (file, "exists already"),
        (file / "new", "cannot be made|the data's own folder"),
    ):
        with pytest.raises(DataSetError, match=why):
            augment_data(data, out, AugmentSettings(SMALL))
    assert contents(file.parent) == before
    (tmp_path / "empty").mkdir()
    augment_data(data, tmp_path / "empty", AugmentSettings(SMALL))
    assert len(read_coco(tmp_path / "empty").images) == 3


def test_furniture_is_bent_as_people_are(tmp_path):
    box = [150.0, 100.0, 30.0, 60.0]
    file = write_set(tmp_path / "set", [annotation(7, 1, 2, box)])
    entry = read_coco(file).images[0].entry
    lost = [5000.0, 20.0, 30.0, 40.0]  # beside the picture
    edit(file, images=[{**entry, "furniture": [
        {"what": "sign", "bbox": box}, {"what": "tree", "bbox": lost}
    ]}])  # fmt: skip
    out = tmp_path / "new"
    augment_data(read_coco(file), out, AugmentSettings(SMALL, copies=3, processes=1))
    made = json.loads((out / "annotations.json").read_text())
    boxes = {note["image_id"]: note["bbox"] for note in made["annotations"]}
    assert boxes
    for image in made["images"]:
        things = image["furniture"]
        assert [thing["bbox"] for thing in things] == [
            boxes[i] for i in [image["id"]] if i in boxes
        ]
        assert all(thing["what"] == "sign" for thing in things)
