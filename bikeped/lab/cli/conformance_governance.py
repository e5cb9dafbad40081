"""`bikeped conformance gate|promote|contest|register|plot`: governance of the decision rule."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.markup import escape
from rich.text import Text

from bikeped.cli.common import progress_bar, text_table
from bikeped.config.load import load_decision
from bikeped.errors import BikepedError, ConfigError, require
from bikeped.files import make_folder, write_whole
from bikeped.lab.cli.conformance_shared import SuiteRun, suite_options

if TYPE_CHECKING:
    from rich.console import Console

    from bikeped.config.schema import DecisionConfig
    from bikeped.lab.governance.gates import Gate

candidate_argument = click.argument("candidate", type=click.Path(path_type=Path))


traffic_option = click.option(
    "--traffic",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Scenes of your own, as `conformance traffic` reads them, for the nuisance gate, too.",
)


@click.command("gate")
@candidate_argument
@suite_options
@traffic_option
def gate(run: SuiteRun, candidate: Path, traffic: Path | None) -> int:
    """Check the deployment gates for the decision section of CANDIDATE: the paper's (sensitivity,
    specificity, warning budget) and nuisance (red and alerts beside a light that knows danger).

    The camera is that of the configuration (-c). Exit status 1 when a gate does not hold.
    """
    from bikeped.config.provenance import decision_hash
    from bikeped.lab.governance.gates import all_hold, check_gates
    from bikeped.lab.governance.nuisance import grouped, nuisance_gates

    run, decision = _candidate(run, candidate)
    metrics = run.suite.measure(decision)
    nuisance = nuisance_gates(run.loaded, decision, run.tracker, traffic)
    gates = [*check_gates(metrics), *nuisance]
    run.write_json(
        {
            "candidate": str(candidate),
            "decision_hash": decision_hash(decision),
            "config_hash": run.loaded.hash,
            "calibration_hash": run.loaded.calibration_hash,
            "suite_hash": run.suite.hash,
            "scenarios": len(run.suite.scenarios),
            "gates": [g.as_dict() for g in gates],
            "holds": all_hold(gates),
            "holds_by_kind": grouped(gates),
            "tracker": run.tracker,
            "metrics": metrics.as_dict(),
        }
    )
    print_gates(f"{candidate} on {count(len(run.suite.scenarios))}", gates, run.console)
    return 0 if all_hold(gates) else 1


@click.command("promote")
@candidate_argument
@suite_options
@click.option(
    "--trace",
    type=click.Path(path_type=Path),
    help="The optimiser's JSON that the candidate came from; its hash is recorded.",
)
@traffic_option
def promote(run: SuiteRun, candidate: Path, trace: Path | None, traffic: Path | None) -> int:
    """Write the decision section of CANDIDATE into the configuration file, if all gates hold.

    The previous file stays as FILE.bak. FILE.provenance.json records what the section rests on;
    `bikeped run` checks it. When a gate does not hold, nothing is written and the exit status is 1.
    """
    from bikeped.lab.governance.gates import all_hold, check_gates, provenance_record
    from bikeped.lab.governance.gates import promote as write
    from bikeped.lab.governance.nuisance import nuisance_gates

    path = run.config_path or Path("config.yaml")
    run, decision = _candidate(replace(run, config_path=path), candidate, camera_options=False)
    suite, loaded = run.suite, run.loaded
    metrics = suite.measure(decision)
    nuisance = nuisance_gates(loaded, decision, run.tracker, traffic)
    gates = [*check_gates(metrics), *nuisance]
    files = [("candidate", candidate)] + ([("trace", trace)] if trace is not None else [])
    record = provenance_record(suite, decision, metrics, gates, loaded, files)
    print_gates(f"{candidate} on {count(len(suite.scenarios))}", gates, run.console)
    if not all_hold(gates):
        run.write_json({"promoted": False, **record})
        run.console.print("Refused: nothing was written.", style="bold")
        return 1
    written = write(path, loaded, decision, record)
    run.write_json({"promoted": True, **record})
    run.console.print(f"Promoted into {escape(str(path))}; restart the service to apply it.")
    run.console.print(
        f"Before: {escape(written.backup.name)}; provenance: {escape(written.provenance.name)}"
    )
    return 0


@click.command("contest")
@suite_options
@click.option(
    "--scenario",
    "added",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Add a scenario, or replace the one with its name. May be repeated.",
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
    help="A tighter bound: a decision parameter outside it is moved to the nearest end.",
)
def contest(
    run: SuiteRun, added: tuple[Path, ...], truth: tuple[str, ...], bound: tuple[str, ...]
) -> int:
    """What-if comparison: rerun the suite with other scenarios, parameters or thresholds, and show
    what changes.

    Before: the configuration (-c) on the suite. After: with --set, --bound, --truth and --scenario.
    Needs no camera, no detector and no access to the pole.
    """
    from bikeped.lab.governance import what_if
    from bikeped.lab.scenarios.scenario import load_scenario
    from bikeped.lab.simulation.suite import DEFAULT_GROUND_TRUTH

    if not (run.overrides or added or truth or bound):
        raise BikepedError(
            "contest: nothing is changed; give --scenario FILE, --set decision.KEY=VALUE, "
            "--truth KEY=VALUE or --bound KEY=LOW..HIGH"
        )
    base = replace(run, overrides=())
    before, changed = base.suite, run.loaded
    # With the same camera, perception is not computed again.
    after = before if not _split(run.overrides)[0] else run.suite
    if added:
        after = what_if.with_scenarios(after, [load_scenario(path) for path in added])
    if truth:
        after = after.with_truth(what_if.parse_truth(DEFAULT_GROUND_TRUTH, truth))
    decision = what_if.apply_bounds(changed.config.decision, bound)
    found = what_if.compare_variants(before, base.decision, after, decision).as_dict()
    options = {"--scenario": added, "--set": run.overrides, "--truth": truth, "--bound": bound}
    words = ["bikeped", "conformance", "contest"]
    words += ["-c", str(run.config_path)] if run.config_path is not None else []
    words += ["--scenarios", str(run.scenarios_dir)] if run.scenarios_dir is not None else []
    words += [str(word) for flag, values in options.items() for v in values for word in (flag, v)]
    command = shlex.join(words)
    run.write_json({"command": command, **found})
    print_comparison(found, command, run.console)
    return 0


@click.command("register")
@suite_options
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.md",
    help="Write the register as Markdown.",
)
def register(run: SuiteRun, out: Path | None) -> int:
    """Residual-risk register of the configured decision: hazards, coverage, measured results."""
    from bikeped.lab.governance.register import build_register

    found = build_register(run.suite, run.decision)
    run.write_json({"config_hash": run.loaded.hash, **found.as_dict()})
    if out is not None:
        write_whole(out, found.markdown())
    print_register(found.as_dict(), run.console)
    return 0


@click.command("plot")
@suite_options
@click.option("--scenario", "name", metavar="NAME", help="Only this scenario.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="Folder for the figures; created if needed.",
)
def plot(run: SuiteRun, name: str | None, out: Path) -> int:
    """Draw each scenario as two figures: a strip chart over time and a plan from above."""
    require("matplotlib")
    from bikeped.lab.experiments.deterministic import select_scenario
    from bikeped.lab.experiments.scenario_figures import draw_plan, draw_strip

    suite = run.suite if name is None else select_scenario(run.suite, name)
    make_folder(out)
    files: list[Path] = []
    with progress_bar("drawing", len(suite.scenarios)) as progress:
        for index in range(len(suite.scenarios)):
            files += draw_strip(suite, run.decision, index, out)
            files += draw_plan(suite, run.decision, index, out)
            progress(index + 1)
    run.write_json({"files": [str(path) for path in files]})
    drawn = count(len(suite.scenarios))
    run.console.print(f"{len(files)} files of {drawn} in {escape(str(out))}")
    return 0


def _split(overrides: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Overrides of the camera and the rest, and those of the decision."""
    own = tuple(o for o in overrides if o.strip().startswith("decision."))
    return tuple(o for o in overrides if o not in own), own


def _candidate(
    run: SuiteRun, candidate: Path, camera_options: bool = True
) -> tuple[SuiteRun, DecisionConfig]:
    """The run without `--set decision.KEY=VALUE`, and the candidate's decision with it."""
    rest, own = _split(run.overrides)
    if rest and not camera_options:
        raise ConfigError(
            f"--set {rest[0]}: promote measures with the camera that the file names; change it "
            "there (--set decision.KEY=VALUE changes the candidate)"
        )
    return replace(run, overrides=rest), load_decision(candidate, own)


_TOTALS = (
    ("Sensitivity", "sensitivity", "%"),
    ("Specificity", "specificity", "%"),
    ("SevFN", "sev_fn", "%"),
    ("Fatigue", "fatigue", "%"),
    ("Contact sensitivity", "contact_sensitivity", "%"),
    ("Mean warning budget", "mean_warning_budget_s", "s"),
)


def count(scenarios: int) -> str:
    """A number of scenarios in words."""
    return f"{scenarios} scenario{'' if scenarios == 1 else 's'}"


def print_gates(title: str, gates: list[Gate], out: Console) -> None:
    """Required and measured, and in one line what fails."""
    rows = [
        (
            g.kind,
            g.name,
            g.rule,
            g.format_value(g.measured),
            "yes" if g.holds else Text("NO", style="bold"),
        )
        for g in gates
    ]
    columns = ("Kind", "Gate", "Required", "Measured", "Holds")
    out.print(text_table(columns, rows, align="lllll", title=title))
    failed = [
        f"{g.name.lower()} {g.format_value(g.measured)}, required {g.rule}"
        for g in gates
        if not g.holds
    ]
    out.print("Fails: " + "; ".join(failed) if failed else "All gates hold.")


def print_register(data: dict[str, Any], out: Console) -> None:
    """The register in short; the reasons are in the Markdown and the JSON."""
    hazards = [(h["hazard"], h["coverage"], h["field_blocking"]) for h in data["hazards"]]
    columns: tuple[str, ...] = ("Failure mode", "Simulated", "Field-blocking")
    out.print(text_table(columns, hazards, align="lll", title="Residual risks"))
    scenarios = [
        (
            row["scenario"],
            *(_number(row[key], "%") for key in ("sensitivity", "specificity", "sev_fn")),
            _number(row["min_warning_budget_s"], "s"),
            row["remark"],
        )
        for row in data["scenarios"]
    ]
    columns = ("Scenario", "Sens. %", "Spec. %", "SevFN %", "Budget s", "Remark")
    out.print(text_table(columns, scenarios, align="lrrrrl", title="Scenarios"))


def print_comparison(data: dict[str, Any], command: str, out: Console) -> None:
    """Totals, what changed by scenario, and the command line that repeats it."""
    sides = before, after = data["before"], data["after"]
    rows = []
    for label, key, unit in _TOTALS:
        values = (side["totals"][key] for side in sides)
        rows.append((label, *("-" if v is None else f"{_number(v, unit)} {unit}" for v in values)))
    failed = [", ".join(g["name"].lower() for g in s["gates"] if not g["holds"]) for s in sides]
    rows.append(("Gates", *(f"fails: {names}" if names else "all hold" for names in failed)))
    out.print(text_table(("Figure", "Before", "After"), rows, title="Totals"))
    changed = data["changed"]
    if changed:
        columns = ("Scenario", "State", "Truth", "ALERT %", "Sens. %", "SevFN %", "Min budget s")
        rows = [_changed_row(entry, before, after) for entry in changed]
        out.print(text_table(columns, rows, title="What changed, before > after"))
    same = len(after["by_scenario"]) - len(changed)
    out.print(f"Changed: {count(len(changed))}; as before: {count(same)}.")
    out.print(f"To repeat: {escape(command)}")


def _changed_row(
    entry: dict[str, Any], before: dict[str, Any], after: dict[str, Any]
) -> tuple[str, ...]:
    """Frames whose state and whose truth changed, and figures before and after."""
    name = entry["scenario"]
    sides = [s["by_scenario"][name] for s in (before, after) if name in s["by_scenario"]]
    if "frames_state" in entry:
        frames = str(entry["frames_state"]), str(entry["frames_truth"])
    else:
        frames = entry["what"].removesuffix(" scenario"), ""
    figures = (
        [(side["states"]["ALERT"], "%") for side in sides],
        *(
            [(side[key], unit) for side in sides]
            for key, unit in (("sensitivity", "%"), ("sev_fn", "%"), ("min_warning_budget_s", "s"))
        ),
    )
    return name, *frames, *(" > ".join(_number(v, unit) for v, unit in part) for part in figures)


def _number(value: float | None, unit: str) -> str:
    """A share in per cent or seconds, without the unit; a dash where there is none."""
    if value is None:
        return "-"
    return f"{100 * value:.1f}" if unit == "%" else f"{value:.2f}"
