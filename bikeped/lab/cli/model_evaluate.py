"""`bikeped model evaluate`: detectors over a data set by COCO's measures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from bikeped.cli.common import FiniteRange, config_options, json_option, progress_bar
from bikeped.cli.guard import check_outputs, guarded, written_paths
from bikeped.config import load_config
from bikeped.errors import BikepedError, require
from bikeped.lab.cli.conformance_shared import rich_table
from bikeped.lab.cli.model import PATH, data_argument, data_files, images_option, report

if TYPE_CHECKING:
    from bikeped.lab.result_tables import CellValue, ResultTable
    from bikeped.lab.training.evaluate import Evaluation
    from bikeped.lab.training.measures import ClassMeasures


@click.command("evaluate")
@click.argument("models", nargs=-1, required=True, metavar="MODEL...")
@data_argument
@config_options
@images_option
@click.option(
    "--confidence",
    type=FiniteRange(0.0001, 1),
    default=0.001,
    show_default=True,
    help="Confidence threshold for classes and merged kinds; deployed ones use detection's.",
)
@click.option(
    "--iou",
    type=FiniteRange(0.01, 1),
    default=0.65,
    show_default=True,
    help="IoU threshold of non-maximum suppression, for classes and merged kinds.",
)
@click.option(
    "--curve",
    "curve_out",
    type=PATH,
    metavar="FILE",
    help="Write the last MODEL's recall against area, as `conformance --recall-curve` reads it.",
)
@click.option(
    "--curve-iou",
    type=click.Choice(["coco", "0.5"]),
    default="coco",
    show_default=True,
    help="Recall as the mean over IoU 0.50 to 0.95 (the paper's), or at IoU 0.50.",
)
@click.option(
    "--least-objects",
    type=click.IntRange(1),
    default=20,
    show_default=True,
    help="Merge a bin of the curve with fewer objects into the next.",
)
@click.option(
    "--figure", type=PATH, metavar="FILE.png", help="Draw the results as PNG, and as PDF beside it."
)
@json_option
@guarded
def command(
    models: tuple[str, ...],
    data: Path,
    config_path: Path | None,
    overrides: tuple[str, ...],
    images_dir: Path | None,
    confidence: float,
    iou: float,
    curve_out: Path | None,
    curve_iou: str,
    least_objects: int,
    figure: Path | None,
    json_path: str | None,
) -> None:
    """Measure each MODEL (FILE or NAME=FILE) over DATA in COCO's format.

    With several models each is compared with the first, e.g. the original with the retrained one.
    """
    from bikeped.lab.training.coco import read_coco
    from bikeped.lab.training.evaluate import EvaluationSettings, evaluate, load_models, write_curve

    if figure is not None:
        require("matplotlib")
        if figure.suffix != ".png":
            raise BikepedError(f"--figure {figure}: is no .png; name one, a PDF comes beside it")
    source = read_coco(data, images_dir)
    named = [_named(word) for word in models]
    outputs = [("--curve", path) for path in written_paths(curve_out)]
    outputs += [("--json", path) for path in written_paths(json_path)]
    if figure is not None:
        outputs += [("--figure", figure), ("--figure", figure.with_suffix(".pdf"))]
    check_outputs([*data_files(source), *(("MODEL", path) for _, path in named)], outputs)
    detection = load_config(config_path, overrides).config.detection
    loaded = load_models(named, detection)
    settings = EvaluationSettings(confidence, iou, least_objects)
    with progress_bar("evaluate", len(source.images)) as progress:
        result = evaluate(source, loaded, detection, settings, progress)
    written: list[Path] = []
    if curve_out is not None:
        write_curve(curve_out, result.scores[-1].curve, curve_iou == "0.5")
        written.append(curve_out)
    if figure is not None:
        from bikeped.lab.training.evaluation_figures import draw_evaluation

        written += draw_evaluation(result, figure)
    shown = [part for table in tables(result) for part in (rich_table(table), "")]
    report(result.as_dict(), json_path, [*shown, *(f"wrote {path}" for path in written)])


def tables(result: Evaluation) -> list[ResultTable]:
    """The paper's detection table, by size, and by class where there is more than one."""
    from bikeped.lab.result_tables import ResultTable
    from bikeped.lab.training.evaluation_figures import evaluation_rows

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
    found = [main, sizes, _alarms(result)]
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


def _alarms(result: Evaluation) -> ResultTable:
    """False positives as deployed."""
    from bikeped.lab.result_tables import ResultTable
    from bikeped.lab.training.evaluate import KIND_NAMES

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
    from bikeped.lab.result_tables import ResultTable

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


def _named(word: str) -> tuple[str, Path]:
    """Label and file of NAME=FILE, or of a file, which is labelled by its name."""
    path = Path(word)
    name, equals, file = word.partition("=")
    if equals and name and not path.exists():
        return name, Path(file)
    return path.stem, path
