"""The demonstration's material: a scripted crossing drawn as fisheye video, and its boxes.

No detector model is bundled, so the demo's detections are the boxes of what was drawn; every
type and text here says so.
"""

from __future__ import annotations

from pathlib import Path

from bikeped.demo.clip import DEMO_POSE, read_sidecar, sidecar_path, write_clip
from bikeped.demo.detector import DrawnBoxDetector
from bikeped.demo.scene import DrawnObject, Scene
from bikeped.demo.summary import format_summary, summarise

__all__ = [
    "DEMO_POSE",
    "DrawnBoxDetector",
    "DrawnObject",
    "Scene",
    "bundled_scenario",
    "format_summary",
    "read_sidecar",
    "sidecar_path",
    "summarise",
    "write_clip",
]


def bundled_scenario() -> Path:
    """The scenario file of the demo."""
    return Path(__file__).with_name("crossing.yaml")
