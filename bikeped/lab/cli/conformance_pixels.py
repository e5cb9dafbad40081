"""`bikeped conformance pixels`: the suite rendered and run through the deployed loop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from bikeped.cli.common import progress_bar, width_height
from bikeped.errors import BikepedError, require
from bikeped.files import make_folder
from bikeped.lab.cli.conformance_shared import SuiteRun, experiment_options, processes_option


def _size(text: str) -> tuple[int, int]:
    size = width_height(text.lower())
    if size is not None and 160 <= size[0] <= 7680 and 90 <= size[1] <= 4320:
        return size
    raise BikepedError(f"--size {text}: give width x height in pixels, e.g. 1920x1080")


@click.command("pixels")
@experiment_options
@click.option("--scenario", "names", multiple=True, metavar="NAME", help="Only this one; repeat.")
@click.option("--size", default="1920x1080", show_default=True, help="Size of the rendered frames.")
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
def command(
    run: SuiteRun,
    names: tuple[str, ...],
    size: str,
    light: str,
    weather: str,
    place: int,
    figures: Path | None,
    processes: int,
) -> None:
    """End-to-end simulation: all scenarios rendered as video, detected, projected, tracked and
    decided by the deployed loop, against ground truth. An ablation says which stage loses what.

    Without a configured detector the bundled one is used.
    """
    from bikeped.lab.endtoend.ablation import run_ablation
    from bikeped.lab.endtoend.measures import collect_observations
    from bikeped.lab.endtoend.report import draw_pixels, end_to_end_result, verdict
    from bikeped.lab.endtoend.run import run_all
    from bikeped.lab.experiments.deterministic import select_scenario
    from bikeped.lab.rendering import Conditions

    width, height = _size(size)
    if figures is not None:
        require("matplotlib")
        make_folder(figures, "--figures")
    # One thread each: the processes share the cores. A --set that is given comes later and wins.
    run = replace(run, overrides=("detection.threads=1", *run.overrides))
    if run.loaded.config.detection.model is None:
        run = replace(run, overrides=("detection.model=bundled", *run.overrides))
    if names:
        if len(set(names)) < len(names):
            raise BikepedError("--scenario: names a scenario twice, which would count it twice")
        chosen = (select_scenario(run.suite, name).scenarios for name in names)
        run.suite = replace(run.suite, scenarios=tuple(s for part in chosen for s in part))
    suite, loaded = run.suite, run.loaded
    conditions = Conditions(seed=run.seed, light=light, weather=weather, place=place)
    with progress_bar("scenarios", len(suite.scenarios)) as progress:
        runs = run_all(loaded, suite.scenarios, conditions, (width, height), processes, progress)
    steps = run_ablation(suite, runs, loaded, run.decision)
    drawing = {"width": width, "height": height, **vars(conditions)}
    observations = collect_observations(runs, suite.perception_results, loaded)
    result = end_to_end_result(suite, runs, steps, observations, drawing)
    if figures is not None:
        draw_pixels(result.data, figures)
    run.emit(result)
    if run.json_path != "-":
        run.console.print(verdict(steps))
