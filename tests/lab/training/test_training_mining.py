"""Mistakes on the pictures to learn from become windows of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'bikeped[train]'")

from test_training_fit import CROPS, SETTINGS, blobs  # noqa: E402

from bikeped.geometry.boxes import iou_matrix  # noqa: E402
from bikeped.lab.training.coco import FALSE_POSITIVE, furniture  # noqa: E402
from bikeped.lab.training.crops import Cropper, object_centres, read_sample  # noqa: E402
from bikeped.lab.training.fit import fit, shown_size  # noqa: E402
from bikeped.lab.training.hard_negative_mining import MiningSettings, mine_false_positives  # noqa: E402
from bikeped.lab.training.network import shift_scores  # noqa: E402
from bikeped.lab.training.packing import Packer, PackSettings  # noqa: E402

ALL = MiningSettings(confidence=0.05, processes=1)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return blobs(tmp_path_factory.mktemp("mining") / "train", 12, 1)


@pytest.fixture(scope="module")
def eager(data):
    """Has learnt next to nothing, and sees somebody everywhere."""
    network = fit(data, SETTINGS).network
    with torch.no_grad():
        answer, _ = network(torch.zeros(1, 3, 96, 160))
    most = answer.sigmoid().amax((0, 2)).tolist()
    shift_scores(network, [m * 0.8 for m in most], 0.5)
    return network


@pytest.fixture(scope="module")
def mined(data, eager):
    return mine_false_positives(eager, data, (160, 96), ALL)


def mistakes(image):
    return np.array([box for what, box in furniture(image) if what == FALSE_POSITIVE]).reshape(
        -1, 4
    )


def test_a_mistake_is_on_nobody(data, mined):
    told, count = mined
    assert count == sum(len(mistakes(image)) for image in told.images) > 0
    assert [image.path for image in told.images] == [image.path for image in data.images]
    assert told.objects == data.objects
    for image in told.images:
        people = np.array([o.box_px for o in told.objects[image.id]], np.float32)
        # Furniture is cut at the picture's edge, which raises an overlap a little.
        assert (iou_matrix(mistakes(image).astype(np.float32), people) < 0.15).all()


def test_a_further_look_forgets_the_one_before_and_keeps_what_stands_there(data, eager, mined):
    stands = {"what": "bin", "bbox": [3.0, 4.0, 20.0, 30.0]}
    told = replace(
        mined[0],
        images=tuple(
            replace(i, entry={**i.entry, "furniture": [stands, *i.entry["furniture"]]})
            for i in mined[0].images
        ),
    )
    again, count = mine_false_positives(eager, told, (160, 96), replace(ALL, processes=2))
    assert count == mined[1]
    for image, first in zip(again.images, mined[0].images, strict=True):
        assert furniture(image)[0] == ("bin", (3.0, 4.0, 23.0, 34.0))
        assert np.allclose(mistakes(image), mistakes(first))
    sure, none = mine_false_positives(eager, told, (160, 96), replace(ALL, confidence=1.0))
    assert none == 0
    assert not any(len(mistakes(image)) for image in sure.images)


def test_windows_are_cut_around_mistakes(mined):
    told, _ = mined
    image = next(i for i in told.images if len(mistakes(i)))
    (first, *_) = mistakes(image)
    image = replace(
        image, entry={"furniture": [{"what": FALSE_POSITIVE, "bbox": [first[0], first[1], 12, 9]}]}
    )
    view = read_sample(told, image, (160, 96))
    assert view.false_positive_px.tolist() == [[first[0], first[1], first[0] + 12, first[1] + 9]]
    # A white spot where the mistake is: every window shows all of it.
    u1, v1, u2, v2 = np.array(view.false_positive_px[0]).round().astype(int)
    rgb = np.zeros_like(view.rgb)
    rgb[v1:v2, u1:u2] = 255
    view = replace(view, rgb=rgb)
    white = (rgb > 127).sum()
    crops = replace(CROPS, scale=(1.0, 1.0), around_mistaken=1.0)
    cutter = Cropper(crops, 0, object_centres(told, (160, 96)))
    for seed in range(20):
        crop = cutter(view, np.random.default_rng(seed))
        assert (crop.rgb > 127).sum() == pytest.approx(white, rel=0.25)
    pack = PackSettings(side=128, mistaken=1.0)
    (square,) = Packer(pack, crops, cutter)([view], 1, np.random.default_rng(0))
    assert (square.rgb > 127).sum() == pytest.approx(4 * white, rel=0.25)  # 64 px each


def test_training_looks_when_it_is_told_to_and_learns_the_same_each_time(data):
    lines = []
    settings = replace(
        SETTINGS, steps=4, mining=MiningSettings(after=(0.5, 0.75), confidence=0.001)
    )
    first = fit(data, settings, say=lines.append)
    assert len(first.mistakes) == 2
    assert [line.split(",")[0] for line in lines if "false positives" in line] == [
        "step 2",
        "step 3",
    ]
    again = fit(data, settings)
    assert again.mistakes == first.mistakes
    for key, value in first.network.state_dict().items():
        assert torch.equal(value, again.network.state_dict()[key])
    assert fit(data, replace(settings, mining=MiningSettings())).mistakes == []


def test_it_looks_at_whole_frames_as_large_as_the_windows_are_on_average():
    assert shown_size(replace(CROPS, view=(1280, 736), scale=(0.8, 1.02))) == (1152, 672)
    assert shown_size(replace(CROPS, view=(64, 32), scale=(0.1, 0.2))) == (32, 32)
