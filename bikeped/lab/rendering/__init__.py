"""Scenarios drawn as pictures through the very camera model, with exact labels."""

from __future__ import annotations

from bikeped.lab.rendering.clip import ClipTruth, read_sidecar, sidecar_path, write_clip
from bikeped.lab.rendering.conditions import LIGHTS, WEATHERS, Conditions, random_conditions
from bikeped.lab.rendering.dataset import pictures, write_dataset
from bikeped.lab.rendering.labels import KINDS, DrawnObject
from bikeped.lab.rendering.painter import ScenePainter
from bikeped.lab.rendering.random_scene import SceneMix, random_camera, random_scenario
from bikeped.lab.rendering.render_camera import (
    DEFAULT_POSE,
    SceneCamera,
    lens_camera,
    rectilinear_camera,
    scene_camera,
)

__all__ = [
    "DEFAULT_POSE",
    "KINDS",
    "LIGHTS",
    "WEATHERS",
    "ClipTruth",
    "Conditions",
    "DrawnObject",
    "SceneCamera",
    "SceneMix",
    "ScenePainter",
    "lens_camera",
    "pictures",
    "random_camera",
    "random_conditions",
    "random_scenario",
    "read_sidecar",
    "rectilinear_camera",
    "scene_camera",
    "sidecar_path",
    "write_clip",
    "write_dataset",
]
