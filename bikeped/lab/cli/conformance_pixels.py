"""`bikeped conformance pixels`: the suite drawn and run through the deployed loop."""

from __future__ import annotations

from pathlib import Path

import click

from bikeped.cli.common import console, progress_bar, width_height
from bikeped.cli.guard import guarded
from bikeped.cores import cores
from bikeped.errors import BikepedError, require
from bikeped.files import make_folder
from bikeped.lab.cli.conformance_shared import begin, emit, processes_option, suite_options


def _size(text: str) -> tuple[int, int]:
    size = width_height(text.lower())
    if size is not None and 160 <= size[0] <= 7680 and 90 <= size[1] <= 4320:
        return size
    raise BikepedError(f"--size {text}: give width x height in pixels, e.g. 1920x1080")


@click.command("pixels")
@suite_options
@click.option("--scenario", "names", multiple=True, metavar="NAME", help="Only this one; repeat.")
@click.option("--size", default="1920x1080", show_default=True, help="Of the pictures.")
@click.option(
    "--light",
    type=click.Choice(["day", "overcast", "dusk", "night", "glare"]),
    default="day",
    show_default=True,
)
@click.option("--weather", type=click.Choice(["dry", "rain"]), default="dry", show_default=True)
@click.option("--place", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True)
@click.option(
    "--figures",
    "figures",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Draw stages, recall and localisation error: pixels.png and pixels.pdf in this folder.",
)
@processes_option
@guarded
def command(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    names: tuple[str, ...],
    size: str,
    light: str,
    weather: str,
    place: int,
    figures: Path | None,
    processes: int | None,
) -> None:
    """All scenarios drawn, detected, projected, tracked and decided by the deployed loop, against
    the truth; what is lost against the scripted run is named by stage.

    Without a configured detector the bundled one looks.
    """
    from dataclasses import replace

    from bikeped.lab.endtoend.ablation import run_ablation
    from bikeped.lab.endtoend.measures import collect_observations
    from bikeped.lab.endtoend.report import DrawingSettings, end_to_end_result, verdict
    from bikeped.lab.endtoend.run import run_all
    from bikeped.lab.experiments.deterministic import select_scenario
    from bikeped.lab.rendering import Conditions

    width, height = _size(size)
    if figures is not None:
        require("matplotlib")
        make_folder(figures, "--figures")
    # One thread each: the processes share the cores. A --set that is given comes later and wins.
    overrides = ("detection.threads=1", *overrides)
    loaded, suite = begin(config_path, overrides, scenarios_dir)
    if loaded.config.detection.model is None:
        loaded, suite = begin(config_path, ("detection.model=bundled", *overrides), scenarios_dir)
    if names:
        if len(set(names)) < len(names):
            raise BikepedError("--scenario: names a scenario twice, which would count it twice")
        suite = replace(
            suite, scenarios=tuple(s for n in names for s in select_scenario(suite, n).scenarios)
        )
    conditions = Conditions(seed=seed or 0, light=light, weather=weather, place=place)
    with progress_bar("scenarios", len(suite.scenarios)) as progress:
        runs = run_all(
            loaded, suite.scenarios, conditions, (width, height), processes or cores(), progress
        )
    rungs = run_ablation(suite, runs, loaded, loaded.config.decision)
    drawing = DrawingSettings(width, height, light, weather, place, seed or 0)
    result = end_to_end_result(
        suite, runs, rungs, collect_observations(runs, suite.perception_results, loaded), drawing
    )
    if figures is not None:
        from bikeped.lab.endtoend.figure import draw_pixels

        draw_pixels(result.data, figures)
    emit(result, suite, loaded, seed or 0, json_path)
    if json_path != "-":
        console(json_path).print(verdict(rungs))
