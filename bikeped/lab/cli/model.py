"""`bikeped model`: data, training, export and evaluation of detectors."""

from __future__ import annotations

import click

from bikeped.cli.lazy_group import LazyGroup

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
