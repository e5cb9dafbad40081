"""Random scenarios and cameras, and sets of pictures of them in COCO's format, for training and
evaluation."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bikeped.errors import BikepedError, GeometryError
from bikeped.files import make_folder, whole_folder
from bikeped.geometry.lens import Lens
from bikeped.lab.rendering.clip import encode_jpeg
from bikeped.lab.rendering.conditions import Conditions, random_conditions
from bikeped.lab.rendering.labels import DrawnObject
from bikeped.lab.rendering.painter import Box, ScenePainter
from bikeped.lab.rendering.render_camera import (
    DEFAULT_POSE,
    SceneCamera,
    lens_camera,
    rectilinear_camera,
)
from bikeped.lab.scenarios.scenario import SIZES_M, Agent, Scenario
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.types import ImageArray, Kind

_DURATION_S = 6.0
_NEAREST_M, _FARTHEST_M = 1.5, 40.0
CATEGORIES = [{"id": kind.value + 1, "name": kind.label} for kind in Kind]
#: An object with a smaller visible share or box is marked as a crowd, which COCO's measures ignore.
MIN_VISIBLE = 0.3
MIN_SIDE_PX = 5.0
PICTURES_A_STREET = 4  #: a street takes longer to draw than its road users


@dataclass(frozen=True)
class SceneMix:
    """Shares of rare and difficult road users and fixtures in random scenarios and streets."""

    scooters: float = 0.25  #: share of e-scooters among the cyclists
    wheelchairs: float = 0.1  #: share of wheelchair users among the pedestrians
    beside: float = 0.25  #: share of the pedestrians close to another road user
    clutter: int = 0  #: up to this many more bollards, bins, signs and hydrants near the camera


DEFAULT_MIX = SceneMix()


def random_scenario(seed: int, mix: SceneMix = DEFAULT_MIX) -> Scenario:
    """A scenario of 6 s: walkers, children, wheelchairs, cyclists, e-scooters and vehicles, from
    one to a crowd, 1.5 to 40 m from the default camera, in all directions, some standing still.
    """
    rng = np.random.default_rng((seed, 41))
    busy = float(rng.choice([0.3, 1.0, 1.8]))
    agents: list[Agent] = []
    taken: list[tuple[float, float, float]] = []

    def add(kind: str, size: tuple[float, float, float], speed: float, spread: float = 0.0) -> None:
        for _ in range(12):
            x, y = _spot(rng, kind)
            if spread and taken:  # close to a road user already placed
                tx, ty, _ = taken[int(rng.integers(len(taken)))]
                x, y = tx + float(rng.normal(0, spread)), ty + float(rng.normal(0, spread))
            room = max(size[0], size[1]) / 2 + 0.25
            if all(math.hypot(x - a, y - b) > room + r for a, b, r in taken):
                break
        else:
            return
        taken.append((x, y, room - 0.25))
        heading = _heading(rng, kind)
        # The agent is at its spot in the middle of the clip; a still one needs a path, too.
        step = speed * _DURATION_S / 2 if speed >= 0.05 else 0.01
        dx, dy = math.cos(heading) * step, math.sin(heading) * step
        path = np.array([[0.0, x - dx, y - dy], [_DURATION_S, x + dx, y + dy]])
        agents.append(Agent(len(agents) + 1, kind, path, size))

    def varied(kind: str, part: float = 0.08) -> tuple[float, float, float]:
        length, width, height = SIZES_M[kind]
        s = 1 + float(np.clip(rng.normal(0, part / 2), -part, part))
        return length * s, width * s, height * s

    for _ in range(int(rng.poisson(3.4 * busy))):
        draw = rng.random()
        size = varied("pedestrian")
        if draw < 0.15:
            tall = float(rng.uniform(0.95, 1.35))
            size = (0.26, 0.36, tall)
        elif draw < 0.15 + mix.wheelchairs:
            size = (1.1, 0.65, 1.3)
        speed = 0.0 if rng.random() < 0.3 else float(rng.uniform(0.6, 1.8))
        add("pedestrian", size, speed, 0.8 if rng.random() < mix.beside else 0.0)
    for _ in range(int(rng.poisson(2.6 * busy))):
        size = varied("cyclist", 0.05) if rng.random() >= mix.scooters else (1.2, 0.5, 1.75)
        speed = 0.0 if rng.random() < 0.12 else float(rng.uniform(2.0, 9.0))
        add("cyclist", size, speed, 1.2 if rng.random() < 0.15 else 0.0)
    for _ in range(int(rng.poisson(0.9 * busy))):
        kind = str(rng.choice(["car", "bus", "truck", "motorcycle"], p=[0.7, 0.1, 0.12, 0.08]))
        add(kind, varied(kind, 0.06), 0.0 if rng.random() < 0.25 else float(rng.uniform(2, 12)))
    if not agents:
        add("pedestrian", varied("pedestrian"), 1.2)
    return Scenario(f"random {seed}", "standard", "idle", "bicycle", tuple(agents))


def _spot(rng: np.random.Generator, kind: str) -> tuple[float, float]:
    """A ground position in front of the default camera, log-uniform in distance."""
    nearest = _NEAREST_M if kind == "pedestrian" else 2.5
    if kind in {"car", "bus", "truck"}:
        nearest = 6.0
    for _ in range(50):
        away = float(math.exp(rng.uniform(math.log(nearest), math.log(_FARTHEST_M))))
        bearing = float(rng.uniform(-1.45, 1.45))
        x = DEFAULT_POSE.x_m + away * math.sin(bearing)
        y = DEFAULT_POSE.y_m + away * math.cos(bearing)
        if kind in {"car", "bus", "truck"} and abs(y) > 4.6:
            continue
        if y < 9.0:
            return x, y
    return DEFAULT_POSE.x_m + 3.0, -4.0


def _heading(rng: np.random.Generator, kind: str) -> float:
    if kind in {"car", "bus", "truck"} and rng.random() < 0.8:
        return float(rng.choice([0.0, math.pi])) + float(rng.normal(0, 0.05))
    return float(rng.uniform(-math.pi, math.pi))


def random_camera(
    seed: int, size: tuple[int, int] = (960, 540), lens: str = "fisheye"
) -> SceneCamera:
    """A camera for training near the default place, of random lens, height and pitch.

    `lens`: `fisheye` (field of view 150 to 205 degrees, four projections, the circle cut off above
    and below as on the usual sensor) or `rectilinear` (55 to 100 degrees wide).
    """
    rng = np.random.default_rng((seed, 67))
    height_m = float(rng.uniform(2.6, 5.5))
    pose = CameraPose(
        DEFAULT_POSE.x_m + float(rng.uniform(-2.5, 2.5)),
        DEFAULT_POSE.y_m + float(rng.uniform(-1.5, 1.0)),
        DEFAULT_POSE.heading_deg + float(rng.uniform(-12, 12)),
    )
    if lens == "rectilinear":
        fov, pitch = float(rng.uniform(55, 100)), float(rng.uniform(-24, -6))
        return rectilinear_camera(fov, size, height_m=height_m, pitch_deg=pitch, pose=pose)
    if lens != "fisheye":
        raise GeometryError(f"lens: {lens!r} is not fisheye or rectilinear")
    fov = float(rng.uniform(150, 205))
    names = ["equidistant", "equisolid", "stereographic"] + ["orthographic"] * (fov < 178)
    circle = size[0] * float(rng.uniform(0.42, 0.52))
    name = str(rng.choice(names))
    model = Lens.from_circle(name, circle, min(fov, 176.0) if name == "orthographic" else fov)
    pitch = float(rng.uniform(-25, 4))
    return lens_camera(model, size, height_m=height_m, pitch_deg=pitch, pose=pose)


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
