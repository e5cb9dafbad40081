"""An evaluation as tables, and drawn: precision and recall side by side, recall against area."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bikeped.lab.plotting import SERIES, FigureSheet, escape_dollars, to_floats
from bikeped.lab.result_tables import CellValue, ResultTable
from bikeped.lab.training.evaluate import KIND_NAMES, Evaluation, ModelScores
from bikeped.lab.training.measures import ClassMeasures

_TICKS = (4, 8, 16, 32, 64, 96, 128, 256, 512, 1024)  # sides of squares on the axis of areas


def evaluation_rows(score: ModelScores) -> list[tuple[str, ClassMeasures]]:
    """The rows of the table that people read: all classes, then the three kinds, both ways."""
    rows = []
    if score.classes is not None:
        known = sum(row.objects > 0 for row in score.classes.rows)
        rows.append((f"all classes ({known})", score.classes.overall))
    rows += [(f"{row.name}, merged", row) for row in score.merged.rows]
    rows += [(f"{row.name}, as deployed", row) for row in score.road_users.rows]
    return rows


def evaluation_tables(result: Evaluation) -> list[ResultTable]:
    """The paper's detection table, by size, and by class where there is more than one."""
    rows = [evaluation_rows(score) for score in result.scores]
    data = result.data
    unknown = data["categories_not_known_to_every_model"]
    note = f"{data['images']} pictures, {data['objects']} objects"
    if unknown:
        some = ", ".join(unknown[:6]) + (", ..." if len(unknown) > 6 else "")
        note += f"; classes left out, as not every model has them: {some}"
    main = ResultTable("detection", "detection", *_compared(result, rows), note)
    sizes = ResultTable(
        "by_size",
        "recall by area at the network's input: small < 32^2, medium < 96^2, large",
        ("", *(f"{s.label} {n}" for s in result.scores for n in ("small", "medium", "large"))),
        [
            (name, *(_three(v) for score in rows for v in score[index][1].ar_by_size))
            for index, (name, _) in enumerate(rows[0])
        ],
    )
    found = [main, sizes, _false_positives(result)]
    if any(row for score in result.scores for row in score.by_distance.values()):
        found.append(_distances(result))
    if all(score.classes is not None for score in result.scores):
        by_class = [
            [(row.name, row) for row in score.classes.rows if row.objects]
            for score in result.scores
            if score.classes is not None
        ]
        if len(by_class[0]) > 1:
            found.append(ResultTable("classes", "by class", *_compared(result, by_class)))
    return found


def _false_positives(result: Evaluation) -> ResultTable:
    pictures = result.data["images"]
    return ResultTable(
        "false",
        "as deployed: false boxes per 100 pictures (IoU below 0.50 with anything)",
        ("", *KIND_NAMES),
        [
            (score.label, *(round(100 * count / pictures, 2) for count in score.road_users.false))
            for score in result.scores
        ],
    )


def _distances(result: Evaluation) -> ResultTable:
    """Recall against distance, where the data record it."""
    first = result.scores[0].by_distance
    lines: list[tuple[CellValue, ...]] = []
    for kind, rows in first.items():
        for index, row in enumerate(rows):
            end = "" if row["to_m"] is None else f"{row['to_m']:g}"
            own = [_three(s.by_distance[kind][index]["recall50"]) for s in result.scores]
            lines.append((kind, f"{row['from_m']:g} to {end}".strip(), row["objects"], *own))
    return ResultTable(
        "distance",
        "as deployed: recall at IoU 0.50 by distance",
        ("", "distance, m", "objects", *(score.label for score in result.scores)),
        lines,
    )


def _compared(
    result: Evaluation, rows: list[list[tuple[str, ClassMeasures]]]
) -> tuple[tuple[str, ...], list[tuple[CellValue, ...]]]:
    """Columns and rows: AP, AP50 and recall of each model, and AP against the first model's."""
    columns = ["", "objects"]
    for number, score in enumerate(result.scores):
        columns += [f"{score.label} AP", "AP50", "recall"] + (["AP ratio"] if number else [])
    lines: list[tuple[CellValue, ...]] = []
    for index, (name, first) in enumerate(rows[0]):
        line: list[CellValue] = [name, first.objects]
        for number, own in enumerate(rows):
            row = own[index][1]
            line += [_three(row.ap), _three(row.ap50), _three(row.ar)]
            if number:
                both = row.ap is not None and first.ap
                line.append(round(row.ap / first.ap, 2) if both else None)  # type: ignore[operator]
        lines.append(tuple(line))
    return tuple(columns), lines


def _three(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def draw_evaluation(evaluation: Evaluation, path: Path) -> list[Path]:
    """Draws PNG and PDF beside one another; `path` names the PNG. Gives what was written.

    Raises BikepedError without matplotlib, or where a file cannot be written.
    """
    data = evaluation.data
    labels = ", ".join(score.label for score in evaluation.scores)
    least = evaluation.settings["deployed_confidence"]
    caption = (
        f"{data['images']} pictures, {data['objects']} objects. AP: average precision over IoU "
        "0.50 to 0.95. Recall: its mean over the same, at most 100 boxes a picture. Merged: "
        "bicycle and motorcycle are cyclists, riders pedestrians. As deployed: a rider and the "
        f"cycle are one cyclist; detections of at least {least:g}. Right: what is deployed, all "
        "road users together; full: the mean over IoU 0.50 to 0.95, dotted: at 0.50; areas at a "
        "network input of 1280; below each bin the number of its objects."
    )
    count = len(evaluation.scores)
    with FigureSheet(
        f"Detection: {labels}",
        caption,
        width=9.6,
        height=3.4 + 0.25 * count,
        columns=3,
        legend_rows=1 + (count - 1) // 4,
        width_ratios=[1, 1, 1.35],
    ) as sheet:
        _bars(sheet, evaluation, 0, "AP")
        _bars(sheet, evaluation, 1, "Recall")
        _curves(sheet, evaluation.scores, 2)
        sheet.axes[1].tick_params(labelleft=False)
        handles, _ = sheet.axes[0].get_legend_handles_labels()
        sheet.legend(handles)
        return sheet.save(path.parent, path.stem)


def _bars(sheet: FigureSheet, evaluation: Evaluation, panel: int, what: str) -> None:
    axes = sheet.axes[panel]
    count = len(evaluation.scores)
    thick = 0.8 / count
    names = [name for name, _ in evaluation_rows(evaluation.scores[0])]
    place = np.arange(len(names), dtype=np.float64)
    for number, score in enumerate(evaluation.scores):
        rows = [row for _, row in evaluation_rows(score)]
        values = to_floats([row.ap if what == "AP" else row.ar for row in rows])
        colour = SERIES[number % len(SERIES)][0]
        at = place + (number - (count - 1) / 2) * thick
        axes.barh(
            at, np.nan_to_num(values), thick * 0.9, color=colour, label=escape_dollars(score.label)
        )
        for y, value in zip(at, values, strict=True):
            text = "-" if np.isnan(value) else f"{value:.2f}"
            axes.text(np.nan_to_num(value) + 0.02, y, text, va="center", fontsize=7)
    axes.set_yticks(place, [escape_dollars(name) for name in names])
    axes.invert_yaxis()
    axes.set_xlim(0, 1.19)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1])
    axes.set_title(what)
    axes.grid(False, axis="y")


def _curves(sheet: FigureSheet, scores: Sequence[ModelScores], panel: int) -> None:
    axes = sheet.axes[panel]
    for number, score in enumerate(scores):
        colour, marker, _ = SERIES[number % len(SERIES)]
        curve = score.curve
        if not curve.area_px2:
            continue
        axes.plot(curve.area_px2, curve.recall, color=colour, marker=marker)
        axes.plot(curve.area_px2, curve.recall50, color=colour, marker=marker, ls=":", mfc="white")
    first = scores[0].curve
    for area, objects in zip(first.area_px2, first.objects, strict=True):
        axes.annotate(
            str(objects), (area, -0.02), fontsize=6.5, ha="center", va="top", annotation_clip=False
        )
    if first.area_px2:
        axes.set_xscale("log")
        axes.set_xlim(first.area_px2[0] / 1.6, first.area_px2[-1] * 1.6)
        sides = [s for s in _TICKS if first.area_px2[0] / 1.6 < s**2 < first.area_px2[-1] * 1.6]
        axes.set_xticks([side**2 for side in sides], [f"{side}\u00b2" for side in sides])
        axes.minorticks_off()
    axes.set_ylim(-0.1, 1.02)
    axes.set_yticks([0, 0.25, 0.5, 0.75, 1])
    axes.set_title("Recall against area")
    axes.set_xlabel("box area, square pixels")
