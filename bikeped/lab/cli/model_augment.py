"""`bikeped model augment`: a data set of ordinary pictures as a fisheye lens would show it."""

from __future__ import annotations

from pathlib import Path

import click
from rich.markup import escape
from rich.table import Table

from bikeped.cli.common import (
    FiniteRange,
    console,
    json_option,
    progress_bar,
    write_json,
)
from bikeped.cli.guard import check_outputs, guarded


@click.command("augment")
@click.argument("data", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="New folder for annotations.json and images/.",
)
@click.option(
    "--images",
    "images_dir",
    type=click.Path(path_type=Path),
    help="Folder that the data's file names start from, where it is not found by itself.",
)
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option(
    "--copies",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    help="Fisheye pictures drawn of every picture, each through another lens.",
)
@click.option(
    "--projection",
    "projections",
    multiple=True,
    type=click.Choice(["equidistant", "equisolid", "stereographic", "orthographic"]),
    help="Lens model to draw from; may be repeated. Default: all four.",
)
@click.option(
    "--fov-deg",
    nargs=2,
    type=float,
    metavar="MIN MAX",
    help="What the image circle spans. Default: 170 210.",
)
@click.option(
    "--picture-fov-deg",
    nargs=2,
    type=float,
    metavar="MIN MAX",
    help="What the ordinary picture's longer side is taken to span. Default: 90 150.",
)
@click.option(
    "--yaw-deg",
    nargs=2,
    type=float,
    metavar="MIN MAX",
    help="How far to the right of the lens's axis the picture lies. Default: -50 50.",
)
@click.option(
    "--pitch-deg",
    nargs=2,
    type=float,
    metavar="MIN MAX",
    help="How far above the axis it lies; below is negative. Default: -40 15.",
)
@click.option(
    "--roll-deg",
    nargs=2,
    type=float,
    metavar="MIN MAX",
    help="How far it is turned. Default: -10 10.",
)
@click.option(
    "--radius",
    "radius_share",
    nargs=2,
    type=float,
    metavar="MIN MAX",
    help="Radius of the image circle as a share of --size. Default: 0.42 0.55.",
)
@click.option(
    "--shift",
    "shift_share",
    nargs=2,
    type=float,
    metavar="MIN MAX",
    help="Way of the circle's centre from the middle, as a share of --size. Default: -0.04 0.04.",
)
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
    help="Objects of which less than this share of the area is left are dropped.",
)
@click.option(
    "--processes",
    type=click.IntRange(1, 256),
    default=2,
    show_default=True,
    help="The pictures do not depend on it.",
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
) -> int:
    """Warp DATA (COCO's format: an annotation file, or its folder) by sampled fisheye lenses."""
    from bikeped.lab.training.augment import AugmentSettings, augment_data
    from bikeped.lab.training.coco import read_coco
    from bikeped.lab.training.warp import WarpRanges

    given = {key: value for key, value in ranges.items() if value is not None}
    if projections:
        given["projections"] = projections  # type: ignore[assignment]
    settings = AugmentSettings(
        WarpRanges(size_px=size_px, **given),  # type: ignore[arg-type]
        seed,
        copies,
        least_share,
        processes,
    )
    source = read_coco(data, images_dir)
    if json_path not in (None, "-"):
        check_outputs(
            [("DATA", source.source), *(("DATA", image.path) for image in source.images)],
            [("--json", Path(str(json_path)))],
        )
    with progress_bar("augment", len(source.images)) as progress:
        summary = augment_data(source, out, settings, progress)
    if json_path is not None:
        write_json(summary.as_dict(), json_path)
    if json_path != "-":
        screen = console()
        screen.print(
            f"{len(source.images)} pictures became {summary.pictures}, with {summary.objects} "
            f"objects; {summary.dropped} dropped, of which too little was left; seed {seed}"
        )
        if summary.empty:
            screen.print(f"{summary.empty} boxes without area were passed over")
        table = Table(box=None, pad_edge=False)
        table.add_column("category")
        table.add_column("objects", justify="right")
        for name, count in summary.by_category.items():
            if count:
                table.add_row(escape(name), str(count))
        if summary.objects:
            screen.print(table)
        screen.print(escape(f"wrote {out / 'annotations.json'} and {out / 'images'}"))
    return 0
