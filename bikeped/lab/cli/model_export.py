"""`bikeped model export`: weights to ONNX, ONNX to a TensorRT engine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from bikeped.cli.common import json_option
from bikeped.cli.guard import guarded
from bikeped.errors import DetectorError, require
from bikeped.lab.cli.model import PATH, picture_size, report


@click.command("export")
@click.argument("weights", type=PATH)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="The ONNX file. Default: WEIGHTS with .onnx; none where WEIGHTS is ONNX already.",
)
@click.option(
    "--engine",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Also build a TensorRT engine; on the Jetson that will run it.",
)
@click.option(
    "--size",
    type=click.IntRange(64, 4096),
    default=1280,
    show_default=True,
    help="Side of a YOLO's square input; weights of the small network record theirs.",
)
@click.option(
    "--input",
    "input_size",
    metavar="WIDTHxHEIGHT",
    help="Input size of the engine, multiples of 32, for a model of any size. Default: what its "
    "metadata say.",
)
@click.option(
    "--int8",
    type=PATH,
    metavar="DATA",
    help="Quantise the small network to eight bits, for a processor without a GPU. DATA: pictures "
    "in COCO's format to calibrate with.",
)
@click.option("--full-precision", is_flag=True, help="Build the engine without 16-bit floats.")
@click.option(
    "--workspace-mb",
    type=click.IntRange(16, 1 << 20),
    default=2048,
    show_default=True,
    help="Memory for TensorRT's search, MB.",
)
@json_option
@guarded
def command(
    weights: Path,
    out: Path | None,
    engine: Path | None,
    size: int,
    input_size: str | None,
    int8: Path | None,
    full_precision: bool,
    workspace_mb: int,
    json_path: str | None,
) -> None:
    """Export WEIGHTS (weights.pt of `model train`, or an .onnx file) to ONNX or TensorRT."""
    summary: dict[str, Any] = {}
    if int8 is not None and (engine is not None or weights.suffix.lower() == ".onnx"):
        raise DetectorError(
            f"--int8: rounds the weights of `model train`, for a processor; leave out "
            f"{'--engine' if engine is not None else 'the ONNX file and name weights.pt'}"
        )
    if weights.suffix.lower() == ".onnx":
        if out is not None or engine is None:
            raise DetectorError(
                f"{weights}: is ONNX already; name --engine FILE.engine to build from it, without "
                "--out"
            )
        model = weights
    else:
        model = weights.with_suffix(".onnx") if out is None else out
        _check_suffix(model, ".onnx")
    input_wh = None if input_size is None else picture_size("--input", input_size, 32)
    if engine is not None:
        _check_suffix(engine, ".engine")
    if model != weights:
        require("torch")
        from bikeped.lab.training.export import export_any

        summary = export_any(weights, model, size, int8)
    if engine is not None:
        from bikeped.lab.training.engine import build_engine

        half = not full_precision
        built = build_engine(model, engine, half=half, workspace_mb=workspace_mb, size=input_wh)
        summary |= built
    report(summary, json_path, _lines(summary))


def _check_suffix(path: Path, suffix: str) -> None:
    if path.suffix.lower() != suffix:
        raise DetectorError(f"{path}: models are told apart by suffix; end it with {suffix}")


def _lines(summary: dict[str, Any]) -> Iterator[str]:
    if "model" in summary:
        width, height = summary["size"]
        yield (
            f"wrote {summary['model']}: {summary['bytes'] / 1e6:.2f} MB, input {width} x {height}, "
            f"{', '.join(summary['names'])}; "
            f"boxes within {summary['largest_box_difference_px']:.2g} px of PyTorch's"
        )
    if "engine" in summary:
        yield (
            f"wrote {summary['engine']}: {summary['engine_bytes'] / 1e6:.2f} MB, TensorRT "
            f"{summary['tensorrt']}, {'16' if summary['half_precision'] else '32'}-bit"
        )
