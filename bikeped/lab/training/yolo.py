"""Trains and exports YOLOv9 through LibreYOLO (MIT licence).

The library gets the data as bikeped reads them, letterboxes as `bikeped.detection` does (picture
centred), and exports with the metadata that `bikeped.detection` reads. Nothing is downloaded: the
training starts from the named weights, or from scratch.
"""

from __future__ import annotations

import importlib
import shutil
import tempfile
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bikeped.errors import DataSetError, DetectorError, require
from bikeped.files import make_folder, write_whole
from bikeped.lab.training.coco import CocoData, CocoImage, write_annotations
from bikeped.lab.training.export import ExportSummary, training_record, write_onnx

_VALIDATION_SHARE = 20  #: one picture in this many, without a validation set
_OPSET = 17


@dataclass(frozen=True)
class YoloTrainSettings:
    """Options of the training."""

    network: str = "yolov9-s"  #: yolov9-t, -s, -m, -c
    size: int = 1280
    epochs: int = 100
    batch: int = 8
    weights: Path | None = None
    device: str = "auto"
    workers: int = 4
    seed: int = 0


def train_yolo(
    data: CocoData, validation: CocoData | None, out: Path, order: YoloTrainSettings
) -> dict[str, Any]:
    """Writes `out`/weights.pt and `out`/model.onnx; returns a summary for JSON.

    Keeps the epoch that is best on `validation`, by default a held-out twentieth of `data`. Raises
    DataSetError and DetectorError.
    """
    if order.size % 32:
        raise DataSetError(f"--size {order.size}: must be a multiple of 32; choose another")
    model = _load(order.weights, order.network.removeprefix("yolov9-"), order.device)
    began = time.monotonic()
    description = write_data(data, validation, out / "data", order.seed)
    answer = model.train(
        data=str(description),
        epochs=order.epochs,
        batch=order.batch,
        imgsz=order.size,
        device="" if order.device == "auto" else order.device,
        workers=order.workers,
        seed=order.seed,
        project=str(out / "runs"),
        name="train",
        exist_ok=True,
        letterbox_pad="center",
    )
    best = Path(str(answer.get("best_checkpoint") or ""))
    if not best.is_file():
        raise DetectorError(f"{out / 'runs'}: LibreYOLO left no weights; see its log there")
    weights = out / "weights.pt"
    write_whole(weights, best.read_bytes())
    exported = export_yolo(weights, out / "model.onnx", order.size)
    order_json = asdict(order) | {"weights": None if order.weights is None else str(order.weights)}
    return {
        "network": order.network,
        "library": f"libreyolo {version('libreyolo')}",
        **training_record(data, weights, exported),
        "seconds": round(time.monotonic() - began, 1),
        "device": order.device,
        "torch": version("torch"),
        "settings": order_json,
        "results": {k: v for k, v in answer.items() if isinstance(v, int | float | str)},
    }


def export_yolo(weights: Path, out: Path, size: int) -> ExportSummary:
    """Exports LibreYOLO's weights for a square input. Raises DetectorError."""
    model = _load(weights, None, "cpu")
    names = [str(model.names[i]) for i in range(len(model.names))]
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / "model.onnx"
        fixed = {"opset": _OPSET, "dynamic": False, "simplify": False, "device": "cpu"}
        model.export("onnx", output_path=str(draft), imgsz=size, **fixed)
        content = draft.read_bytes()
    picture = np.random.default_rng(0).random((1, 3, size, size), np.float32)
    outputs = [(picture, _torch_answer(model, picture))]
    return write_onnx(out, content, names, (size, size), outputs)


def write_data(data: CocoData, validation: CocoData | None, folder: Path, seed: int) -> Path:
    """Writes the library's data.yaml, which refers to the pictures where they are; its path."""
    images = list(data.images)
    if validation is None:
        if len(images) < 2:
            raise DataSetError(f"{data.source}: one picture is too few; name --validation, too")
        order = np.random.default_rng(seed).permutation(len(images))
        held = set(order[: max(1, len(images) // _VALIDATION_SHARE)].tolist())
        parts = [
            (data, [image for i, image in enumerate(images) if i not in held]),
            (data, [image for i, image in enumerate(images) if i in held]),
        ]
    else:
        if list(validation.categories.values()) != list(data.categories.values()):
            raise DataSetError(
                f"{validation.source}: categories: are not those of {data.source}; use the same, "
                "in the same order"
            )
        parts = [(data, images), (validation, list(validation.images))]
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    description: dict[str, Any] = {"path": str(folder.resolve()), "annotations": {}}
    for name, (source, chosen) in zip(("train", "val"), parts, strict=True):
        _write_part(folder / f"{name}.json", source, chosen)
        description[name] = str(_root(source))
        description["annotations"][name] = str(folder.resolve() / f"{name}.json")
    description |= {"nc": len(data.categories), "names": dict(enumerate(data.categories.values()))}
    write_whole(folder / "data.yaml", yaml.safe_dump(description, allow_unicode=True))
    return folder / "data.yaml"


def _write_part(path: Path, source: CocoData, images: Iterable[CocoImage]) -> None:
    chosen = list(images)
    notes = [
        {
            "id": found.id,
            "image_id": found.image_id,
            "category_id": found.category_id,
            "bbox": [u1, v1, u2 - u1, v2 - v1],
            "area": (u2 - u1) * (v2 - v1),
            "iscrowd": int(found.crowd),
        }
        for image in chosen
        for found in source.objects[image.id]
        for u1, v1, u2, v2 in [found.box_px]
    ]
    entries = [
        {"id": i.id, "file_name": i.file_name, "width": i.width, "height": i.height} for i in chosen
    ]
    categories = [{"id": key, "name": name} for key, name in source.categories.items()]
    write_annotations(path, {"categories": categories}, entries, notes)


def _root(data: CocoData) -> Path:
    """The folder that the file names start from."""
    image = data.images[0]
    return Path(*image.path.resolve().parts[: -len(Path(image.file_name).parts)])


def _load(weights: Path | None, size: str | None, device: str) -> Any:
    """The library's model: from `weights`, or a fresh one of `size`."""
    require("libreyolo")
    library = importlib.import_module("libreyolo")
    if weights is not None and not weights.is_file():
        # The library would try to download it.
        raise DetectorError(f"{weights}: does not exist; name a file of weights")
    try:
        if weights is None:
            model = library.LibreYOLO9(None, size, device=device)
        else:
            model = library.LibreYOLO(str(weights), device=device)
    except Exception as error:  # its errors share no class but this one
        reason = " ".join(str(error).split())[:200]
        raise DetectorError(f"{weights or size}: LibreYOLO cannot use it ({reason})") from error
    if type(model).__name__ != "LibreYOLO9":
        raise DetectorError(f"{weights}: is a {type(model).__name__}; bikeped exports YOLOv9 only")
    return model


def _torch_answer(model: Any, picture: Any) -> Any:
    torch = importlib.import_module("torch")
    network = model.model.eval()
    with torch.no_grad():
        answer = network(torch.from_numpy(picture))
    while not hasattr(answer, "shape"):  # the library returns nested tensors
        answer = answer["predictions"] if isinstance(answer, dict) else answer[0]
    return answer.numpy()
