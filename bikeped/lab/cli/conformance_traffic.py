"""`bikeped conformance traffic` and `encounters`: real trajectories, and random scenario files."""

from __future__ import annotations

import difflib
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import click

from bikeped.cli.common import config_options, json_option, progress_bar
from bikeped.cli.guard import guarded
from bikeped.errors import BikepedError
from bikeped.files import make_folder, write_whole
from bikeped.lab.cli.conformance_shared import SuiteRun, rich_table, tracker_option

if TYPE_CHECKING:
    from bikeped.lab.simulation.simulate import TrackerName
    from bikeped.lab.traffic.suite import Noise


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


@click.command("traffic")
@click.argument("traffic", metavar="DIR", type=click.Path(path_type=Path))
@config_options
@click.option(
    "--rule",
    "rules",
    multiple=True,
    metavar="NAME",
    help="Only this configuration; may be repeated. Foresight is always beside it.",
)
@click.option(
    "--noise",
    type=click.Choice(["none", "realistic", "bursts"]),
    default="realistic",
    show_default=True,
    help="Localisation error and missed detections by size, alone or in bursts; or neither.",
)
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@click.option(
    "--html",
    "html_path",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write a page in one file with every alert to step through, nuisance first: of the "
    "first --rule, or of the configured decision.",
)
@tracker_option
@json_option
@guarded
def traffic(
    traffic: Path,
    config_path: Path | None,
    overrides: tuple[str, ...],
    rules: tuple[str, ...],
    noise: Noise,
    seed: int,
    html_path: Path | None,
    tracker: TrackerName,
    json_path: str | None,
) -> None:
    """Real or recorded trajectories through tracker and rules: nuisance, misses, by scene.

    DIR holds SCENE.csv[.gz] (time_s,id,kind,x_m,y_m; 10 Hz and more) or SUMO's SCENE.xml[.gz] (FCD
    output), and poles.json with each scene's x_m, y_m and heading_deg of the camera.
    """
    from bikeped.lab.simulation.suite import CONFIGURATIONS
    from bikeped.lab.traffic.readers import read_traffic
    from bikeped.lab.traffic.result import FORESIGHT, traffic_result, with_alert_settings
    from bikeped.lab.traffic.suite import TrafficSuite

    run = SuiteRun(config_path, overrides, None, json_path, tracker, seed)
    known = {**CONFIGURATIONS, "configured": run.decision}
    every = [n for n in known if n != "configured" or run.decision not in CONFIGURATIONS.values()]
    chosen = {name: known[name] for name in rules or every if name in known}
    for name in rules:
        if name not in (*chosen, FORESIGHT):
            near = difflib.get_close_matches(name, known, 1)
            remedy = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            raise BikepedError(f"--rule {name}: there is no such configuration; {remedy}")
    suite = TrafficSuite.load(read_traffic(traffic), run.loaded, noise, seed, tracker)
    with progress_bar("rules", len(chosen) + 1) as progress:
        result = traffic_result(suite, chosen, run.loaded, progress)
    if html_path is not None:
        from bikeped.lab.testbench.traffic_page import render_traffic_page

        name = next(iter(chosen)) if rules and chosen else "configured"
        shown = with_alert_settings(known[name], run.decision)
        words = f"bikeped conformance traffic {shlex.quote(str(traffic))} --noise {noise}"
        words += "".join(f" --rule {rule}" for rule in rules) + f" --seed {seed}"
        write_whole(html_path, render_traffic_page(suite, name, shown, result, words))
    if json_path is not None:
        run.write_json(result.data)
    if json_path != "-":
        for table in result.tables:
            run.console.print(rich_table(table))
            run.console.print()
