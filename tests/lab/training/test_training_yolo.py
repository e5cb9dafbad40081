"""What LibreYOLO is handed and what is made of its answer, against a stand-in for the library.

The stand-in reads the description as the library does (YAML, then COCO's JSON beside named
folders) and exports a tiny real network, so the export and its check are real.
"""

from __future__ import annotations

import json
import sys
import types
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import yaml
from coco_sets import annotation, write_set

from bikeped.config.schema import DetectionConfig
from bikeped.detection.detector import load_detector
from bikeped.errors import DataSetError, DetectorError
from bikeped.lab.training.coco import read_coco

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'bikeped[train]'")

from bikeped.lab.training import yolo  # noqa: E402
from bikeped.lab.training.yolo import YoloTrainSettings, export_yolo, train_yolo, write_data  # noqa: E402


class Network(torch.nn.Module):
    """Answers [n, 4 + 3, cells] in the layout of YOLOv9: boxes of its grid, no score above 1 %."""

    def forward(self, x):
        cells = sum((x.shape[2] // s) * (x.shape[3] // s) for s in (8, 16, 32))
        box = torch.arange(4 * cells, dtype=torch.float32).reshape(1, 4, cells) + x.mean()
        score = torch.full((1, 3, cells), 0.01) * x.mean()
        return {"predictions": torch.cat([box, score], 1)}


class LibreYOLO9:
    made: ClassVar[list[LibreYOLO9]] = []

    def __init__(self, weights, size, device="auto"):
        self.weights, self.size, self.device = weights, size, device
        self.names = {0: "person", 1: "bicycle", 2: "car"}
        self.model = Network()
        self.asked = None
        LibreYOLO9.made.append(self)

    def train(self, **asked):
        self.asked = asked
        best = Path(asked["project"]) / asked["name"] / "best.pt"
        best.parent.mkdir(parents=True)
        best.write_bytes(b"best weights")
        return {"best_checkpoint": str(best), "best_mAP50_95": 0.5, "history": [1]}

    def export(self, kind, *, output_path, imgsz, opset, dynamic, simplify, device):
        assert (kind, dynamic, simplify, device) == ("onnx", False, False, "cpu")
        import warnings

        class Flat(torch.nn.Module):
            def forward(self, x):
                return Network()(x)["predictions"]

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.onnx.export(
                Flat(),
                (torch.zeros(1, 3, imgsz, imgsz),),
                output_path,
                opset_version=opset,
                dynamo=False,
                input_names=["images"],
                output_names=["output"],
            )


@pytest.fixture(autouse=True)
def library(monkeypatch):
    module = types.ModuleType("libreyolo")
    module.LibreYOLO9 = LibreYOLO9
    module.LibreYOLO = lambda path, device: LibreYOLO9(path, None, device)
    monkeypatch.setitem(sys.modules, "libreyolo", module)
    monkeypatch.setattr("bikeped.errors.find_spec", lambda name: object())
    monkeypatch.setattr(yolo, "version", lambda name: "1.6.0")
    LibreYOLO9.made = []
    return module


@pytest.fixture
def data(tmp_path):
    notes = [annotation(n, n, 1 + n % 3, [10, 20, 30, 40]) for n in range(1, 41)]
    return read_coco(write_set(tmp_path / "set", notes, images=40))


def split_of(description, name):
    """What the library reads of one part: folder of the pictures and the annotation file."""
    text = yaml.safe_load(description.read_text())
    return Path(text[name]), json.loads(Path(text["annotations"][name]).read_text()), text


def test_the_library_gets_the_data_as_bikeped_read_them(data, tmp_path):
    description = write_data(data, None, tmp_path / "out", 3)
    ids = []
    for name in ("train", "val"):
        folder, body, text = split_of(description, name)
        for image in body["images"]:
            assert (folder / image["file_name"]).is_file()
            ids.append(image["id"])
        assert {n["image_id"] for n in body["annotations"]} == {i["id"] for i in body["images"]}
        assert all(n["bbox"] == [10, 20, 30, 40] for n in body["annotations"])
        assert text["names"] == {0: "person", 1: "bicycle", 2: "car"}
        assert text["nc"] == 3
    assert sorted(ids) == list(range(1, 41))
    assert len(split_of(description, "val")[1]["images"]) == 2
    again = write_data(data, None, tmp_path / "again", 3)
    assert split_of(again, "val")[1] == split_of(description, "val")[1]


def test_a_validation_set_of_ones_own(data, tmp_path):
    other = read_coco(write_set(tmp_path / "other", [], images=2))
    description = write_data(data, other, tmp_path / "out", 0)
    assert len(split_of(description, "train")[1]["images"]) == 40
    folder, body, _ = split_of(description, "val")
    assert folder == other.source.parent
    assert len(body["images"]) == 2
    body = json.loads(other.source.read_text())
    body["categories"] = body["categories"][:2]
    other.source.write_text(json.dumps(body))
    with pytest.raises(DataSetError, match="categories: are not those of"):
        write_data(data, read_coco(other.source), tmp_path / "out", 0)


def test_names_that_yaml_would_misread(tmp_path):
    file = write_set(tmp_path / "it's a set: #1", [], images=2)
    body = json.loads(file.read_text())
    body["categories"][0]["name"] = "it's: no"
    file.write_text(json.dumps(body))
    folder, _, text = split_of(write_data(read_coco(file), None, tmp_path / "o'ut", 0), "train")
    assert text["names"][0] == "it's: no"
    assert folder == file.parent


def test_training_asks_for_what_was_ordered_and_leaves_a_model(data, tmp_path):
    out = tmp_path / "out"
    order = YoloTrainSettings(
        "yolov9-t", size=64, epochs=2, batch=4, device="cpu", workers=0, seed=5
    )
    summary = train_yolo(data, None, out, order)
    trained = LibreYOLO9.made[0]
    assert (trained.weights, trained.size, trained.device) == (None, "t", "cpu")
    asked = dict(trained.asked)
    assert asked.pop("data") == str(out / "data" / "data.yaml")
    assert asked.pop("project") == str(out / "runs")
    assert asked == {
        "epochs": 2,
        "batch": 4,
        "imgsz": 64,
        "device": "cpu",
        "workers": 0,
        "seed": 5,
        "name": "train",
        "exist_ok": True,
        "letterbox_pad": "center",
    }
    assert (out / "weights.pt").read_bytes() == b"best weights"
    detector = load_detector(DetectionConfig(model=str(out / "model.onnx")), out)
    assert (detector.input_size, detector.layout, detector.family) == (
        (64, 64),
        "yolov8",
        "ultralytics",
    )
    assert summary["results"] == {
        "best_checkpoint": str(out / "runs" / "train" / "best.pt"),
        "best_mAP50_95": 0.5,
    }
    assert (summary["names"], summary["size"]) == (["person", "bicycle", "car"], [64, 64])
    json.dumps(summary)


def test_weights_to_start_from(data, tmp_path):
    start = tmp_path / "start.pt"
    order = YoloTrainSettings("yolov9-s", size=64, epochs=1, weights=start)
    with pytest.raises(DetectorError, match=r"start\.pt: does not exist"):
        train_yolo(data, None, tmp_path / "out", order)
    start.write_bytes(b"weights")
    train_yolo(data, None, tmp_path / "out", order)
    assert LibreYOLO9.made[0].weights == str(start)


def test_no_weights_left_is_an_error(data, tmp_path, monkeypatch):
    monkeypatch.setattr(LibreYOLO9, "train", lambda self, **asked: {})
    with pytest.raises(DetectorError, match="left no weights"):
        train_yolo(data, None, tmp_path / "out", YoloTrainSettings(size=64))


def test_an_odd_size_or_one_picture_is_refused(data, tmp_path):
    with pytest.raises(DataSetError, match="multiple of 32"):
        train_yolo(data, None, tmp_path / "out", YoloTrainSettings(size=100))
    one = read_coco(write_set(tmp_path / "one", [], images=1))
    with pytest.raises(DataSetError, match="--validation"):
        write_data(one, None, tmp_path / "out", 0)


def test_another_family_is_refused(tmp_path, library):
    weights = tmp_path / "weights.pt"
    weights.write_bytes(b"weights")
    library.LibreYOLO = lambda path, device: types.SimpleNamespace()
    with pytest.raises(DetectorError, match="YOLOv9 only"):
        export_yolo(weights, tmp_path / "model.onnx", 64)

    def broken(path, device):
        raise RuntimeError("bad\nfile")

    library.LibreYOLO = broken
    with pytest.raises(DetectorError, match=r"cannot use it \(bad file\)"):
        export_yolo(weights, tmp_path / "model.onnx", 64)


def test_an_export_that_differs_from_pytorch_is_not_kept(tmp_path, monkeypatch):
    weights = tmp_path / "weights.pt"
    weights.write_bytes(b"weights")
    monkeypatch.setattr(yolo, "_torch_answer", lambda model, picture: np.zeros((1, 7, 84)))
    with pytest.raises(DetectorError, match="differs from PyTorch"):
        export_yolo(weights, tmp_path / "model.onnx", 64)
    assert not (tmp_path / "model.onnx").exists()
