"""A scenario as a video file, and beside it a sidecar file with the exact boxes of every frame."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import simplejpeg

from bikeped.errors import CaptureError
from bikeped.files import write_whole
from bikeped.lab.rendering.avi_writer import AviWriter
from bikeped.lab.rendering.labels import DrawnObject
from bikeped.lab.rendering.painter import ScenePainter
from bikeped.types import ImageArray, Kind

FORMAT = "bikeped drawn boxes 2"


@dataclass(frozen=True)
class ClipTruth:
    """A sidecar file: its header, the time of every frame and the road users in it."""

    header: dict[str, Any]
    times_s: tuple[float, ...]
    frames: tuple[tuple[DrawnObject, ...], ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures."""
        return int(self.header["width"]), int(self.header["height"])


def sidecar_path(clip: Path) -> Path:
    """Where the boxes of a clip lie: `crossing.avi` -> `crossing.boxes.jsonl`."""
    return clip.with_suffix(".boxes.jsonl")


def frame_times(painter: ScenePainter, fps: int, seconds: float | None = None) -> list[float]:
    """Times of the frames of a clip, at most `seconds` of them."""
    times: list[float] = painter.scenario.frame_times(fps).tolist()
    return times if seconds is None else [t for t in times if t < seconds]


def write_clip(
    painter: ScenePainter,
    path: Path,
    *,
    fps: int = 30,
    quality: int = 88,
    seconds: float | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Draws the painter's scenario into `path` (.avi, Motion JPEG); returns the sidecar's path.

    Both files are whole or not there. `seconds` ends the clip early; `progress` takes the number of
    frames done. Raises CaptureError when a file cannot be written.
    """
    if path.suffix.lower() != ".avi":
        raise CaptureError(f"{path}: is not an .avi name; end the clip's name with .avi")
    if not 1 <= fps <= 240 or not 1 <= quality <= 100:
        raise CaptureError(f"fps {fps}, quality {quality}: are not 1 to 240 and 1 to 100")
    times = frame_times(painter, fps, seconds)
    if not times:
        raise CaptureError(f"seconds: {seconds} leaves no frame; give more")
    lines = [json.dumps(_header(painter, fps, len(times)))]
    with AviWriter(path, fps, painter.camera.size) as clip:
        for number, t in enumerate(times):
            image, objects = painter.draw(t)
            clip.write(encode_jpeg(image, quality))
            lines.append(json.dumps(_line(number, t, objects)))
            progress(number + 1)
        # Before the clip gets its name: no clip without its boxes.
        sidecar = sidecar_path(path)
        write_whole(sidecar, "\n".join(lines) + "\n")
    return sidecar


def encode_jpeg(image: ImageArray, quality: int) -> bytes:
    """The picture [h, w, 3] RGB as a JPEG file, colours at half resolution as cameras do."""
    jpeg: bytes = simplejpeg.encode_jpeg(
        np.ascontiguousarray(image), quality=quality, colorspace="RGB", colorsubsampling="420"
    )
    return jpeg


def read_sidecar(path: Path) -> ClipTruth:
    """Reads a sidecar file; CaptureError when it is none."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        header = json.loads(lines[0])
        if header["format"] != FORMAT:
            raise CaptureError(f"{path}: format {header['format']!r} is not {FORMAT!r}; redraw it")
        rows = [json.loads(line) for line in lines[1:]]
        times = tuple(float(row["t"]) for row in rows)
        frames = tuple(tuple(_object(item) for item in row["objects"]) for row in rows)
        count = int(header["frames"])
        _ = int(header["width"]), int(header["height"])
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise CaptureError(f"{path}: is not a file of drawn boxes; draw the clip again") from error
    if len(frames) != count:
        raise CaptureError(
            f"{path}: holds {len(frames)} frames, its header says {count}; draw the clip again"
        )
    return ClipTruth(header, times, frames)


def _header(painter: ScenePainter, fps: int, frames: int) -> dict[str, Any]:
    width, height = painter.camera.size
    pose = painter.camera.pose
    return {
        "format": FORMAT,
        "scenario": painter.scenario.name,
        "fps": fps,
        "width": width,
        "height": height,
        "frames": frames,
        "pose": {"x_m": pose.x_m, "y_m": pose.y_m, "heading_deg": pose.heading_deg},
        "conditions": asdict(painter.conditions),
    }


def _line(number: int, t: float, objects: Sequence[DrawnObject]) -> dict[str, Any]:
    rounded = []
    for item in objects:
        data = asdict(item)
        data["label"] = item.label.label
        for key in ("box_px", "full_box_px", "xy_m", "world_m"):
            data[key] = [round(v, 4) for v in data[key]]
        for key in ("visible", "heading_rad"):
            data[key] = round(data[key], 4)
        rounded.append(data)
    return {"frame": number, "t": round(t, 6), "objects": rounded}


def _object(item: dict[str, Any]) -> DrawnObject:
    return msgspec.convert({**item, "label": Kind[item["label"].upper()].value}, DrawnObject)
