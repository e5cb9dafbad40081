"""Predictive beside the paper's rule, on own scenarios, random encounters and real traffic.

The four conditions of scripts/baselines.py; same detections, tracker, window and hold for both. As
Markdown: the tables of docs/rule.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from baselines import RECORDED, ROOT, SCRIPTED

from bikeped.config.load import load_config
from bikeped.lab.scenarios.random_encounters import random_encounters
from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
from bikeped.lab.simulation.light_record import light_figures
from bikeped.lab.simulation.suite import CONFIGURATIONS
from bikeped.lab.traffic.readers import read_traffic
from bikeped.lab.traffic.suite import TrafficSuite

RULES = ("selected", "predictive")
COLUMNS = {
    "sens, %": "sensitivity",
    "spec, %": "specificity",
    "contact, %": "contact_sensitivity",
    "SevFN, %": "sev_fn",
    "lead, s": "first_onset_lead_s",
    "alerts/h": "alerts_per_hour",
    "with danger, %": "alerts_with_danger",
    "red, %": "red_share",
    "fair missed": "fair_missed",
    "fair late": "fair_late",
}


def cell(column: str, value: Any) -> str:
    """A figure as its column's name asks for it."""
    if value is None:
        return "-"
    if column.endswith("%"):
        return f"{100 * value:.1f}"
    return f"{value:.2f}" if column.endswith(" s") else f"{value:.0f}"


def rows(suite: TrafficSuite, condition: str) -> list[str]:
    """The rules and foresight under one condition, as lines of a table."""
    lights = {name: suite.lights(CONFIGURATIONS[name]) for name in RULES}
    lights["foresight"] = suite.foresight(CONFIGURATIONS["predictive"])
    lines = []
    for name, found in lights.items():
        figures = light_figures(found)
        cells = [cell(column, figures[key]) for column, key in COLUMNS.items()]
        lines.append(f"| {' | '.join([condition, name, *cells])} |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seed", type=int, nargs="+", default=[0, 7], help="of the encounters")
    parser.add_argument("--traffic", type=Path, default=ROOT.parent / "shared" / "traffic")
    options = parser.parse_args()
    loaded = load_config(ROOT / "config.yaml")
    own = load_scenarios(bundled_folder())
    sources = {"The 24 scenarios": (TrafficSuite.of_scenarios(own, loaded, "none", 0), SCRIPTED)}
    for seed in options.seed:
        encounters = TrafficSuite.of_scenarios(random_encounters(seed, 200), loaded, "none", 0)
        sources[f"200 random encounters, seed {seed}"] = encounters, SCRIPTED
    if options.traffic.is_dir():
        scenes = read_traffic(options.traffic)
        title = f"Real traffic, {len(scenes)} scenes"
        sources[title] = TrafficSuite.load(scenes, loaded, "none", 0), RECORDED
    for title, (suite, conditions) in sources.items():
        head = ["condition", "rule", *COLUMNS]
        lines = [f"### {title}", "", f"| {' | '.join(head)} |", "| --- " * len(head) + "|"]
        for condition, (noise, delay_frames) in conditions.items():
            lines += rows(suite.with_noise(noise, 0, delay_frames), condition)
        sys.stdout.write("\n".join([*lines, "", ""]))


if __name__ == "__main__":
    main()
