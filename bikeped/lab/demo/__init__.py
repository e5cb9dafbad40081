"""The demonstration: a scripted crossing, and the summary of its replay.

`lab/rendering` draws the crossing, and the bundled detector detects in the drawn pictures.
"""

from __future__ import annotations

from pathlib import Path

from bikeped.lab.demo.summary import format_summary, summarise

__all__ = ["bundled_scenario", "format_summary", "summarise"]


def bundled_scenario() -> Path:
    """The scenario file of the demo."""
    return Path(__file__).with_name("crossing.yaml")
