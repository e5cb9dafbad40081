"""Results of the end-to-end simulation as data, tables and a figure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from bikeped.lab.endtoend.ablation import AblationStep
from bikeped.lab.endtoend.measures import (
    MIN_IOU,
    MIN_VISIBLE,
    Observations,
    localisation_rows,
    recall_rows,
)
from bikeped.lab.endtoend.run import EndToEndRun
from bikeped.lab.experiments.deterministic import METRIC_COLUMNS
from bikeped.lab.plotting import GREY, SERIES, FigureSheet, plot_series, to_floats, to_percents
from bikeped.lab.result_tables import ExperimentResult, ResultTable
from bikeped.lab.simulation.metrics import finite_or_none
from bikeped.lab.simulation.perception import error_table
from bikeped.lab.simulation.suite import Suite
from bikeped.types import Kind

#: Sensitivity and specificity from pixels may lie this far from the scripted run's, in share.
GOAL = 0.03


def end_to_end_result(
    suite: Suite,
    runs: Sequence[EndToEndRun],
    steps: Sequence[AblationStep],
    seen: Observations,
    drawing: Mapping[str, Any],
) -> ExperimentResult:
    """All results: `data` for JSON, and the tables for people; `drawing`: how it was rendered."""
    scripted, whole = steps[0].metrics, steps[-1].metrics
    data: dict[str, Any] = {
        "drawing": dict(drawing),
        "detector": runs[0].detector,
        "model_hash": runs[0].model_hash,
        "frames": seen.frames,
        "goal": {
            "within": GOAL,
            "sensitivity_change": finite_or_none(whole.sensitivity - scripted.sensitivity),
            "specificity_change": finite_or_none(whole.specificity - scripted.specificity),
            "holds": within_goal(steps),
        },
        "stages": [_stage(steps, i) for i in range(len(steps))],
        "by_scenario": {
            name: {"scripted": scripted.scenario_dict(i), "pixels": whole.scenario_dict(i)}
            for i, name in enumerate(suite.names)
        },
        "detection": {
            "min_iou": MIN_IOU,
            "min_visible": MIN_VISIBLE,
            "by_distance": recall_rows(seen),
            "false_per_100_frames": {
                kind.label: 100 * count / max(seen.frames, 1) for kind, count in seen.false.items()
            },
        },
        "localisation": localisation_rows(seen),
        "paper_localisation": error_table(suite.camera),
    }
    return ExperimentResult("pixels", data, _tables(data))


def within_goal(steps: Sequence[AblationStep]) -> bool:
    """Whether sensitivity and specificity from pixels are within the goal of the scripted run's."""
    first, last = steps[0].metrics, steps[-1].metrics
    pairs = ((first.sensitivity, last.sensitivity), (first.specificity, last.specificity))
    # Without actionable frames (or without safe ones) there is nothing to compare.
    return all(math.isnan(a) or abs(a - b) <= GOAL for a, b in pairs)


def verdict(steps: Sequence[AblationStep]) -> str:
    """One or two sentences: the difference to the scripted run, and where most of it is lost."""
    parts = []
    for name in ("sensitivity", "specificity"):
        values = [float(getattr(step.metrics, name)) for step in steps]
        if math.isnan(values[0]):
            parts.append(f"no frame counts for {name}")
            continue
        text = f"{name} {100 * (values[-1] - values[0]):+.1f} points against the scripted run"
        changes = [after - before for before, after in pairwise(values)]
        worst, stage = min(zip(changes, (step.name for step in steps[1:]), strict=True))
        if worst < -0.001:
            text += f" (most is lost at {stage}: {100 * worst:+.1f})"
        parts.append(text)
    held = "within" if within_goal(steps) else "not within"
    return f"{'; '.join(parts)}: {held} {100 * GOAL:.0f} points."


def _stage(steps: Sequence[AblationStep], index: int) -> dict[str, Any]:
    """One step's metrics, and their change against the step before."""
    now = steps[index].metrics.as_dict()
    before = steps[index - 1].metrics.as_dict() if index else {}
    keys = ("sensitivity", "specificity", "mean_warning_budget_s", "sev_fn", "fatigue")
    change = {
        key: None if before[key] is None or now[key] is None else now[key] - before[key]
        for key in keys
        if before
    }
    return {"name": steps[index].name, "adds": steps[index].adds, **now, "change": change}


def _tables(data: dict[str, Any]) -> tuple[ResultTable, ...]:
    false = data["detection"]["false_per_100_frames"]
    note = ", ".join(f"{kind.label} {false[kind.label]:.2f}" for kind in Kind)
    metrics = dict(list(METRIC_COLUMNS.items())[:5])
    ring = {"kind": "kind", "distance, m": "ring"}
    return (
        ResultTable.of(
            "stages",
            "From the scripted run to pixels, stage by stage",
            data["stages"],
            {"stage": "name", **metrics, "what it adds": "adds"},
        ),
        ResultTable.of(
            "scenarios",
            "Scripted and from pixels, by scenario",
            [{"name": name, **row} for name, row in data["by_scenario"].items()],
            {
                "scenario": "name",
                "sens, %": "scripted.sensitivity",
                "pixels, %": "pixels.sensitivity",
                "spec, %": "scripted.specificity",
                "pixels %": "pixels.specificity",
                "budget, s": "scripted.mean_warning_budget_s",
                "pixels, s": "pixels.mean_warning_budget_s",
            },
        ),
        ResultTable.of(
            "recall",
            "Found by the detector, by distance",
            _with_rings(r for r in data["detection"]["by_distance"] if r["seen"]),
            {**ring, "seen": "seen", "found, %": "found", "as itself, %": "recall"},
            f"false detections per 100 frames: {note}",
        ),
        ResultTable.of(
            "localisation",
            "Localisation error by distance, metres",
            _with_rings(r for r in data["localisation"] if r["found"]),
            {
                **ring,
                "found": "found",
                "mean": "mean_m",
                "90th": "p90_m",
                "exact box": "exact_box_mean_m",
                "box model": "box_model_mean_m",
            },
            "box model: the simulation's (the paper's table), over the same objects",
        ),
    )


def _with_rings(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with the bounds of their distance ring as text, and metres rounded to millimetres."""
    return [
        {
            **{
                k: round(v, 3) if isinstance(v, float) and k.endswith("_m") else v for k, v in items
            },
            "ring": ring,
        }
        for items, ring in ((r.items(), f"{r['from_m']:g}-{r['to_m']:g}") for r in rows)
    ]


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
