"""Tables of the governance commands for people; the same is in their JSON for machines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

if TYPE_CHECKING:
    from bikeped.lab.governance.gates import Gate


def count(scenarios: int) -> str:
    """A number of scenarios in words."""
    return f"{scenarios} scenario{'' if scenarios == 1 else 's'}"


def print_gates(title: str, gates: list[Gate], out: Console) -> None:
    """Required and measured, and in one line what fails."""
    table = RichTable(title=escape(title), title_justify="left")
    for column in ("Gate", "Required", "Measured", "Holds"):
        table.add_column(column)
    for g in gates:
        table.add_row(
            g.name, g.rule, g.format_value(g.measured), "yes" if g.holds else "[bold]NO[/bold]"
        )
    out.print(table)
    failed = [
        f"{g.name.lower()} {g.format_value(g.measured)}, required {g.rule}"
        for g in gates
        if not g.holds
    ]
    out.print("Fails: " + "; ".join(failed) if failed else "All gates hold.")


def print_register(data: dict[str, Any], out: Console) -> None:
    """Short: the reasons are in the Markdown and the JSON."""
    table = RichTable(title="Residual risks", title_justify="left")
    for column in ("Failure mode", "Simulated", "Field-blocking"):
        table.add_column(column)
    for hazard in data["hazards"]:
        table.add_row(hazard["hazard"], hazard["coverage"], hazard["field_blocking"])
    out.print(table)
    table = RichTable(title="Scenarios", title_justify="left")
    for column in ("Scenario", "Sens. %", "Spec. %", "SevFN %", "Budget s", "Remark"):
        table.add_column(column, justify="left" if column in ("Scenario", "Remark") else "right")
    for row in data["scenarios"]:
        table.add_row(
            escape(row["scenario"]),
            *(_bare(row[k], "%") for k in ("sensitivity", "specificity", "sev_fn")),
            _bare(row["min_warning_budget_s"], "s"),
            escape(row["remark"]),
        )
    out.print(table)


def print_comparison(data: dict[str, Any], command: str, out: Console) -> None:
    """Totals, what changed by scenario, and the line that repeats it."""
    before, after = data["before"], data["after"]
    totals = RichTable(title="Totals", title_justify="left")
    for column in ("Figure", "Before", "After"):
        totals.add_column(column, justify="left" if column == "Figure" else "right")
    for label, key, unit in (
        ("Sensitivity", "sensitivity", "%"),
        ("Specificity", "specificity", "%"),
        ("SevFN", "sev_fn", "%"),
        ("Fatigue", "fatigue", "%"),
        ("Contact sensitivity", "contact_sensitivity", "%"),
        ("Mean warning budget", "mean_warning_budget_s", "s"),
    ):
        totals.add_row(label, *(_figure(side["totals"][key], unit) for side in (before, after)))
    gates = [
        ", ".join(g["name"].lower() for g in s["gates"] if not g["holds"]) for s in (before, after)
    ]
    totals.add_row("Gates", *("all hold" if not g else f"fails: {g}" for g in gates))
    out.print(totals)
    changed = {c["scenario"]: c for c in data["changed"]}
    if changed:
        out.print(_changed_table(before, after, changed))
    same = len(after["by_scenario"]) - len(changed)
    out.print(f"Changed: {count(len(changed))}; as before: {count(same)}.")
    out.print(f"To repeat: {escape(command)}")


def _changed_table(
    before: dict[str, Any], after: dict[str, Any], changed: dict[str, dict[str, Any]]
) -> RichTable:
    """By scenario: frames whose state and whose truth changed, and figures before and after."""
    table = RichTable(title="What changed, before > after", title_justify="left")
    for column in ("Scenario", "State", "Truth", "ALERT %", "Sens. %", "SevFN %", "Min budget s"):
        table.add_column(column, justify="left" if column == "Scenario" else "right")
    for name, entry in changed.items():
        sides = [s["by_scenario"][name] for s in (before, after) if name in s["by_scenario"]]
        figures = [" > ".join(_bare(s["states"]["ALERT"], "%") for s in sides)]
        for key, unit in (("sensitivity", "%"), ("sev_fn", "%"), ("min_warning_budget_s", "s")):
            figures.append(" > ".join(_bare(side[key], unit) for side in sides))
        if "frames_state" in entry:
            frames = [str(entry["frames_state"]), str(entry["frames_truth"])]
        else:
            frames = [entry["what"].removesuffix(" scenario"), ""]
        table.add_row(escape(name), *frames, *figures)
    return table


def _bare(value: float | None, unit: str) -> str:
    if value is None:
        return "-"
    return f"{100 * value:.1f}" if unit == "%" else f"{value:.2f}"


def _figure(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{_bare(value, unit)} {unit}"
