"""`bikeped model evaluate`: detectors over a data set by COCO's measures."""

from __future__ import annotations

from pathlib import Path

import click

from bikeped.cli.common import FiniteRange, config_options, json_option, progress_bar
from bikeped.cli.guard import check_outputs, guarded, written_paths
from bikeped.config.load import load_config
from bikeped.errors import BikepedError, require
from bikeped.lab.cli.conformance_shared import rich_table
from bikeped.lab.cli.model import PATH, data_argument, data_files, images_option, report


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
    from bikeped.lab.training.evaluation_report import draw_evaluation, evaluation_tables

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
        written += draw_evaluation(result, figure)
    shown = [part for table in evaluation_tables(result) for part in (rich_table(table), "")]
    report(result.as_dict(), json_path, [*shown, *(f"wrote {path}" for path in written)])


def _named(word: str) -> tuple[str, Path]:
    """Label and file of NAME=FILE, or of a file, which is labelled by its name."""
    path = Path(word)
    name, equals, file = word.partition("=")
    if equals and name and not path.exists():
        return name, Path(file)
    return path.stem, path
