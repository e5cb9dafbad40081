"""Draws training sets: many streets, lights and cameras, every part from its own seed.

Most parts are views of the configured camera, moved and turned a little; the others of random
fisheye lenses, heights and pitches. All else depends on the seeds of `bikeped.lab.rendering`.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bikeped.config.load import LoadedConfig
from bikeped.errors import DataSetError
from bikeped.files import make_folder
from bikeped.lab.process_pool import worker_pool
from bikeped.lab.rendering import SceneCamera, scene_camera
from bikeped.lab.rendering.dataset import SceneMix, write_dataset
from bikeped.lab.rendering.render_camera import DEFAULT_POSE
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.lab.training.coco import write_annotations

#: Seeds of a set's parts begin at its seed times this: sets share no street.
SEEDS_A_SET = 10_000
#: More difficult cases than in the streets that a detector is tested on.
HARD_MIX = SceneMix(scooters=0.4, wheelchairs=0.2, beside=0.45, clutter=9)
_SMALL, _LARGE = (1280, 720), (1920, 1080)


@dataclass(frozen=True)
class DrawnSettings:
    """Number and kind of pictures."""

    pictures: int = 5000
    seed: int = 1
    part: int = 20  #: pictures that share a camera
    configured: float = 0.9  #: share of parts seen by the configured camera
    large: float = 0.75  #: share of parts drawn at 1920 x 1080, the others at 1280 x 720
    lens: str = "fisheye"  #: of the other cameras: fisheye or rectilinear
    mix: SceneMix = HARD_MIX
    processes: int = 2


def draw_training_set(
    folder: Path,
    settings: DrawnSettings,
    loaded: LoadedConfig,
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Draws a set into `folder` (new, or empty) and returns its annotation file.

    The same settings and configuration give the same pictures, whatever the number of processes.
    Raises DataSetError where the folder is taken.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataSetError(f"{folder}: is there already; choose another folder or remove it")
    parts = -(-settings.pictures // settings.part)
    if parts > SEEDS_A_SET:
        raise DataSetError(f"pictures: {settings.pictures} are more than a set can have")
    make_folder(folder)
    jobs = [
        (folder, number, min(settings.part, settings.pictures - number * settings.part))
        for number in range(parts)
    ]
    images: list[dict[str, Any]] = []
    notes: list[dict[str, Any]] = []
    header: dict[str, Any] = {}
    with worker_pool(settings.processes) as pool:
        answers = [pool.submit(_draw, *job, settings, loaded) for job in jobs]
        for answer in answers:
            data = json.loads(answer.result().read_text(encoding="utf-8"))
            part = answer.result().parent.name
            shift_image, shift_note = len(images), len(notes)
            for image in data["images"]:
                name = f"{part}/images/{image['file_name']}"
                images.append(image | {"id": image["id"] + shift_image, "file_name": name})
            for note in data["annotations"]:
                ids = {"id": note["id"] + shift_note, "image_id": note["image_id"] + shift_image}
                notes.append(note | ids)
            header = {"info": {"description": "drawn by bikeped"}, "categories": data["categories"]}
            progress(len(images))
    write_annotations(folder / "annotations.json", header, images, notes)
    return folder / "annotations.json"


def part_camera(
    settings: DrawnSettings, number: int, loaded: LoadedConfig
) -> tuple[SceneCamera | None, tuple[int, int]]:
    """The camera of a part (None: `lab.rendering` draws one for each street) and the size."""
    random = np.random.default_rng([settings.seed, number, 7])
    size = _LARGE if random.random() < settings.large else _SMALL
    if random.random() >= settings.configured:
        return None, size
    pose = CameraPose(
        DEFAULT_POSE.x_m + float(random.uniform(-2.5, 2.5)),
        DEFAULT_POSE.y_m + float(random.uniform(-1.5, 1.5)),
        DEFAULT_POSE.heading_deg + float(random.uniform(-15, 15)),
    )
    return scene_camera(loaded, size, pose), size


def _draw(
    folder: Path, number: int, count: int, settings: DrawnSettings, loaded: LoadedConfig
) -> Path:
    cv2.setNumThreads(1)
    camera, size = part_camera(settings, number, loaded)
    seed, target = settings.seed * SEEDS_A_SET + number, folder / f"{number:04d}"
    lens, mix = settings.lens, settings.mix
    return write_dataset(target, count, seed, camera, size=size, lens=lens, mix=mix)
