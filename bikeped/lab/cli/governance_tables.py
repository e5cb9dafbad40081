"""Console tables of the governance commands; their JSON holds the same."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.text import Text

from bikeped.cli.common import text_table

if TYPE_CHECKING:
    from rich.console import Console

    from bikeped.lab.governance.gates import Gate

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
        (g.name, g.rule, g.format_value(g.measured), "yes" if g.holds else Text("NO", style="bold"))
        for g in gates
    ]
    columns = ("Gate", "Required", "Measured", "Holds")
    out.print(text_table(columns, rows, align="llll", title=title))
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
