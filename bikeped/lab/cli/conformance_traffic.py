"""`bikeped conformance encounters`: random encounters as scenario files."""

from __future__ import annotations

from pathlib import Path

import click

from bikeped.errors import BikepedError
from bikeped.files import make_folder, write_whole


@click.command("encounters")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option("--count", type=click.IntRange(1, 10_000), default=200, show_default=True)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder for the scenario files; new, or empty.",
)
def encounters(seed: int, count: int, out: Path) -> None:
    """Write random encounters of cyclists and pedestrians as scenario files.

    The same seed gives the same bytes. Many are harmless. Use the folder as `--scenarios`.
    """
    from bikeped.lab.scenarios.random_encounters import random_encounters
    from bikeped.lab.scenarios.scenario import dump_scenario

    make_folder(out)
    if any(out.iterdir()):
        raise BikepedError(f"--out {out}: holds files already; name a new folder")
    for index, scenario in enumerate(random_encounters(seed, count)):
        write_whole(out / f"encounter-{index:04d}.yaml", dump_scenario(scenario))
    click.echo(f"wrote {count} scenario files to {out}")
