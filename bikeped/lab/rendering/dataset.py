"""Sets of drawn pictures in COCO's format, for training and evaluation."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bikeped.errors import BikepedError
from bikeped.files import make_folder, whole_folder
from bikeped.lab.rendering.clip import encode_jpeg
from bikeped.lab.rendering.conditions import Conditions, random_conditions
from bikeped.lab.rendering.labels import DrawnObject
from bikeped.lab.rendering.painter import Box, ScenePainter
from bikeped.lab.rendering.random_scene import DEFAULT_MIX, SceneMix, random_camera, random_scenario
from bikeped.lab.rendering.render_camera import SceneCamera
from bikeped.types import ImageArray, Kind

CATEGORIES = [{"id": kind.value + 1, "name": kind.label} for kind in Kind]
#: An object with a smaller visible share or box is marked as a crowd, which COCO's measures ignore.
MIN_VISIBLE = 0.3
MIN_SIDE_PX = 5.0
PICTURES_A_STREET = 4  #: a street takes longer to draw than its road users


@dataclass(frozen=True)
class DrawnPicture:
    """One picture [h, w, 3] RGB, the road users and the fixtures in it."""

    image: ImageArray
    objects: list[DrawnObject]
    conditions: Conditions
    camera: SceneCamera
    furniture: list[tuple[str, Box]]  #: `ScenePainter.furniture`, and each agent's `shadow`


def pictures(
    count: int,
    seed: int,
    camera: SceneCamera | None = None,
    *,
    size: tuple[int, int] = (960, 540),
    lens: str = "fisheye",
    mix: SceneMix = DEFAULT_MIX,
) -> Iterator[DrawnPicture]:
    """Draws `count` pictures of random scenarios, lights, weathers and places.

    `camera`: for all of them; None draws a camera for every street (`lens`: fisheye or
    rectilinear). Equal arguments give equal pictures; a larger `count` begins with the same ones.
    """
    for number in range(count):
        street = seed * 1_000_003 + number // PICTURES_A_STREET
        conditions = random_conditions(street, mix.clutter)
        view = camera or random_camera(street, size, lens)
        rng = np.random.default_rng((seed, number, 59))
        painter = ScenePainter(random_scenario(seed * 1_000_003 + number, mix), view, conditions)
        t_s = float(rng.uniform(0.2, 5.8))
        image, objects = painter.draw(t_s)
        things = painter.furniture() + [("shadow", box) for box in painter.shadows(t_s)]
        yield DrawnPicture(image, objects, conditions, view, things)


def write_dataset(
    folder: Path,
    count: int,
    seed: int = 0,
    camera: SceneCamera | None = None,
    *,
    size: tuple[int, int] = (960, 540),
    lens: str = "fisheye",
    mix: SceneMix = DEFAULT_MIX,
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Writes `folder`/images/*.jpg and `folder`/annotations.json; returns the latter.

    The folder appears whole or not at all, so it must not be there yet (or be empty). Annotations
    carry `visible` (share), `distance_m`, `kind` and `ignore` beside COCO's keys; hardly visible or
    tiny ones have `iscrowd` 1. Images carry `conditions`, and in `furniture` the fixtures: `what`
    each is and its `bbox`, which may reach beyond the picture. Raises BikepedError when the folder
    is taken or not writable.
    """
    if not 1 <= count <= 1_000_000:
        raise BikepedError(f"count: {count} is not 1 to 1000000 pictures")
    if seed < 0:
        raise BikepedError(f"seed: {seed} must not be negative")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise BikepedError(f"{folder}: is there already; choose another folder or remove it")
    make_folder(folder.parent)
    drawn = pictures(count, seed, camera, size=size, lens=lens, mix=mix)
    try:
        with whole_folder(folder) as partial:
            _write_pictures(partial, drawn, {"seed": seed, "lens": lens}, progress)
    except OSError as error:
        raise BikepedError(
            f"{folder}: cannot be written ({error.strerror}); choose another folder, or check the "
            "free disk space"
        ) from error
    return folder / "annotations.json"


def _write_pictures(
    folder: Path,
    drawn: Iterator[DrawnPicture],
    info: dict[str, Any],
    progress: Callable[[int], None],
) -> None:
    (folder / "images").mkdir()
    images: list[dict[str, Any]] = []
    notes: list[dict[str, Any]] = []
    for number, one in enumerate(drawn):
        name = f"{number:06d}.jpg"
        quality = 78 + (info["seed"] * 7 + number * 5) % 18
        (folder / "images" / name).write_bytes(encode_jpeg(one.image, quality))
        images.append(
            {
                "id": number + 1,
                "file_name": name,
                "width": one.image.shape[1],
                "height": one.image.shape[0],
                "conditions": asdict(one.conditions),
                "furniture": [{"what": w, "bbox": _bbox(box)} for w, box in one.furniture],
            }
        )
        notes += [_annotation(len(notes) + i + 1, number + 1, o) for i, o in enumerate(one.objects)]
        progress(number + 1)
    data = {
        "info": {"description": "drawn by bikeped", **info},
        "images": images,
        "annotations": notes,
        "categories": CATEGORIES,
    }
    (folder / "annotations.json").write_text(json.dumps(data) + "\n", encoding="utf-8")


def _annotation(number: int, image: int, item: DrawnObject) -> dict[str, Any]:
    u1, v1, u2, v2 = item.box_px
    hard = item.visible < MIN_VISIBLE or min(u2 - u1, v2 - v1) < MIN_SIDE_PX
    return {
        "id": number,
        "image_id": image,
        "category_id": item.label.value + 1,
        "bbox": _bbox(item.box_px),
        "area": round((u2 - u1) * (v2 - v1), 2),
        "iscrowd": int(hard),
        "ignore": int(hard),
        "visible": round(item.visible, 4),
        "distance_m": round(item.distance_m, 3),
        "kind": item.kind,
    }


def _bbox(box_px: Box) -> list[float]:
    """COCO's x, y, width, height."""
    u1, v1, u2, v2 = box_px
    return [round(u1, 2), round(v1, 2), round(u2 - u1, 2), round(v2 - v1, 2)]
