"""The training loop, on pictures that a minute of learning suffices for."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'bikeped[train]'")

from bikeped.config.schema import DetectionConfig  # noqa: E402
from bikeped.detection.detector import load_detector  # noqa: E402
from bikeped.errors import DataSetError, DetectorError  # noqa: E402
from bikeped.lab.training.coco import read_coco, read_picture  # noqa: E402
from bikeped.lab.training.crops import CropSettings  # noqa: E402
from bikeped.lab.training.export import export_network, export_weights  # noqa: E402
from bikeped.lab.training.fit import FitSettings, fit, learning_rate  # noqa: E402
from bikeped.lab.training.network import SmallDetector, is_small, load_weights, save_weights  # noqa: E402
from bikeped.lab.training.packing import PackSettings  # noqa: E402

CROPS = CropSettings(view=(160, 96), window=(96, 64), light=0, cover=0)
PACK = PackSettings(side=128, squares=2, pool=4)
SETTINGS = FitSettings(
    steps=3, pictures=2, warmup=2, memory=0.9, bfloat16=False, crops=CROPS, pack=PACK
)


def blobs(folder, pictures, seed):
    """Red squares are pedestrians, green bars cyclists; on grey noise. Names as bikeped's."""
    random = np.random.default_rng(seed)
    (folder / "images").mkdir(parents=True)
    images, notes = [], []
    for number in range(1, pictures + 1):
        rgb = random.normal(120, 6, (96, 160, 3)).clip(0, 255).astype(np.uint8)
        for kind in (1, 2):
            wide, high = (20, 20) if kind == 1 else (34, 16)
            u = int(random.integers(4 + 80 * (kind - 1), 76 + 80 * (kind - 1) - wide))
            v = int(random.integers(4, 92 - high))
            rgb[v : v + high, u : u + wide] = (220, 30, 30) if kind == 1 else (30, 200, 30)
            notes.append(
                {
                    "id": len(notes) + 1,
                    "image_id": number,
                    "category_id": kind,
                    "bbox": [u, v, wide, high],
                    "area": wide * high,
                    "iscrowd": 0,
                }
            )
        name = f"{number}.png"
        cv2.imwrite(str(folder / "images" / name), rgb[..., ::-1])
        images.append({"id": number, "file_name": name, "width": 160, "height": 96})
    categories = [{"id": 1, "name": "pedestrian"}, {"id": 2, "name": "cyclist"}]
    body = {"images": images, "annotations": notes, "categories": categories}
    (folder / "annotations.json").write_text(json.dumps(body))
    return read_coco(folder)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return blobs(tmp_path_factory.mktemp("blobs") / "train", 24, 1)


@pytest.fixture(scope="module")
def fitted(data):
    return fit(data, SETTINGS)


def test_the_same_seed_gives_the_same_weights(data, fitted):
    again, other = fit(data, SETTINGS), fit(data, replace(SETTINGS, seed=1))
    for key, value in fitted.network.state_dict().items():
        assert torch.equal(value, again.network.state_dict()[key]), key
    assert not torch.equal(
        fitted.network.heads[0].score.weight, other.network.heads[0].score.weight
    )


def test_progress_is_told_step_by_step(data):
    seen = []
    fit(data, replace(SETTINGS, steps=2), seen.append)
    assert seen == [1, 2]


def test_one_worker_and_two_both_learn_from_the_whole_batch(data):
    alone = fit(data, replace(SETTINGS, workers=1))
    assert alone.seconds > 0
    assert all(torch.isfinite(p).all() for p in alone.network.parameters())


def test_the_first_steps_see_squares_and_the_last_ones_windows(data, monkeypatch):
    from bikeped.lab.training import fit as module

    seen = []

    def tensors(crops, device):
        seen.append({crop.rgb.shape[:2] for crop in crops})
        return real(crops, device)

    real = module._tensors
    monkeypatch.setattr(module, "_tensors", tensors)
    fit(data, replace(SETTINGS, workers=1, steps=4, packed=0.5))
    assert seen == [{(128, 128)}] * 2 + [{(64, 96)}] * 2


def test_only_the_squares_are_looked_at_in_sixteen_bits(data, monkeypatch):
    from bikeped.lab.training import fit as module

    seen = []

    def loss(score, *others):
        seen.append(score.dtype)
        return real(score, *others)

    real = module.detection_loss
    monkeypatch.setattr(module, "detection_loss", loss)
    fitted = fit(data, replace(SETTINGS, workers=1, steps=4, packed=0.5, bfloat16=True))
    assert seen == [torch.bfloat16] * 2 + [torch.float32] * 2
    assert {p.dtype for p in fitted.network.parameters()} == {torch.float32}


def test_without_a_rate_for_matrices_adam_moves_all_weights(data, fitted):
    other = fit(data, replace(SETTINGS, matrix_rate=0.0))
    first, second = (f.network.stem[0].conv.weight for f in (fitted, other))
    assert torch.isfinite(second).all()
    assert not torch.equal(first, second)


def test_the_rate_rises_then_falls():
    settings = FitSettings(steps=100, warmup=10, rate=1.0)
    rates = [learning_rate(step, settings) for step in range(100)]
    assert rates[0] == pytest.approx(0.1)
    assert rates[9] == rates[10] == 1.0
    assert rates[10:] == sorted(rates[10:], reverse=True)
    assert 0.02 <= rates[-1] < 0.03


def test_weights_come_back_as_they_were(fitted, tmp_path):
    path = tmp_path / "weights.pt"
    save_weights(SmallDetector(fitted.network, fitted.names, fitted.size, {"seed": 3}), path)
    found = load_weights(path)
    network, names, size, facts = found.network, found.names, found.size, found.facts
    assert (names, size, facts) == (("pedestrian", "cyclist"), (160, 96), {"seed": 3})
    assert is_small(path)
    for key, value in fitted.network.state_dict().items():
        assert torch.equal(value, network.state_dict()[key])


def test_files_that_are_no_weights_are_named(tmp_path, fitted):
    path = tmp_path / "weights.pt"
    with pytest.raises(DetectorError, match=r"weights\.pt: cannot be read"):
        load_weights(path)
    path.write_bytes(b"nothing")
    with pytest.raises(DetectorError, match="no file of weights"):
        load_weights(path)
    torch.save({"some": "thing"}, path)
    assert not is_small(path)
    with pytest.raises(DetectorError, match="model train --network small"):
        load_weights(path)
    save_weights(SmallDetector(fitted.network, fitted.names, fitted.size), path)
    body = torch.load(path, weights_only=True)
    torch.save(body | {"names": ["one"]}, path)
    with pytest.raises(DetectorError, match="do not fit"):
        load_weights(path)


def test_unusable_data_are_named(data, tmp_path):
    with pytest.raises(DataSetError, match="multiples of 32"):
        fit(data, replace(SETTINGS, crops=replace(CROPS, window=(90, 64))))
    with pytest.raises(DataSetError, match="multiples of 64"):
        fit(data, replace(SETTINGS, pack=replace(PACK, side=100)))
    with pytest.raises(DataSetError, match="256 at most"):
        fit(data, replace(SETTINGS, pack=replace(PACK, side=320)))
    with pytest.raises(DataSetError, match="--batch"):
        fit(data, replace(SETTINGS, pictures=3))
    empty = blobs(tmp_path / "empty", 1, 0)
    body = json.loads(empty.source.read_text()) | {"annotations": []}
    empty.source.write_text(json.dumps(body))
    with pytest.raises(DataSetError, match="no object"):
        fit(read_coco(empty.source), SETTINGS)


def test_an_exported_file_is_what_the_detector_loads(fitted, tmp_path):
    weights, model = tmp_path / "weights.pt", tmp_path / "model.onnx"
    save_weights(SmallDetector(fitted.network, fitted.names, fitted.size, {"seed": 3}), weights)
    summary = export_weights(weights, model)
    assert summary.box_difference_px < 0.01
    assert summary.bytes == model.stat().st_size
    detector = load_detector(DetectionConfig(model=str(model)), tmp_path)
    assert detector.input_size == (160, 96)
    assert detector.layout == "yolov8"
    assert detector.family == "ultralytics"
    assert detector.infer(np.zeros((96, 160, 3), np.uint8), 160, 96) is not None


def test_nothing_is_written_where_runtime_and_pytorch_disagree(fitted, tmp_path, monkeypatch):
    from bikeped.lab.training import export

    monkeypatch.setattr(export, "_MOST_SCORE", -1.0)
    model = tmp_path / "model.onnx"
    with pytest.raises(DetectorError, match=r"model\.onnx: ONNX Runtime's answer differs"):
        export_network(SmallDetector(fitted.network, fitted.names, fitted.size), model)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_it_learns(data, tmp_path):
    settings = replace(SETTINGS, steps=240, pictures=4, rate=4e-3, warmup=10, memory=0.95)
    fitted = fit(data, settings)
    model = tmp_path / "model.onnx"
    export_network(SmallDetector(fitted.network, fitted.names, fitted.size), model)
    detector = load_detector(DetectionConfig(model=str(model), confidence=0.3), tmp_path)
    unseen = blobs(tmp_path / "test", 12, 99)
    right, wrong = 0, 0
    for image in unseen.images:
        found = detector.infer(read_picture(image), 160, 96).detections
        truth = unseen.objects[image.id]
        for thing in truth:
            close = np.abs(found.box_px - np.array(thing.box_px)).max(axis=1, initial=0) < 3
            right += bool((close & (found.kind == thing.category_id - 1)).any())
        wrong += max(0, len(found) - len(truth))
    assert right >= 22  # of 24
    assert wrong <= 2
