"""Scenarios drawn as pictures through the very camera model, with exact labels."""

from __future__ import annotations

from bikeped.scene.camera import (
    DEFAULT_POSE,
    SceneCamera,
    lens_camera,
    rectilinear_camera,
    scene_camera,
)
from bikeped.scene.chance import Mix, random_camera, random_scenario
from bikeped.scene.clip import ClipTruth, read_sidecar, sidecar_path, write_clip
from bikeped.scene.conditions import LIGHTS, WEATHERS, Conditions, random_conditions
from bikeped.scene.dataset import pictures, write_dataset
from bikeped.scene.labels import KINDS, DrawnObject
from bikeped.scene.painter import ScenePainter

__all__ = [
    "DEFAULT_POSE",
    "KINDS",
    "LIGHTS",
    "WEATHERS",
    "ClipTruth",
    "Conditions",
    "DrawnObject",
    "Mix",
    "SceneCamera",
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
