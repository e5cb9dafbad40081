"""`bikeped conformance gate|promote|contest|register|plot`: who may change what, and why."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from rich.markup import escape

from bikeped.cli.common import (
    config_options,
    console,
    json_option,
    progress_bar,
    write_json,
)
from bikeped.cli.guard import guarded
from bikeped.config import load_config
from bikeped.config.candidate import load_decision
from bikeped.errors import BikepedError, ConfigError, require
from bikeped.files import make_folder, write_whole
from bikeped.lab.cli.conformance_shared import load_suite, scenarios_option
from bikeped.lab.cli.governance_tables import count, print_contest, print_gates, print_register

if TYPE_CHECKING:
    pass

F = TypeVar("F", bound=Callable[..., Any])


def add_commands(group: click.Group) -> None:
    """Adds the governance commands to `bikeped conformance`."""
    for command in (gate, promote, contest, register, plot):
        group.add_command(command)


@click.command("gate")
@click.argument("candidate", type=click.Path(path_type=Path))
@config_options
@scenarios_option
@json_option
@guarded
def gate(
    candidate: Path,
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    json_path: str | None,
) -> int:
    """Check the deployment gates of the decision section in CANDIDATE.

    The camera is that of the configuration (-c), for that is what the pole has. Ends with 1 when
    a gate does not hold.
    """
    from bikeped.config.provenance import decision_hash
    from bikeped.lab.governance.gates import all_hold, check_gates

    rest, own = _split(overrides)
    decision = load_decision(candidate, own)
    loaded = load_config(config_path, rest)
    suite = load_suite(loaded, scenarios_dir)
    metrics = suite.measure(decision)
    gates = check_gates(metrics)
    if json_path is not None:
        write_json(
            {
                "candidate": str(candidate),
                "decision_hash": decision_hash(decision),
                "config_hash": loaded.hash,
                "calibration_hash": loaded.calibration_hash,
                "suite_hash": suite.hash,
                "scenarios": len(suite.scenarios),
                "gates": [g.as_dict() for g in gates],
                "holds": all_hold(gates),
                "metrics": metrics.as_dict(),
            },
            json_path,
        )
    print_gates(f"{candidate} on {count(len(suite.scenarios))}", gates, json_path)
    return 0 if all_hold(gates) else 1


@click.command("promote")
@click.argument("candidate", type=click.Path(path_type=Path))
@config_options
@scenarios_option
@click.option(
    "--trace",
    type=click.Path(path_type=Path),
    help="The optimiser's trace file that the candidate came from; its hash is kept.",
)
@json_option
@guarded
def promote(
    candidate: Path,
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    trace: Path | None,
    json_path: str | None,
) -> int:
    """Write the decision section of CANDIDATE into the configuration, if all gates hold.

    The file before it stays as FILE.bak; where the section came from goes into
    FILE.provenance.json, which `bikeped run` checks. A candidate that fails a gate is refused:
    nothing is written, the command ends with 1.
    """
    from bikeped.lab.governance.gates import all_hold, check_gates
    from bikeped.lab.governance.promote import promote as write
    from bikeped.lab.governance.promote import provenance_record

    rest, own = _split(overrides)
    if rest:
        raise ConfigError(
            f"--set {rest[0]}: promote measures with the camera that the file names; change it "
            "there (--set decision.KEY=VALUE changes the candidate)"
        )
    path = config_path or Path("config.yaml")
    loaded = load_config(path)
    decision = load_decision(candidate, own)
    suite = load_suite(loaded, scenarios_dir)
    metrics = suite.measure(decision)
    gates = check_gates(metrics)
    files = [("candidate", candidate)] + ([("trace", trace)] if trace is not None else [])
    record = provenance_record(suite, decision, metrics, loaded, files)
    print_gates(f"{candidate} on {count(len(suite.scenarios))}", gates, json_path)
    out = console(json_path)
    if not all_hold(gates):
        if json_path is not None:
            write_json({"promoted": False, **record}, json_path)
        out.print("Refused: nothing was written.", style="bold")
        return 1
    written = write(path, loaded, decision, record)
    if json_path is not None:
        write_json({"promoted": True, **record}, json_path)
    out.print(f"Promoted into {escape(str(path))}; restart the service to make it hold.")
    out.print(f"Before: {escape(written.backup.name)}; why: {escape(written.provenance.name)}")
    return 0


@click.command("contest")
@config_options
@scenarios_option
@click.option(
    "--scenario",
    "added",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A further scenario; one with the name of another takes its place. May be repeated.",
)
@click.option(
    "--truth",
    multiple=True,
    metavar="KEY=VALUE",
    help="Another ground-truth threshold: cpa_radius_m, stopping_margin, ttc_bound_s, braking.",
)
@click.option(
    "--bound",
    multiple=True,
    metavar="KEY=LOW..HIGH",
    help="A tighter bound: a decision parameter outside it is moved to its nearest end.",
)
@json_option
@guarded
def contest(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    added: tuple[Path, ...],
    truth: tuple[str, ...],
    bound: tuple[str, ...],
    json_path: str | None,
) -> int:
    """Rerun the suite under a challenge and show what it changes.

    Before is the configuration as it is (-c) on the suite as it is; after is with --set, --bound,
    --truth and --scenario. Needs no camera, no model and no access to the pole.
    """
    from bikeped.lab.governance import what_if
    from bikeped.lab.scenarios.scenario import load_scenario
    from bikeped.lab.simulation.suite import DEFAULT_GROUND_TRUTH

    if not (overrides or added or truth or bound):
        raise BikepedError(
            "contest: nothing is contested; give --scenario FILE, --set decision.KEY=VALUE, "
            "--truth KEY=VALUE or --bound KEY=LOW..HIGH"
        )
    loaded = load_config(config_path)
    other = load_config(config_path, overrides)
    before = load_suite(loaded, scenarios_dir)
    # Another camera sees otherwise; with the same one, what was seen is not computed again.
    same_camera = not _split(overrides)[0]
    after = before if same_camera else load_suite(other, scenarios_dir)
    if added:
        after = what_if.with_scenarios(after, [load_scenario(path) for path in added])
    if truth:
        after = after.with_truth(what_if.parse_truth(DEFAULT_GROUND_TRUTH, truth))
    decision = what_if.apply_bounds(other.config.decision, bound)
    found = what_if.compare_variants(before, loaded.config.decision, after, decision)
    command = _command_line(config_path, overrides, scenarios_dir, added, truth, bound)
    if json_path is not None:
        write_json({"command": command, **found.as_dict()}, json_path)
    print_contest(found.as_dict(), command, json_path)
    return 0


@click.command("register")
@config_options
@scenarios_option
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.md",
    help="Write the register as Markdown.",
)
@json_option
@guarded
def register(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    out: Path | None,
    json_path: str | None,
) -> int:
    """Write the residual-risk register of the configuration's decision."""
    from bikeped.lab.governance.register import build_register

    loaded = load_config(config_path, overrides)
    found = build_register(load_suite(loaded, scenarios_dir), loaded.config.decision)
    if json_path is not None:
        write_json({"config_hash": loaded.hash, **found.as_dict()}, json_path)
    if out is not None:
        write_whole(out, found.markdown())
    print_register(found.as_dict(), json_path)
    return 0


@click.command("plot")
@config_options
@scenarios_option
@click.option("--scenario", "name", metavar="NAME", help="Only this scenario.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="Folder for the pictures; it is made.",
)
@json_option
@guarded
def plot(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    name: str | None,
    out: Path,
    json_path: str | None,
) -> int:
    """Draw each scenario: a strip over time and a plan from above."""
    from bikeped.lab.experiments.scenario_plan import draw_plan
    from bikeped.lab.experiments.strip_chart import draw_strip

    require("matplotlib")
    loaded = load_config(config_path, overrides)
    suite = load_suite(loaded, scenarios_dir)
    if name is not None and name not in suite.names:
        import difflib

        near = difflib.get_close_matches(name, suite.names, 1)
        mend = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(suite.names)}"
        raise BikepedError(f"--scenario {name}: no scenario of this name; {mend}")
    indices = [i for i, n in enumerate(suite.names) if name is None or n == name]
    make_folder(out)
    files: list[Path] = []
    with progress_bar("drawing", len(indices)) as tell:
        for done, index in enumerate(indices, 1):
            files += draw_strip(suite, loaded.config.decision, index, out)
            files += draw_plan(suite, loaded.config.decision, index, out)
            tell(done)
    if json_path is not None:
        write_json({"files": [str(path) for path in files]}, json_path)
    console(json_path).print(f"{len(files)} files of {count(len(indices))} in {escape(str(out))}")
    return 0


def _split(overrides: tuple[str, ...]) -> tuple[list[str], list[str]]:
    """Overrides of the camera and the rest, and those of the decision."""
    own = [o for o in overrides if o.strip().startswith("decision.")]
    return [o for o in overrides if o not in own], own


def _command_line(
    config_path: Path | None,
    overrides: tuple[str, ...],
    scenarios_dir: Path | None,
    added: tuple[Path, ...],
    truth: tuple[str, ...],
    bound: tuple[str, ...],
) -> str:
    """What somebody else types to get the same."""
    words = ["bikeped", "conformance", "contest"]
    words += ["-c", str(config_path)] if config_path is not None else []
    words += ["--scenarios", str(scenarios_dir)] if scenarios_dir is not None else []
    for flag, values in (
        ("--scenario", added),
        ("--set", overrides),
        ("--truth", truth),
        ("--bound", bound),
    ):
        for value in values:
            words += [flag, str(value)]
    return shlex.join(words)
