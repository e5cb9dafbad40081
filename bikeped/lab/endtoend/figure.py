"""The figure of the end-to-end simulation: stages, recall and localisation error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bikeped.lab.plotting import GREY, SERIES, FigureSheet, plot_series, to_floats, to_percents
from bikeped.types import Kind


def draw_pixels(data: Mapping[str, Any], folder: Path) -> list[Path]:
    """pixels.png and pixels.pdf in `folder` from the JSON of `conformance pixels`."""
    drawing = data["drawing"]
    caption = (
        "Left: each stage hands the deployed tracker and decision a little more of what the "
        "pixels do; the last is the whole loop. Middle and right: what the detector found, by "
        "distance from the camera; thin lines on the right are the simulation's box model over "
        f"the same objects. Drawn at {drawing['width']} x {drawing['height']}, "
        f"{drawing['light']}, {drawing['weather']}; {data['frames']} frames; {data['detector']}."
    )
    title = "From the scripted run to pixels"
    with FigureSheet(
        title, caption, 10.0, 3.4, columns=3, legend_rows=0, width_ratios=(1.3, 1, 1)
    ) as s:
        stages, recall, places = s.axes
        rows = data["stages"]
        names = [row["name"] for row in rows]
        at = range(len(rows))
        for key, style in zip(("sensitivity", "specificity"), SERIES, strict=False):
            plot_series(stages, at, to_percents(row[key] for row in rows), style, label=key)
        stages.set_xticks(list(at), names, rotation=35, ha="right")
        stages.set(ylabel="%", title="Sensitivity and specificity")
        stages.legend(loc="lower left")
        for kind, style in zip(Kind, SERIES, strict=False):
            of_kind = [r for r in data["detection"]["by_distance"] if r["kind"] == kind.label]
            cells = [r for r in of_kind if r["seen"]]
            values = to_percents(r["recall"] for r in cells)
            plot_series(recall, _middles(cells), values, style, label=kind.label)
            cells = [r for r in data["localisation"] if r["kind"] == kind.label and r["found"]]
            values = to_floats(r["mean_m"] for r in cells)
            plot_series(places, _middles(cells), values, style, label=kind.label)
            model = to_floats(r["box_model_mean_m"] for r in cells)
            places.plot(_middles(cells), model, color=style[0], linewidth=0.7)
        recall.axhline(95, color=GREY, linewidth=0.7)
        recall.set(xlabel="distance, m", ylabel="%", ylim=(0, 102), title="Recall")
        recall.legend(loc="lower left")
        places.set(xlabel="distance, m", ylabel="m", title="Mean localisation error")
        places.set_ylim(bottom=0)
        return s.save(folder, "pixels")


def _middles(rows: list[Mapping[str, Any]]) -> list[float]:
    return [(float(r["from_m"]) + float(r["to_m"])) / 2 for r in rows]
