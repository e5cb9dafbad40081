"""`bikeped model`: data, training, export and evaluation of detectors; what its commands share."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from bikeped.cli.common import LazyGroup, console, width_height, write_json
from bikeped.errors import BikepedError

if TYPE_CHECKING:
    from rich.table import Table

    from bikeped.lab.training.coco import CocoData

COMMANDS = {
    "augment": (
        "bikeped.lab.cli.model_augment",
        "Warp ordinary pictures with boxes into the fisheye view.",
    ),
    "train": ("bikeped.lab.cli.model_train", "Train a detector and export it to ONNX."),
    "export": (
        "bikeped.lab.cli.model_export",
        "Export weights to ONNX, or build a TensorRT engine.",
    ),
    "evaluate": (
        "bikeped.lab.cli.model_evaluate",
        "Measure precision and recall of detectors, and compare them.",
    ),
}


@click.group("model", cls=LazyGroup, lazy=COMMANDS)
def command() -> None:
    """Augment data, train, export and evaluate detectors."""


PATH = click.Path(path_type=Path)
data_argument = click.argument("data", type=PATH)
images_option = click.option(
    "--images",
    "images_dir",
    type=PATH,
    help="Folder of the pictures, where it cannot be found from DATA.",
)


def data_files(source: CocoData) -> list[tuple[str, Path]]:
    """The files of a data set, for `cli.guard.check_outputs`."""
    return [("DATA", source.source), *(("DATA", image.path) for image in source.images)]


def picture_size(option: str, text: str, multiple: int = 1) -> tuple[int, int]:
    """Width and height of a text like 1920x1080; BikepedError where it is none."""
    size = width_height(text)
    if size is None or any(side % multiple or side == 0 for side in size):
        of = f" in multiples of {multiple}, e.g. 1280x416" if multiple > 1 else ", e.g. 1920x1080"
        raise BikepedError(f"{option} {text}: is not WIDTHxHEIGHT{of}")
    return size


def report(summary: dict[str, Any], json_path: str | None, shown: Iterable[str | Table]) -> None:
    """Writes the summary as JSON where asked for, and lines and tables unless JSON goes to standard
    output."""
    if json_path is not None:
        write_json(summary, json_path)
    if json_path != "-":
        from rich.markup import escape

        screen = console()
        for part in shown:
            screen.print(escape(part) if isinstance(part, str) else part)
