"""A picture with four crosses on the ground, as a camera sees them that is hung otherwise than its
configuration says; and that configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from bikeped.config.build import framing, ground_camera
from bikeped.config.load import load_config

ROOT = Path(__file__).parents[2]
HEIGHT_M, PITCH_DEG = 4.21, -7.3
CROSSES_M = ((4.0, -1.5), (6.0, 2.0), (10.0, -3.0), (15.0, 4.0))
ORANGE = (255, 90, 30)
SIZE = (1920, 1080)


@dataclass(frozen=True)
class Scene:
    """`crosses_px` [4, 2]: their middles as found in the picture, not as projected."""

    config: Path
    jpeg: bytes
    crosses_px: np.ndarray
    distances_m: tuple[float, ...]
    rights_m: tuple[float, ...]


def draw_scene(folder: Path) -> Scene:
    """Writes config.yaml into `folder` and draws the picture, at half the sensor's size: a browser
    without a GPU is slow with large ones."""
    for name in ("config.yaml", "camera_calibration.json"):
        (folder / name).write_bytes((ROOT / name).read_bytes())
    loaded = load_config(folder / "config.yaml")
    frame = framing(loaded).for_frame(*SIZE)
    camera = replace(ground_camera(loaded), height_m=HEIGHT_M, pitch_deg=PITCH_DEG)
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    image[:] = np.linspace(150, 70, SIZE[1]).astype(np.uint8)[:, None, None]
    found = []
    for x, y in CROSSES_M:
        reach = 0.04 * math.hypot(x, y)
        for way in (
            (0, 1),
            (1, 0),
        ):  # along the picture's axes, so that it is even about its middle
            span = np.linspace(-reach * (2 - way[1]), reach * (2 - way[1]), 2)
            ends, _ = camera.project([(x + s * way[0], y + s * way[1]) for s in span])
            middle = frame.crop_to_frame(camera.project([(x, y)])[0])[0]
            size = np.abs(frame.crop_to_frame(ends) - middle).max()
            arm = np.array([size, 0]) if way[1] else np.array([0, size])
            line = np.stack([middle - arm, middle + arm])
            cv2.polylines(
                image, [np.round(line * 16).astype(np.int32)], False, ORANGE, 5, cv2.LINE_AA, 4
            )
        u, v = (round(float(c)) for c in middle)
        part = image[v - 60 : v + 61, u - 60 : u + 61].astype(int)
        weight = np.clip(part[..., 0] - part[..., 2], 0, None)  # orange is no grey
        rows, columns = np.mgrid[v - 60 : v + 61, u - 60 : u + 61]
        found.append(
            [(weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()]
        )
    jpeg = simplejpeg.encode_jpeg(image, quality=92, colorspace="RGB")
    return Scene(
        config=folder / "config.yaml",
        jpeg=bytes(jpeg),
        crosses_px=np.array(found),
        distances_m=tuple(round(math.hypot(x, y), 3) for x, y in CROSSES_M),
        rights_m=tuple(y for _, y in CROSSES_M),
    )
