"""`bikeped model train`: a detector from a data set in COCO's format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from bikeped.cli.common import console, json_option, progress_bar, write_json
from bikeped.cli.guard import check_outputs, guarded
from bikeped.errors import require
from bikeped.files import make_folder


@click.command("train")
@click.argument("data", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder for the weights, model.onnx and training.json.",
)
@click.option(
    "--images",
    "images_dir",
    type=click.Path(path_type=Path),
    help="Folder that the data's file names start from, where it is not found by itself.",
)
@click.option(
    "--network",
    type=click.Choice(["yolov9-t", "yolov9-s", "yolov9-m", "yolov9-c", "small"]),
    default="yolov9-s",
    show_default=True,
    help="A YOLO for a GPU, through the library LibreYOLO; or our own small network, for a CPU.",
)
@click.option(
    "--validation",
    type=click.Path(path_type=Path),
    help="Data set that tells the best epoch (a YOLO only). Default: a twentieth of DATA.",
)
@click.option(
    "--size",
    type=click.IntRange(64, 4096),
    default=1280,
    show_default=True,
    help="Side of the square input, pixels; the small network learns at 1280 x 736.",
)
@click.option(
    "--weights",
    type=click.Path(path_type=Path),
    help="Weights file to start from (a YOLO only). Default: none, from scratch.",
)
@click.option("--epochs", type=click.IntRange(1, 10000), default=100, show_default=True)
@click.option(
    "--steps",
    type=click.IntRange(1, 10_000_000),
    help="Of the small network, in place of --epochs.",
)
@click.option(
    "--mine",
    is_flag=True,
    help="The small network only: look at all pictures twice on the way, and learn more often from "
    "what it took for somebody.",
)
@click.option(
    "--batch",
    type=click.IntRange(1, 1024),
    default=8,
    show_default=True,
    help="Pictures for each step.",
)
@click.option(
    "--device",
    default="auto",
    show_default=True,
    help="cpu, cuda, or cuda's number; auto takes a GPU where there is one.",
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
) -> int:
    """Train a detector on DATA (COCO's format: an annotation file, or its folder) and export it."""
    from bikeped.lab.training.coco import read_coco

    require("torch")
    source = read_coco(data, images_dir)
    make_folder(out)
    names = [out / name for name in ("weights.pt", "model.onnx", "training.json")]
    given = [("DATA", source.source), *(("DATA", image.path) for image in source.images)]
    given += [("--weights", weights)] if weights is not None else []
    check_outputs(given, [("--out", name) for name in names])
    if network == "small":
        from bikeped.lab.training.hard_negative_mining import MINING_ROUNDS, MiningSettings
        from bikeped.lab.training.small import SmallTrainSettings, train_small

        _refuse(validation, "--validation")
        _refuse(weights, "--weights")
        count = steps or -(-epochs * len(source.images) // batch)
        mining = MiningSettings(after=MINING_ROUNDS if mine else ())
        order = SmallTrainSettings(count, batch, seed, device, mining=mining)
        with progress_bar("train", count) as progress:
            summary = train_small(source, out, order, progress)
    else:
        from bikeped.lab.training.yolo import YoloTrainSettings, train_yolo

        if mine:
            raise click.UsageError("--mine is for --network small; leave it out with a YOLO")
        summary = train_yolo(
            source,
            None if validation is None else read_coco(validation),
            out,
            YoloTrainSettings(network, size, epochs, batch, weights, device, workers, seed),
        )
    write_json(summary, str(out / "training.json"))
    if json_path is not None:
        write_json(summary, json_path)
    if json_path != "-":
        _print(summary, out)
    return 0


def _refuse(value: object, option: str) -> None:
    if value is not None:
        raise click.UsageError(f"{option} is for a YOLO; leave it out with --network small")


def _print(summary: dict[str, Any], out: Path) -> None:
    screen = console()
    screen.print(
        escape(
            f"{summary['network']}: {summary['pictures']} pictures with {summary['objects']} "
            f"objects of {', '.join(summary['names'])}; {summary['seconds'] / 60:.1f} min on "
            f"{summary['device']}"
        )
    )
    screen.print(
        escape(f"wrote {summary['weights']}, {summary['model']} and {out / 'training.json'}")
    )
