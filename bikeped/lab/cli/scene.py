"""`bikeped scene`: a scenario as fisheye video with exact boxes, a still, or a data set."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bikeped.cli.common import FiniteRange, config_options, json_option, progress_bar
from bikeped.cli.guard import check_outputs, guarded, written_paths
from bikeped.config.load import LoadedConfig, load_config
from bikeped.errors import BikepedError, GeometryError, ScenarioError
from bikeped.files import write_whole
from bikeped.lab.cli.model import picture_size, report

if TYPE_CHECKING:
    from bikeped.lab.rendering import DrawnObject, SceneCamera, ScenePainter
    from bikeped.lab.scenarios.scenario import Scenario
    from bikeped.types import ImageArray

_LIGHTS = ("day", "overcast", "dusk", "night", "glare")
_COLOURS = ((255, 70, 60), (70, 230, 90), (70, 160, 255))


@click.command("scene")
@click.argument("scenario", required=False)
@config_options
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    help="Clip to write (.avi, Motion JPEG; boxes beside it), or the data set's folder.",
)
@click.option("--size", default="1920x1080", show_default=True, help="Picture size, in pixels.")
@click.option("--light", type=click.Choice(_LIGHTS), default="day", show_default=True)
@click.option("--weather", type=click.Choice(["dry", "rain"]), default="dry", show_default=True)
@click.option(
    "--place",
    type=click.IntRange(0, 2**31 - 1),
    default=0,
    show_default=True,
    help="Number of the street: road layout, houses and occluders.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**31 - 1),
    default=0,
    show_default=True,
    help="Seed of clothes, sun and noise; with --dataset, of everything.",
)
@click.option("--fps", type=click.IntRange(1, 240), default=30, show_default=True)
@click.option("--seconds", type=FiniteRange(min=0.001), help="Draw only the first seconds.")
@click.option("--quality", type=click.IntRange(1, 100), default=88, show_default=True)
@click.option(
    "--still",
    type=(float, click.Path(path_type=Path)),
    metavar="T FILE.png",
    help="Draw one picture at T seconds in place of a clip.",
)
@click.option("--boxes", is_flag=True, help="Draw the boxes into the still.")
@click.option(
    "--dataset",
    type=click.IntRange(1, 1_000_000),
    metavar="N",
    help="Draw N random pictures with COCO annotations into the folder --out; no SCENARIO.",
)
@click.option(
    "--lens",
    type=click.Choice(["configured", "fisheye", "rectilinear"]),
    default="configured",
    show_default=True,
    help="Cameras of a data set: the configured one, or random fisheye or rectilinear ones.",
)
@json_option
@guarded
def command(
    scenario: str | None,
    config_path: Path | None,
    overrides: tuple[str, ...],
    out: Path | None,
    size: str,
    light: str,
    weather: str,
    place: int,
    seed: int,
    fps: int,
    seconds: float | None,
    quality: int,
    still: tuple[float, Path] | None,
    boxes: bool,
    dataset: int | None,
    lens: str,
    json_path: str | None,
) -> None:
    """Render SCENARIO, a file or a bundled one's name, through the configured camera."""
    from bikeped.lab.rendering import Conditions, ScenePainter, sidecar_path

    loaded = load_config(config_path, overrides)
    size_wh = picture_size("--size", size)
    if dataset is not None:
        if scenario is not None:
            raise BikepedError(f"{scenario}: --dataset draws its own scenarios; leave it out")
        if out is None or still is not None:
            raise BikepedError("--dataset: takes --out FOLDER and no --still; name a new folder")
        summary = _dataset(loaded, out, dataset, seed, size_wh, lens)
        report(summary, json_path, [f"wrote {dataset} pictures and {summary['annotations']}"])
        return
    if scenario is None:
        raise BikepedError(
            "SCENARIO: missing; name a scenario file or a bundled one, e.g. safe-crossing"
        )
    if (out is None) == (still is None):  # one of them
        raise BikepedError("--out: give either --out CLIP.avi or --still T FILE.png")
    if still is not None and seconds is not None:
        raise BikepedError("--seconds: is for a clip; leave it out with --still")
    if still is None and boxes:
        raise BikepedError("--boxes: goes with --still; a clip's boxes lie beside it")
    found = _scenario(scenario)
    read = [("SCENARIO", Path(found.source)), *([("-c", config_path)] if config_path else [])]
    outputs = [("--json", name) for name in written_paths(json_path)]
    if out is not None:
        outputs += [("--out", out), ("the boxes beside --out", sidecar_path(out))]
    if still is not None:
        outputs.append(("--still", still[1]))
    check_outputs(read, outputs)
    conditions = Conditions(seed=seed, light=light, weather=weather, place=place)
    painter = ScenePainter(found, _camera(loaded, size_wh), conditions)
    if still is not None:
        summary = _still(painter, *still, boxes=boxes)
        line = f"wrote {still[1]}: {len(summary['objects'])} objects"
    elif out is not None:
        summary = _clip(painter, out, fps, quality, seconds)
        line = (
            f"wrote {out}: {summary['frames']} frames of {size}, {summary['duration_s']:.1f} s; "
            f"boxes in {summary['boxes']}"
        )
    head = {"scenario": found.name, "size": list(size_wh)}
    report(head | summary, json_path, _shown(summary, line))


def _clip(
    painter: ScenePainter, out: Path, fps: int, quality: int, seconds: float | None
) -> dict[str, Any]:
    from bikeped.lab.rendering import read_sidecar, write_clip
    from bikeped.lab.rendering.clip import frame_times

    with progress_bar("drawing", len(frame_times(painter, fps, seconds))) as progress:
        sidecar = write_clip(
            painter, out, fps=fps, quality=quality, seconds=seconds, progress=progress
        )
    truth = read_sidecar(sidecar)
    seen: dict[str, set[int]] = {}
    for frame in truth.frames:
        for item in frame:
            seen.setdefault(item.kind, set()).add(item.id)
    return {
        "clip": str(out),
        "boxes": str(sidecar),
        "frames": len(truth.frames),
        "duration_s": round(len(truth.frames) / fps, 3),
        "conditions": truth.header["conditions"],
        "seen": {kind: len(ids) for kind, ids in sorted(seen.items())},
    }


def _still(painter: ScenePainter, t: float, path: Path, *, boxes: bool) -> dict[str, Any]:
    import cv2
    import numpy as np

    if path.suffix.lower() not in {".png", ".jpg"}:
        raise BikepedError(f"{path}: is not a .png or .jpg name; end the still's name with .png")
    if not (math.isfinite(t) and 0 <= t <= painter.scenario.duration_s):
        raise BikepedError(
            f"--still {t}: is not in 0 to {painter.scenario.duration_s:g} s, where the scenario is"
        )
    image, objects = painter.draw(t)
    if boxes:
        _mark(image, objects)
    done, data = cv2.imencode(path.suffix.lower(), np.ascontiguousarray(image[..., ::-1]))
    if not done:
        raise BikepedError(f"{path}: the picture could not be encoded; try a .png name")
    write_whole(path, data.tobytes())
    return {
        "still": str(path),
        "t": t,
        "objects": [
            {
                "id": item.id,
                "kind": item.kind,
                "box_px": [round(v, 2) for v in item.box_px],
                "visible": round(item.visible, 3),
                "distance_m": round(item.distance_m, 2),
            }
            for item in objects
        ],
    }


def _mark(image: ImageArray, objects: list[DrawnObject]) -> None:
    import cv2

    for item in objects:
        u1, v1, u2, v2 = (round(v) for v in item.box_px)
        cv2.rectangle(image, (u1, v1), (u2, v2), _COLOURS[item.label], 1)
        text = f"{item.kind} {item.distance_m:.1f} m"
        cv2.putText(
            image, text, (u1, v1 - 3), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 90), 1, cv2.LINE_AA
        )


def _dataset(
    loaded: LoadedConfig, out: Path, count: int, seed: int, size: tuple[int, int], lens: str
) -> dict[str, Any]:
    from bikeped.lab.rendering.dataset import write_dataset

    own = lens == "configured"
    camera, drawn_lens = (_camera(loaded, size), "fisheye") if own else (None, lens)
    with progress_bar("drawing", count) as progress:
        annotations = write_dataset(
            out, count, seed, camera, size=size, lens=drawn_lens, progress=progress
        )
    return {
        "folder": str(out),
        "annotations": str(annotations),
        "pictures": count,
        "size": list(size),
        "seed": seed,
        "lens": lens,
    }


def _camera(loaded: LoadedConfig, size: tuple[int, int]) -> SceneCamera:
    """The configured camera for pictures of `size`, which must have the sensor's proportions."""
    from bikeped.lab.rendering import scene_camera

    try:
        return scene_camera(loaded, size)
    except GeometryError as error:
        sensor = loaded.config.camera
        raise BikepedError(
            f"--size {size[0]}x{size[1]}: {loaded.source}: the sensor has {sensor.width} x "
            f"{sensor.height} pixels (camera.width, camera.height); take a scaled copy of that, "
            f"e.g. {sensor.width // 2}x{sensor.height // 2}"
        ) from error


def _scenario(name: str) -> Scenario:
    """A scenario file, or a bundled scenario by its name or its file's."""
    from bikeped.lab.scenarios.scenario import bundled_folder, load_scenario, load_scenarios

    path = Path(name)
    if path.suffix in {".yaml", ".yml"} or path.exists():
        return load_scenario(path)
    slug = _slug(name)
    known = load_scenarios(bundled_folder())
    for scenario in known:
        if slug in {_slug(scenario.name), Path(scenario.source).stem}:
            return scenario
    names = ", ".join(Path(scenario.source).stem for scenario in known)
    raise ScenarioError(f"{name}: is no scenario file and no bundled scenario; use one of {names}")


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def _shown(summary: dict[str, Any], line: str) -> Iterator[str]:
    yield line
    if "seen" in summary:
        seen = ", ".join(f"{count} {kind}" for kind, count in summary["seen"].items())
        yield f"road users in it: {seen or 'none'}"
    for item in summary.get("objects", ()):
        u1, v1, u2, v2 = item["box_px"]
        yield (
            f"  {item['id']:>4} {item['kind']:<11}{item['distance_m']:6.2f} m  "
            f"box {u1:.0f} {v1:.0f} {u2:.0f} {v2:.0f}  visible {item['visible']:.0%}"
        )
