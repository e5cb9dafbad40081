"""A scenario as a video file, and beside it a file with the boxes of what was drawn."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import simplejpeg

from bikeped.conformance.scenario import Scenario
from bikeped.scene.avi import AviWriter
from bikeped.demo.scene import DrawnObject, Scene
from bikeped.errors import CaptureError
from bikeped.geometry import CameraPose, Framing, GroundCamera

#: Where the paper's simulation camera stands: south of the crossing, looking north.
DEMO_POSE = CameraPose(5.0, -13.0, 90.0)
FORMAT = "bikeped drawn boxes 1"


def sidecar_path(clip: Path) -> Path:
    """Where the boxes of a clip lie: `crossing.avi` -> `crossing.boxes.jsonl`."""
    return clip.with_suffix(".boxes.jsonl")


def write_clip(
    scenario: Scenario,
    path: Path,
    camera: GroundCamera,
    framing: Framing,
    *,
    pose: CameraPose = DEMO_POSE,
    size: tuple[int, int] = (1920, 1080),
    fps: int = 30,
    quality: int = 85,
    seconds: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Draws `scenario` into `path` (.avi, Motion JPEG) and its boxes beside it; returns their file.

    The same arguments give the same bytes. `seconds` ends the clip early. `progress` is called with
    frames done and in all.
    """
    if path.suffix.lower() != ".avi":
        raise CaptureError(f"{path}: is not an .avi name; end the clip's name with .avi")
    scene = Scene(scenario, camera, framing, pose, size)
    times = scenario.frame_times(fps).tolist()
    if seconds is not None:
        times = [t for t in times if t < seconds]
    header = {
        "format": FORMAT,
        "scenario": scenario.name,
        "fps": fps,
        "width": size[0],
        "height": size[1],
        "frames": len(times),
    }
    lines = [json.dumps(header)]
    with AviWriter(path, fps, size) as clip:
        for number, t in enumerate(times):
            jpeg: bytes = simplejpeg.encode_jpeg(
                scene.frame(t), quality=quality, colorspace="RGB", colorsubsampling="420"
            )
            clip.write(jpeg)
            lines.append(json.dumps(_line(number, t, scene.objects(t))))
            if progress is not None:
                progress(number + 1, len(times))
    sidecar = sidecar_path(path)
    partial = sidecar.with_name(f".{sidecar.name}.partial")
    try:
        partial.write_text("\n".join(lines) + "\n", encoding="utf-8")
        partial.replace(sidecar)
    except OSError as error:
        raise CaptureError(
            f"{sidecar}: cannot be written ({error.strerror}); check the free disk space"
        ) from error
    return sidecar


def _line(number: int, t: float, objects: list[DrawnObject]) -> dict[str, Any]:
    rounded = []
    for item in objects:
        data = asdict(item)
        for key in ("box_px", "xy_m", "world_m"):
            data[key] = [round(v, 4) for v in data[key]]
        rounded.append(data)
    return {"frame": number, "t": round(t, 6), "objects": rounded}


def read_sidecar(path: Path) -> tuple[dict[str, Any], list[list[DrawnObject]]]:
    """Header and the objects of every frame; CaptureError when the file is not a sidecar."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        header = json.loads(lines[0])
        if header["format"] != FORMAT:
            raise CaptureError(f"{path}: format {header['format']!r} is not {FORMAT!r}; redraw it")
        frames = [[_object(item) for item in json.loads(line)["objects"]] for line in lines[1:]]
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise CaptureError(f"{path}: is not a file of drawn boxes; draw the clip again") from error
    if len(frames) != header.get("frames"):
        raise CaptureError(
            f"{path}: holds {len(frames)} frames, its header says {header.get('frames')}; draw the "
            "clip again"
        )
    return header, frames


def _object(item: dict[str, Any]) -> DrawnObject:
    u1, v1, u2, v2 = (float(v) for v in item["box_px"])
    x, y = (float(v) for v in item["xy_m"])
    east, north = (float(v) for v in item["world_m"])
    return DrawnObject(int(item["id"]), str(item["kind"]), (u1, v1, u2, v2), (x, y), (east, north))
