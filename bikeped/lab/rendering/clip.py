"""A scenario as a video file, and beside it a sidecar file with the exact boxes of every frame.

Clips are Motion-JPEG AVI files, byte for byte the same for the same pictures. OpenCV's writers pick
codec library, quality and metadata by build; here the JPEG files go into the file as they are, and
readers that pass JPEG undecoded get them back as they were.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import simplejpeg

from bikeped.errors import CaptureError
from bikeped.files import WholeFile, write_whole
from bikeped.lab.rendering.labels import DrawnObject
from bikeped.lab.rendering.painter import ScenePainter
from bikeped.types import ImageArray, Kind

#: AVI's 32-bit sizes end at 4 GB; some readers fail beyond 2.
_MAX_BYTES = 2_000_000_000
_KEYFRAME = 0x10
_HAS_INDEX = 0x10
FORMAT = "bikeped drawn boxes 2"


class AviWriter:
    """An MJPEG AVI at `path`; written under a temporary name, renamed at the end of the block."""

    def __init__(self, path: Path, fps: int, size: tuple[int, int]) -> None:
        """`fps`: whole frames per second; `size`: width, height."""
        self.path, self.fps, self.size = path, fps, size
        self._index: list[tuple[int, int]] = []
        self._largest = 0
        try:
            self._whole = WholeFile(path)
            self._file = self._whole.partial.open("wb")
        except OSError as error:
            raise CaptureError(
                f"{path}: cannot be written ({error.strerror}); choose another folder"
            ) from error
        self._file.write(self._header(0))
        self._movi = self._file.tell() - 4  # the index counts from the word "movi"

    def write(self, jpeg: bytes) -> None:
        """Appends one JPEG file as a frame."""
        offset = self._file.tell()
        if offset + len(jpeg) > _MAX_BYTES:
            raise CaptureError(f"{self.path}: more than 2 GB; make the clip shorter or smaller")
        self._file.write(b"00dc" + struct.pack("<I", len(jpeg)) + jpeg + b"\0" * (len(jpeg) % 2))
        self._index.append((offset - self._movi, len(jpeg)))
        self._largest = max(self._largest, len(jpeg))

    def _finish(self) -> None:
        """Writes the index and the sizes, and gives the file its name."""
        end = self._file.tell()
        entries = b"".join(
            b"00dc" + struct.pack("<III", _KEYFRAME, offset, size) for offset, size in self._index
        )
        self._file.write(b"idx1" + struct.pack("<I", len(entries)) + entries)
        total = self._file.tell()
        self._file.seek(0)
        self._file.write(self._header(end, total))
        self._file.close()
        self._whole.commit()

    def _header(self, movi_end: int, total: int = 8) -> bytes:
        width, height = self.size
        frames = len(self._index)
        main = struct.pack(
            "<10I16x",
            *(round(1e6 / self.fps), self._largest * self.fps, 0, _HAS_INDEX, frames, 0, 1),
            *(self._largest, width, height),
        )
        stream = b"vidsMJPG" + struct.pack(
            "<IHHIIIIIIII4H",
            0, 0, 0, 0, 1, self.fps, 0, frames, self._largest, 0xFFFFFFFF, 0, 0, 0, width, height,
        )  # fmt: skip
        bitmap = struct.pack(
            "<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", width * height * 3, 0, 0, 0, 0
        )
        strl = b"strl" + _chunk(b"strh", stream) + _chunk(b"strf", bitmap)
        hdrl = b"hdrl" + _chunk(b"avih", main) + _chunk(b"LIST", strl)
        head = b"AVI " + _chunk(b"LIST", hdrl)
        movi_start = 8 + len(head) + 8
        movi_size = max(movi_end - movi_start, 4)
        riff = b"RIFF" + struct.pack("<I", total - 8) + head
        return riff + b"LIST" + struct.pack("<I", movi_size) + b"movi"

    def __enter__(self) -> AviWriter:
        return self

    def __exit__(self, kind: object, *rest: object) -> None:
        if kind is None:
            self._finish()
        else:
            self._file.close()
            self._whole.discard()


def _chunk(name: bytes, data: bytes) -> bytes:
    return name + struct.pack("<I", len(data)) + data


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
