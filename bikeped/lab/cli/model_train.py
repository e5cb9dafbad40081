"""`bikeped model train`: a detector from a data set in COCO's format."""

from __future__ import annotations

from pathlib import Path

import click

from bikeped.cli.common import json_option, progress_bar, write_json
from bikeped.cli.guard import check_outputs, guarded
from bikeped.errors import require
from bikeped.files import make_folder
from bikeped.lab.cli.model import PATH, data_argument, data_files, images_option, report


@click.command("train")
@data_argument
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder for the weights, model.onnx and training.json.",
)
@images_option
@click.option(
    "--network",
    type=click.Choice(["yolov9-t", "yolov9-s", "yolov9-m", "yolov9-c", "small"]),
    default="yolov9-s",
    show_default=True,
    help="A YOLO (library LibreYOLO) for a GPU, or bikeped's small network for a CPU.",
)
@click.option(
    "--validation",
    type=PATH,
    help="Data set to choose the best epoch by (a YOLO only). Default: a twentieth of DATA.",
)
@click.option(
    "--size",
    type=click.IntRange(64, 4096),
    default=1280,
    show_default=True,
    help="Side of a YOLO's square input, pixels; the small network trains at 1280 x 736.",
)
@click.option(
    "--weights",
    type=PATH,
    help="Weight file to start from (a YOLO only). Default: train from scratch.",
)
@click.option("--epochs", type=click.IntRange(1, 10000), default=100, show_default=True)
@click.option(
    "--steps",
    type=click.IntRange(1, 10_000_000),
    help="Training steps of the small network, in place of --epochs.",
)
@click.option(
    "--mine",
    is_flag=True,
    help="Hard-negative mining: twice during training, find false positives in DATA and train on "
    "crops around them (the small network only).",
)
@click.option(
    "--batch", type=click.IntRange(1, 1024), default=8, show_default=True, help="Pictures per step."
)
@click.option(
    "--device",
    default="auto",
    show_default=True,
    help="cpu, cuda, or a GPU's number; auto takes a GPU where there is one.",
)
@click.option("--workers", type=click.IntRange(0, 256), default=4, show_default=True)
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True)
@json_option
@guarded
def command(
    data: Path,
    out: Path,
    images_dir: Path | None,
    network: str,
    validation: Path | None,
    size: int,
    weights: Path | None,
    epochs: int,
    steps: int | None,
    mine: bool,
    batch: int,
    device: str,
    workers: int,
    seed: int,
    json_path: str | None,
) -> None:
    """Train a detector on DATA and export it to ONNX.

    DATA is an annotation file in COCO's format, or its folder.
    """
    from bikeped.lab.training.coco import read_coco

    small = network == "small"
    for value, option, fits in (
        (validation, "--validation", not small),
        (weights, "--weights", not small),
        (mine or None, "--mine", small),
    ):
        if value is not None and not fits:
            this, other = ("--network small", "a YOLO") if small else ("a YOLO", "--network small")
            raise click.UsageError(f"{option} is for {other}; leave it out with {this}")
    require("torch")
    source = read_coco(data, images_dir)
    make_folder(out)
    names = [out / name for name in ("weights.pt", "model.onnx", "training.json")]
    given = data_files(source) + ([("--weights", weights)] if weights is not None else [])
    check_outputs(given, [("--out", name) for name in names])
    if small:
        from bikeped.lab.training.hard_negative_mining import MINING_ROUNDS, MiningSettings
        from bikeped.lab.training.small import SmallTrainSettings, train_small

        count = steps or -(-epochs * len(source.images) // batch)
        mining = MiningSettings(after=MINING_ROUNDS if mine else ())
        settings = SmallTrainSettings(count, batch, seed, device, mining=mining)
        with progress_bar("train", count) as progress:
            summary = train_small(source, out, settings, progress)
    else:
        from bikeped.lab.training.yolo import YoloTrainSettings, train_yolo

        order = YoloTrainSettings(network, size, epochs, batch, weights, device, workers, seed)
        held_out = None if validation is None else read_coco(validation)
        summary = train_yolo(source, held_out, out, order)
    write_json(summary, str(out / "training.json"))
    counts = f"{summary['pictures']} pictures with {summary['objects']} objects"
    time = f"{summary['seconds'] / 60:.1f} min on {summary['device']}"
    lines = (
        f"{network}: {counts} of {', '.join(summary['names'])}; {time}",
        f"wrote {summary['weights']}, {summary['model']} and {out / 'training.json'}",
    )
    report(summary, json_path, lines)
