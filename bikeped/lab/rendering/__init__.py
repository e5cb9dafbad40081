"""Renders scenarios through the camera model as pictures with exact labels."""

from __future__ import annotations

from bikeped.lab.rendering.clip import read_sidecar, sidecar_path, write_clip
from bikeped.lab.rendering.conditions import Conditions
from bikeped.lab.rendering.labels import DrawnObject
from bikeped.lab.rendering.painter import ScenePainter
from bikeped.lab.rendering.render_camera import SceneCamera, scene_camera

__all__ = [
    "Conditions",
    "DrawnObject",
    "SceneCamera",
    "ScenePainter",
    "read_sidecar",
    "scene_camera",
    "sidecar_path",
    "write_clip",
]
