"""`bikeped model export`: weights to ONNX, ONNX to a TensorRT engine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from rich.markup import escape

from bikeped.cli.common import console, json_option, width_height, write_json
from bikeped.cli.guard import guarded
from bikeped.errors import DetectorError, require


@click.command("export")
@click.argument("weights", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="The ONNX file. Default: WEIGHTS with .onnx; nothing where WEIGHTS is ONNX already.",
)
@click.option(
    "--engine",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Build a TensorRT engine, too; on the Jetson that will run it.",
)
@click.option(
    "--size",
    type=click.IntRange(64, 4096),
    default=1280,
    show_default=True,
    help="Side of the square input of a YOLO; the small network knows its own.",
)
@click.option(
    "--input",
    "input_size",
    metavar="WIDTHxHEIGHT",
    help="Size of the engine's input, multiples of 32, for a model that takes any. "
    "Default: what the model says.",
)
@click.option(
    "--int8",
    type=click.Path(path_type=Path),
    metavar="DATA",
    help="Round the small network to eight bits: quicker on a processor without a GPU. "
    "DATA: pictures in COCO's format that the steps are taken from.",
)
@click.option("--full-precision", is_flag=True, help="An engine without 16-bit floats.")
@click.option(
    "--workspace-mb",
    type=click.IntRange(16, 1 << 20),
    default=2048,
    show_default=True,
    help="Memory that TensorRT may try plans with.",
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
) -> int:
    """Export WEIGHTS (weights.pt of `model train`, or an .onnx file) to ONNX and TensorRT."""
    summary: dict[str, Any] = {}
    if int8 is not None and (engine is not None or weights.suffix.lower() == ".onnx"):
        raise DetectorError(
            f"--int8: rounds what `model train` wrote, for a processor; leave out "
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
        require("torch")
        from bikeped.lab.training.export import export_any

        model = weights.with_suffix(".onnx") if out is None else out
        _expect(model, ".onnx")
        summary = export_any(weights, model, size, int8)
    if engine is not None:
        from bikeped.lab.training.engine import build_engine

        _expect(engine, ".engine")
        built = build_engine(
            model,
            engine,
            half=not full_precision,
            workspace_mb=workspace_mb,
            size=None if input_size is None else _size(input_size),
        )
        summary |= built.as_dict()
    if json_path is not None:
        write_json(summary, json_path)
    if json_path != "-":
        _print(summary)
    return 0


def _expect(path: Path, suffix: str) -> None:
    if path.suffix.lower() != suffix:
        raise DetectorError(f"{path}: bikeped knows a model by its name; end it with {suffix}")


def _size(text: str) -> tuple[int, int]:
    size = width_height(text)
    if size is None or any(side % 32 or side == 0 for side in size):
        raise DetectorError(
            f"--input {text}: is no WIDTHxHEIGHT in multiples of 32; for example 1280x416"
        )
    return size


def _print(summary: dict[str, Any]) -> None:
    screen = console()
    if "model" in summary:
        screen.print(
            escape(
                f"wrote {summary['model']}: {summary['bytes'] / 1e6:.2f} MB, input "
                f"{summary['size'][0]} x {summary['size'][1]}, {', '.join(summary['names'])}; "
                f"boxes within {summary['largest_box_difference_px']:.2g} px of PyTorch's"
            )
        )
    if "engine" in summary:
        screen.print(
            escape(
                f"wrote {summary['engine']}: {summary['engine_bytes'] / 1e6:.2f} MB, TensorRT "
                f"{summary['tensorrt']}, {'16' if summary['half_precision'] else '32'}-bit"
            )
        )
