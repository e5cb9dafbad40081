"""`bikeped model augment`: fisheye augmentation of a data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from rich.table import Table

from bikeped.cli.common import FiniteRange, json_option, progress_bar, text_table
from bikeped.cli.guard import check_outputs, guarded, written_paths
from bikeped.lab.cli.model import data_argument, data_files, images_option, report

#: Parameter of `WarpRanges`: help with the default range.
_RANGES = {
    "fov_deg": "Field of view of the image circle. Default: 170 210.",
    "picture_fov_deg": "Field of view assumed for the ordinary picture's longer side. "
    "Default: 90 150.",
    "yaw_deg": "Yaw of the picture from the lens axis, right is positive. Default: -50 50.",
    "pitch_deg": "Pitch of the picture from the lens axis, up is positive. Default: -40 15.",
    "roll_deg": "Roll of the picture. Default: -10 10.",
    "radius_share": "Radius of the image circle as a share of --size. Default: 0.42 0.55.",
    "shift_share": "Offset of the circle's centre as a share of --size. Default: -0.04 0.04.",
}
F = TypeVar("F", bound=Callable[..., Any])


def _range_options(command: F) -> F:
    for name, text in reversed(_RANGES.items()):
        option = "--" + name.removesuffix("_share").replace("_", "-")
        command = click.option(option, name, nargs=2, type=float, metavar="MIN MAX", help=text)(
            command
        )
    return command


@click.command("augment")
@data_argument
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="New folder for annotations.json and images/.",
)
@images_option
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option(
    "--copies",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    help="Fisheye pictures made of each picture, each with another lens.",
)
@click.option(
    "--projection",
    "projections",
    multiple=True,
    type=click.Choice(["equidistant", "equisolid", "stereographic", "orthographic"]),
    help="Lens model to draw from; may be repeated. Default: all four.",
)
@_range_options
@click.option(
    "--size",
    "size_px",
    type=click.IntRange(64, 8192),
    default=1280,
    show_default=True,
    help="Side of the new pictures, in pixels.",
)
@click.option(
    "--least-share",
    type=FiniteRange(0, 1),
    default=0.3,
    show_default=True,
    help="Drop an object of which less than this share of the area remains.",
)
@click.option(
    "--processes",
    type=click.IntRange(1, 256),
    default=2,
    show_default=True,
    help="Number of processes; the pictures do not depend on it.",
)
@json_option
@guarded
def command(
    data: Path,
    out: Path,
    images_dir: Path | None,
    seed: int,
    copies: int,
    projections: tuple[str, ...],
    size_px: int,
    least_share: float,
    processes: int,
    json_path: str | None,
    **ranges: tuple[float, float] | None,
) -> None:
    """Warp the pictures and boxes of DATA by randomly sampled fisheye lenses.

    DATA is an annotation file in COCO's format, or its folder.
    """
    from bikeped.lab.training.augment import AugmentSettings, augment_data
    from bikeped.lab.training.coco import read_coco
    from bikeped.lab.training.warp import WarpRanges

    given: dict[str, Any] = {key: value for key, value in ranges.items() if value is not None}
    if projections:
        given["projections"] = projections
    warps = WarpRanges(size_px=size_px, **given)
    settings = AugmentSettings(warps, seed, copies, least_share, processes)
    source = read_coco(data, images_dir)
    check_outputs(data_files(source), [("--json", path) for path in written_paths(json_path)])
    with progress_bar("augment", len(source.images)) as progress:
        summary = augment_data(source, out, settings, progress)
    counts = f"{len(source.images)} pictures became {summary.pictures}"
    dropped = f"{summary.dropped} dropped, of which too little was left; seed {seed}"
    shown: list[str | Table] = [f"{counts}, with {summary.objects} objects; {dropped}"]
    if summary.empty:
        shown.append(f"{summary.empty} boxes without area were left out")
    rows = [(name, str(count)) for name, count in summary.by_category.items() if count]
    if rows:
        shown.append(text_table(("category", "objects"), rows))
    shown.append(f"wrote {out / 'annotations.json'} and {out / 'images'}")
    report(summary.as_dict(), json_path, shown)
