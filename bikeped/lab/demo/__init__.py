"""The demonstration's material: a scripted crossing, and what to say of its replay.

The crossing is drawn by `scene` and looked at by the bundled detector: real pixels, a real model.
"""

from __future__ import annotations

from pathlib import Path

from bikeped.lab.demo.summary import format_summary, summarise

__all__ = ["bundled_scenario", "format_summary", "summarise"]


def bundled_scenario() -> Path:
    """The scenario file of the demo."""
    return Path(__file__).with_name("crossing.yaml")
