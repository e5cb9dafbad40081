"""Small data sets in COCO's format, made for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

CATEGORIES = [
    {"id": 1, "name": "person", "supercategory": "person"},
    {"id": 2, "name": "bicycle", "supercategory": "vehicle"},
    {"id": 3, "name": "car", "supercategory": "vehicle"},
]


def annotation(
    number: int, image: int, category: int, bbox: list[float], **more: Any
) -> dict[str, Any]:
    """One annotation with what COCO asks for."""
    area = bbox[2] * bbox[3]
    base = {"id": number, "image_id": image, "category_id": category, "bbox": bbox, "area": area}
    return {**base, "iscrowd": 0, **more}


def picture(width: int, height: int, seed: int = 0) -> np.ndarray:
    """A smooth coloured picture, BGR: JPEG keeps it nearly unchanged."""
    small = np.random.default_rng(seed).integers(0, 255, (6, 8, 3), np.uint8)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def write_set(
    folder: Path,
    annotations: list[dict[str, Any]],
    *,
    images: int = 1,
    size: tuple[int, int] = (320, 240),
    layout: str = "plain",
) -> Path:
    """A data set of `images` pictures with the ids 1, 2, ...; gives the annotation file.

    `layout`: "plain" is annotations.json beside images/, "coco" is COCO's own.
    """
    pictures = folder / ("images" if layout == "plain" else "tiny")
    pictures.mkdir(parents=True)
    prefix = "images/" if layout == "plain" else ""
    entries = []
    for number in range(1, images + 1):
        name = f"{number:03d}.jpg"
        cv2.imwrite(str(pictures / name), picture(*size, seed=number))
        entry = {"id": number, "file_name": prefix + name, "width": size[0], "height": size[1]}
        entries.append({**entry, "license": 4, "coco_url": f"file:{name}"})
    body = {
        "info": {"description": "made for a test", "year": 2024},
        "licenses": [{"id": 4, "name": "CC BY", "url": "https://example.org"}],
        "images": entries,
        "annotations": annotations,
        "categories": CATEGORIES,
    }
    if layout == "plain":
        file = folder / "annotations.json"
    else:
        file = folder / "annotations" / "instances_tiny.json"
        file.parent.mkdir()
    file.write_text(json.dumps(body))
    return file


def edit(file: Path, **parts: Any) -> None:
    """Replaces top-level parts of an annotation file."""
    file.write_text(json.dumps({**json.loads(file.read_text()), **parts}))
