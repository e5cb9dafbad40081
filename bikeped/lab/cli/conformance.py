"""`bikeped conformance`: the simulation's experiments."""

from __future__ import annotations

from pathlib import Path

import click
from rich.markup import escape

from bikeped.cli.common import LazyGroup, progress_bar
from bikeped.config.load import load_decision
from bikeped.errors import BikepedError, require
from bikeped.files import write_whole
from bikeped.lab.cli.conformance_shared import (
    SuiteRun,
    experiment_options,
    misses_options,
    rich_table,
    trials_option,
)

_GOVERNANCE = "bikeped.lab.cli.conformance_governance"


@click.group(
    "conformance",
    cls=LazyGroup,
    lazy={
        "gate": (f"{_GOVERNANCE}:gate", "Check a candidate against the deployment gates."),
        "promote": (f"{_GOVERNANCE}:promote", "Write a candidate that holds all gates into -c."),
        "contest": (f"{_GOVERNANCE}:contest", "What-if comparison: results before and after."),
        "register": (f"{_GOVERNANCE}:register", "Write the residual-risk register."),
        "encounters": (
            "bikeped.lab.cli.conformance_traffic:encounters",
            "Write random encounters as scenario files.",
        ),
        "traffic": (
            "bikeped.lab.cli.conformance_traffic:traffic",
            "Real trajectories through tracker and rules: nuisance and misses.",
        ),
        "plot": (f"{_GOVERNANCE}:plot", "Draw each scenario over time and from above."),
        "pixels": (
            "bikeped.lab.cli.conformance_pixels",
            "End-to-end simulation: rendered video, detector, deployed loop.",
        ),
    },
)
def command() -> None:
    """Simulate scripted encounters and measure the decision rule against ground truth."""


@command.command("run")
@experiment_options
@click.option("--scenario", "name", metavar="NAME", help="Only this scenario.")
@click.option(
    "--audit",
    "audit_path",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write every frame's true and observed positions, state and danger as JSON Lines.",
)
def run(run: SuiteRun, name: str | None, audit_path: Path | None) -> None:
    """Results of every scenario under one configuration.

    States, sensitivity, specificity, missed severity, fatigue, latency and warning budgets.
    """
    from bikeped.lab.experiments.deterministic import run_table, select_scenario
    from bikeped.lab.governance.audit_records import write_audit

    if name is not None:
        run.suite = select_scenario(run.suite, name)
    if audit_path is not None:
        write_audit(audit_path, run.suite, run.decision, run.loaded, run.seed)
    run.emit(run_table(run.suite, run.decision))


@command.command("compare")
@experiment_options
@click.option(
    "--configuration",
    "added",
    multiple=True,
    metavar="NAME=FILE.yaml",
    help="A further configuration: the file's decision section. May be repeated.",
)
def compare(run: SuiteRun, added: tuple[str, ...]) -> None:
    """Compare decision rules and configurations.

    Each with and without localisation error.
    """
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
    run.emit(compare_table(run.suite, run.loaded, configurations, run.seed))


@command.command("errors")
@experiment_options
def errors(run: SuiteRun) -> None:
    """Localisation error of pedestrians, cyclists and cars by distance and bearing."""
    from bikeped.lab.experiments.deterministic import localisation_errors

    run.emit(localisation_errors(run.suite))


@command.command("truth")
@experiment_options
def truth(run: SuiteRun) -> None:
    """Sensitivity to ground-truth thresholds and braking profiles."""
    from bikeped.lab.experiments.deterministic import braking_profiles, truth_sensitivity
    from bikeped.lab.result_tables import ExperimentResult

    thresholds = truth_sensitivity(run.suite, run.decision)
    braking = braking_profiles(run.suite, run.decision)
    data = {**thresholds.data, "braking": braking.data}
    run.emit(ExperimentResult("truth", data, (*thresholds.tables, *braking.tables)))


@command.command("montecarlo")
@experiment_options
@misses_options
def montecarlo(
    run: SuiteRun, trials: int, burst: float, curve_path: Path | None, processes: int
) -> None:
    """Monte Carlo trials with missed detections.

    Misses are independent or in bursts; results are means with 95 % confidence intervals. The
    configuration's own decision is `configured` when it is none of the named ones.
    """
    require("scipy")
    from bikeped.lab.experiments import trials as mc
    from bikeped.lab.simulation.perception import load_recall_curve, recall_models
    from bikeped.lab.simulation.suite import CONFIGURATIONS

    curve = None if curve_path is None else load_recall_curve(curve_path)
    configurations = dict(CONFIGURATIONS)
    if run.decision not in configurations.values():
        configurations = {"configured": run.decision, **configurations}
    suite = run.suite
    jobs = mc.trial_jobs(2 * len(recall_models(curve)), trials)
    with progress_bar("trials", jobs) as progress:
        result = mc.montecarlo(
            suite, configurations, trials, run.seed, burst, curve, processes, progress
        )
    run.emit(result)


@command.command("latency")
@experiment_options
@click.option("--loss", is_flag=True, help="With missed detections: fewer delays, random trials.")
@click.option("--bursts", is_flag=True, help="With --loss: missed detections come in bursts.")
@misses_options
def latency(
    run: SuiteRun,
    loss: bool,
    bursts: bool,
    trials: int,
    burst: float,
    curve_path: Path | None,
    processes: int,
) -> None:
    """Effect of camera latency, 0 to 500 ms, with and without motion prediction."""
    from bikeped.lab.experiments import latency as sweeps
    from bikeped.lab.experiments.trials import trial_jobs
    from bikeped.lab.simulation.perception import load_recall_curve, recall_models

    if not loss and (bursts or curve_path is not None):
        raise BikepedError("latency: --bursts and --recall-curve belong to --loss; add it")
    curve = None if curve_path is None else load_recall_curve(curve_path)
    suite = run.suite
    if not loss:
        run.emit(sweeps.sweep(suite, run.decision))
        return
    require("scipy")
    with progress_bar("trials", trial_jobs(1, trials)) as progress:
        result = sweeps.sweep_with_loss(
            suite,
            run.decision,
            recall=recall_models(curve)[-1],
            burst=burst if bursts else None,
            trials=trials,
            seed=run.seed,
            processes=processes,
            progress=progress,
        )
    run.emit(result)


@command.command("optimize")
@experiment_options
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
    help="Write the decision found, as a candidate for `gate` and `promote`.",
)
def optimize(run: SuiteRun, maxiter: int, popsize: int, out: Path | None) -> None:
    """Optimise the decision's five parameters by differential evolution."""
    from bikeped.lab.experiments import optimizer

    seed = optimizer.SEED if run.seed_option is None else run.seed_option
    suite = run.suite
    with progress_bar("evaluations", optimizer.evaluations(maxiter, popsize)) as progress:
        result = optimizer.optimize(suite, run.decision, seed, maxiter, popsize, progress)
    if out is not None:
        write_whole(out, optimizer.candidate_yaml(result, suite.hash, run.loaded.hash))
    run.emit(result, seed)
    if out is not None:
        run.console.print(f"wrote {escape(str(out))}")


@command.command("deployment")
@experiment_options
@trials_option(200)
def deployment(run: SuiteRun, trials: int) -> None:
    """Sensitivity by road width, with one camera and with two."""
    from bikeped.lab.experiments import deployment as roads

    camera = run.suite.camera
    with progress_bar("road widths", len(roads.WIDTHS_FT)) as progress:
        result = roads.deployment(
            camera, run.suite.tracker, run.decision, trials, run.seed, progress=progress
        )
    run.emit(result)


@command.command("placement")
@experiment_options
@trials_option(20)
@click.option(
    "--paper",
    is_flag=True,
    help="As the paper's grid: true positions of what was detected, no tracker, all danger frames.",
)
def placement(run: SuiteRun, trials: int, paper: bool) -> None:
    """Sensitivity by camera height and pitch on a road of 40 ft."""
    from bikeped.lab.experiments import deployment as roads

    camera = run.suite.camera
    with progress_bar("heights", len(roads.HEIGHTS_M)) as progress:
        result = roads.placement(
            camera,
            run.suite.tracker,
            run.decision,
            trials,
            run.seed,
            progress=progress,
            paper=paper,
        )
    run.emit(result)


@command.command("reproduce")
@experiment_options
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("conformance"),
    show_default=True,
    help="Folder for data, tables, figures and report; finished experiments there are kept.",
)
@misses_options
@click.option("--no-figures", is_flag=True, help="Only data and tables.")
def reproduce(
    run: SuiteRun,
    out: Path,
    trials: int,
    burst: float,
    curve_path: Path | None,
    processes: int,
    no_figures: bool,
) -> None:
    """Run all experiments, with every table and figure.

    Finished experiments are kept: a second run resumes after an interruption.
    """
    require("scipy")  # before the work, not in the middle of it
    from bikeped.lab.experiments import reproduce as reproduction
    from bikeped.lab.experiments.deterministic import METRIC_COLUMNS
    from bikeped.lab.result_tables import ResultTable, cells
    from bikeped.lab.simulation.perception import load_recall_curve

    if not no_figures:
        require("matplotlib")
    curve = None if curve_path is None else load_recall_curve(curve_path)
    suite = run.suite
    settings = reproduction.ReproduceSettings(trials, run.seed, burst, curve)
    with progress_bar("experiments", len(reproduction.EXPERIMENTS) + 1) as progress:
        found = reproduction.reproduce(
            suite, run.loaded, out, settings, processes, not no_figures, progress
        )
    data = {r.name: r.data for r in found.results}
    run.write_json(
        {
            "out": str(out),
            "reused": list(found.reused),
            "seconds": dict(found.seconds),
            "figures": [str(path) for path in found.figures],
            "index": None if found.index is None else str(found.index),
            **run.provenance(),
            "results": data,
        }
    )
    compared = data["compare"]["configurations"].items()
    rows = [(name, *cells(metrics, METRIC_COLUMNS)) for name, metrics in compared]
    columns = ("configuration", *METRIC_COLUMNS)
    run.console.print(rich_table(ResultTable("compare", "Configurations", columns, rows)))
    run.console.print(
        f"{len(found.results)} experiments ({len(found.reused)} were there already), "
        f"{len(found.figures)} figure files in {escape(str(out))}"
    )
    if found.index is not None:
        run.console.print(f"see {escape(str(found.index))}")
