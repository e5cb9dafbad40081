"""`bikeped conformance`: the simulation's experiments."""

from __future__ import annotations

from pathlib import Path

import click
from rich.markup import escape

from bikeped.cli.common import (
    console,
    progress_bar,
    write_json,
)
from bikeped.cli.guard import guarded
from bikeped.config.candidate import load_decision
from bikeped.cores import cores
from bikeped.errors import BikepedError, require
from bikeped.files import write_whole
from bikeped.lab.cli.conformance_governance import add_commands
from bikeped.lab.cli.conformance_pixels import command as pixels
from bikeped.lab.cli.conformance_shared import (
    begin,
    burst_option,
    curve_option,
    emit,
    print_table,
    processes_option,
    stamp,
    suite_options,
    trials_option,
)


@click.group("conformance")
def command() -> None:
    """Simulate scripted encounters: does the decision warn when it must, and only then?"""


add_commands(command)
command.add_command(pixels)


@command.command("run")
@suite_options
@click.option("--scenario", "name", metavar="NAME", help="Only this scenario.")
@click.option(
    "--audit",
    "audit_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write every frame's true and observed positions, state and danger as JSON Lines.",
)
@guarded
def run(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    name: str | None,
    audit_path: Path | None,
) -> None:
    """Every scenario under the configuration: states, misses, false alerts, warning budgets."""
    from bikeped.lab.experiments.deterministic import run_table, select_scenario
    from bikeped.lab.governance.audit_records import write_audit

    loaded, suite = begin(config_path, overrides, scenarios_dir)
    if name is not None:
        suite = select_scenario(suite, name)
    if audit_path is not None:
        write_audit(audit_path, suite, loaded.config.decision, loaded, seed or 0)
    emit(run_table(suite, loaded.config.decision), suite, loaded, seed or 0, json_path)


@command.command("compare")
@suite_options
@click.option(
    "--configuration",
    "added",
    multiple=True,
    metavar="NAME=FILE.yaml",
    help="A further configuration: the file's decision section. May be repeated.",
)
@guarded
def compare(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    added: tuple[str, ...],
) -> None:
    """The named configurations and rules side by side, with and without localisation error."""
    from bikeped.lab.experiments.deterministic import compare_table
    from bikeped.lab.simulation.suite import CONFIGURATIONS

    configurations = dict(CONFIGURATIONS)
    for item in added:
        name, equals, file = item.partition("=")
        if not (name and equals and file):
            raise BikepedError(f"--configuration {item}: expected NAME=FILE.yaml")
        if name in configurations:
            raise BikepedError(f"--configuration {name}: the name is taken; choose another")
        configurations[name] = load_decision(Path(file))
    loaded, suite = begin(config_path, overrides, scenarios_dir)
    result = compare_table(suite, loaded, configurations, seed or 0)
    emit(result, suite, loaded, seed or 0, json_path)


@command.command("errors")
@suite_options
@guarded
def errors(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
) -> None:
    """How far off the camera puts pedestrians, cyclists and cars, by distance and bearing."""
    from bikeped.lab.experiments.deterministic import errors as localisation_errors

    loaded, suite = begin(config_path, overrides, scenarios_dir)
    emit(localisation_errors(suite), suite, loaded, seed or 0, json_path)


@command.command("truth")
@suite_options
@guarded
def truth(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
) -> None:
    """Do the figures hang on the ground truth's thresholds, or on how cyclists brake?"""
    from bikeped.lab.experiments.deterministic import braking_profiles, truth_sensitivity
    from bikeped.lab.result_tables import ExperimentResult

    loaded, suite = begin(config_path, overrides, scenarios_dir)
    decision = loaded.config.decision
    thresholds, braking = truth_sensitivity(suite, decision), braking_profiles(suite, decision)
    data = {**thresholds.data, "braking": braking.data}
    result = ExperimentResult("truth", data, (*thresholds.tables, *braking.tables))
    emit(result, suite, loaded, seed or 0, json_path)


@command.command("montecarlo")
@suite_options
@trials_option(50)
@burst_option
@curve_option
@processes_option
@guarded
def montecarlo(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    trials: int,
    burst: float,
    curve_path: Path | None,
    processes: int | None,
) -> None:
    """Lost detections, one by one and in bursts: means with 95 % confidence intervals.

    The configuration's own decision is `configured` when it is none of the named ones.
    """
    require("scipy")
    from bikeped.lab.experiments import montecarlo as mc
    from bikeped.lab.simulation.suite import CONFIGURATIONS

    curve = None if curve_path is None else mc.load_recall_curve(curve_path)
    loaded, suite = begin(config_path, overrides, scenarios_dir)
    configurations = dict(CONFIGURATIONS)
    if loaded.config.decision not in configurations.values():
        configurations = {"configured": loaded.config.decision, **configurations}
    workers = processes or cores()
    jobs = mc.montecarlo_jobs(trials, curve is not None)
    with progress_bar("trials", jobs) as progress:
        result = mc.montecarlo(
            suite, configurations, trials, seed or 0, burst, curve, workers, progress
        )
    emit(result, suite, loaded, seed or 0, json_path)


@command.command("latency")
@suite_options
@click.option("--loss", is_flag=True, help="Lose detections too; at fewer delays, with trials.")
@click.option("--bursts", is_flag=True, help="With --loss: lose them in bursts.")
@trials_option(50)
@burst_option
@curve_option
@processes_option
@guarded
def latency(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    loss: bool,
    bursts: bool,
    trials: int,
    burst: float,
    curve_path: Path | None,
    processes: int | None,
) -> None:
    """Late pictures, 0 to 500 ms, without prediction and with two kinds of it."""
    from bikeped.lab.experiments import latency as late
    from bikeped.lab.experiments import montecarlo as mc

    if not loss and (bursts or curve_path is not None):
        raise BikepedError("latency: --bursts and --recall-curve belong to --loss; add it")
    curve = None if curve_path is None else mc.load_recall_curve(curve_path)
    loaded, suite = begin(config_path, overrides, scenarios_dir)
    decision = loaded.config.decision
    if not loss:
        result = late.sweep(suite, decision)
    else:
        require("scipy")
        workers = processes or cores()
        jobs = mc.trial_jobs(1, trials)
        with progress_bar("trials", jobs) as progress:
            result = late.sweep_with_loss(
                suite,
                decision,
                recall=None if curve is None else mc.recall_models(curve)[-1],
                burst=burst if bursts else None,
                trials=trials,
                seed=seed or 0,
                processes=workers,
                progress=progress,
            )
    emit(result, suite, loaded, seed or 0, json_path)


@command.command("optimize")
@suite_options
@click.option(
    "--maxiter",
    type=click.IntRange(1, 10_000),
    default=60,
    show_default=True,
    help="Generations; evaluations are 5 * popsize * (maxiter + 1).",
)
@click.option(
    "--popsize",
    type=click.IntRange(2, 1000),
    default=15,
    show_default=True,
    help="Individuals per parameter.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="CANDIDATE.yaml",
    help="Write what was found as a candidate for `gate` and `promote`.",
)
@guarded
def optimize(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    maxiter: int,
    popsize: int,
    out: Path | None,
) -> None:
    """Search the decision's five parameters by differential evolution."""
    from bikeped.lab.experiments import optimizer as search

    loaded, suite = begin(config_path, overrides, scenarios_dir)
    chosen = search.SEED if seed is None else seed
    with progress_bar("evaluations", search.evaluations(maxiter, popsize)) as progress:
        result = search.optimize(suite, loaded.config.decision, chosen, maxiter, popsize, progress)
    if out is not None:
        write_whole(out, search.candidate_yaml(result, suite.hash, loaded.hash))
    emit(result, suite, loaded, chosen, json_path)
    if out is not None:
        console(json_path).print(f"wrote {escape(str(out))}")


@command.command("deployment")
@suite_options
@trials_option(200)
@guarded
def deployment(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    trials: int,
) -> None:
    """Road widths with one camera and with two."""
    from bikeped.lab.experiments import deployment as roads

    loaded, suite = begin(config_path, overrides, scenarios_dir)
    with progress_bar("road widths", len(roads.WIDTHS_FT)) as progress:
        result = roads.deployment(
            suite.camera, loaded.config.decision, trials, seed or 0, progress=progress
        )
    emit(result, suite, loaded, seed or 0, json_path)


@command.command("placement")
@suite_options
@trials_option(20)
@guarded
def placement(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    trials: int,
) -> None:
    """Camera height by pitch on a road of 40 ft."""
    from bikeped.lab.experiments import deployment as roads

    loaded, suite = begin(config_path, overrides, scenarios_dir)
    with progress_bar("heights", len(roads.HEIGHTS_M)) as progress:
        result = roads.placement(
            suite.camera, loaded.config.decision, trials, seed or 0, progress=progress
        )
    emit(result, suite, loaded, seed or 0, json_path)


@command.command("reproduce")
@suite_options
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("conformance"),
    show_default=True,
    help="Folder for data, tables, figures and index page; what is there already is kept.",
)
@trials_option(50)
@burst_option
@curve_option
@processes_option
@click.option("--no-figures", is_flag=True, help="Only data and tables.")
@guarded
def reproduce(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    seed: int | None,
    json_path: str | None,
    out: Path,
    trials: int,
    burst: float,
    curve_path: Path | None,
    processes: int | None,
    no_figures: bool,
) -> None:
    """All experiments with every table and figure; resumes where it was interrupted."""
    require("scipy")
    from bikeped.lab.experiments import reproduce as whole
    from bikeped.lab.experiments.deterministic import metric_cells
    from bikeped.lab.experiments.montecarlo import load_recall_curve
    from bikeped.lab.result_tables import ResultTable

    if not no_figures:
        require("matplotlib")
    curve = None if curve_path is None else load_recall_curve(curve_path)
    loaded, suite = begin(config_path, overrides, scenarios_dir)
    settings = whole.ReproduceSettings(trials=trials, seed=seed or 0, burst=burst, curve=curve)
    with progress_bar("experiments", len(whole.EXPERIMENTS) + 1) as progress:
        found = whole.reproduce(
            suite, loaded, out, settings, processes or cores(), not no_figures, progress
        )
    data = {r.name: r.data for r in found.results}
    if json_path is not None:
        write_json(
            {
                "out": str(out),
                "reused": list(found.reused),
                "seconds": dict(found.seconds),
                "figures": [str(path) for path in found.figures],
                "index": None if found.index is None else str(found.index),
                **stamp(suite, loaded, seed or 0),
                "results": data,
            },
            json_path,
        )
    screen = console(json_path)
    compared = data["compare"]["configurations"]
    columns = next(r for r in found.results if r.name == "compare").tables[0].columns
    rows = [(name, *metric_cells(metrics)) for name, metrics in compared.items()]
    print_table(screen, ResultTable("compare", "Configurations", columns, rows))
    screen.print(
        f"{len(found.results)} experiments ({len(found.reused)} were there already), "
        f"{len(found.figures)} figure files in {escape(str(out))}"
    )
    if found.index is not None:
        screen.print(f"see {escape(str(found.index))}")
