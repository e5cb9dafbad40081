"""All figures of the experiments, each with its caption and a plain explanation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bikeped.errors import require
from bikeped.files import make_folder
from bikeped.lab.experiments import figure_areas, figure_lines
from bikeped.lab.simulation.suite import Suite

Draw = Callable[[Mapping[str, Any], str, str, Path], list[Path]]


@dataclass(frozen=True)
class ReportFigure:
    """One figure and its texts: `caption` is printed on it, `explained` is for the report.

    `experiment` names the data that it is drawn from, `needs` the key in them that it shows.
    """

    draw: Draw
    experiment: str
    needs: str
    title: str
    caption: str
    explained: str


#: By file stem, in the order of the report.
FIGURES: dict[str, ReportFigure] = {
    "compare": ReportFigure(
        figure_lines.compare,
        "compare",
        "configurations",
        "Which configuration detects danger, and which alerts without danger?",
        "Up: more of the actionable danger is answered with an alert. Right: fewer alerts "
        "without danger. Filled marks include the camera's localisation error.",
        "Each mark is one way to set up the decision: the further up, the more danger it "
        "answers, the further right, the less often it alerts for nothing. Only what lies in "
        "the grey corner passes the two gates that a deployment needs.",
    ),
    "budgets": ReportFigure(
        figure_areas.budgets,
        "budgets",
        "rows",
        "How much time does an alert leave?",
        "Bars: mean over a scenario's alerts. Ticks: each alert. Colour and hatching go by a "
        "scenario's worst alert.",
        "From the moment of the alert to the moment at which cyclist and pedestrian are "
        "nearest, compared with how long people take to react. A hatched bar holds at least one"
        " alert that leaves a distracted person too little time.",
    ),
    "latency": ReportFigure(
        figure_lines.latency,
        "latency",
        "delay_ms",
        "What does a slow camera cost?",
        "The later the picture, the later the alert. Prediction moves positions ahead by the "
        "known delay.",
        "Every camera delivers its pictures late, and what it shows has moved on meanwhile. The"
        " curves show what this costs, and whether predicting where people are by now makes up "
        "for it.",
    ),
    "loss_latency": ReportFigure(
        figure_lines.loss_latency,
        "latency_loss",
        "predictors",
        "A slow camera that also misses people",
        "Late pictures and missed detections together. Bands: 95 % confidence interval of the "
        "mean over random trials.",
        "As before, but the detector also misses people at random, as real ones do. Where the "
        "bands of two predictors overlap, their difference may be chance.",
    ),
    "montecarlo": ReportFigure(
        figure_lines.montecarlo,
        "montecarlo",
        "rows",
        "How well does it do when the detector misses people?",
        "Mean over random trials with its 95 % confidence interval. Bursts: misses come several"
        " frames in a row.",
        "Detectors miss people; here each person is missed at random as often as was measured, "
        "either frame by frame or several frames in a row. Whiskers show how sure the mean is.",
    ),
    "truth": ReportFigure(
        figure_lines.truth,
        "truth",
        "rows",
        "Do the results depend on the ground-truth thresholds?",
        "One threshold of the definition of danger is varied at a time; filled marks are the "
        "default. SevFN: share of missed danger, weighted by the cyclist's energy.",
        "What counts as danger is a choice, and these are its three thresholds, each moved in "
        "turn. If the marks of a group lie close together, the result does not depend on that "
        "choice.",
    ),
    "braking": ReportFigure(
        figure_areas.braking,
        "braking",
        "rows",
        "Do the results depend on how cyclists brake?",
        "The same decisions against ground truth in which every cyclist brakes in one way "
        "(reaction time, deceleration).",
        "How soon a cyclist can stop decides what counts as danger. The bars repeat the "
        "comparison with other reaction times and brakes; the decisions stay the same.",
    ),
    "errors": ReportFigure(
        figure_lines.error_lines,
        "errors",
        "table",
        "How far off is a position?",
        "Distance between where an object stands and where the camera puts it, by how far it is"
        " and how far it is aside of the camera's axis.",
        "The camera takes the middle of a box's lower edge for the point where a person stands,"
        " and that is a little wrong. Long objects at the edge of the view are off most.",
    ),
    "errors_map": ReportFigure(
        figure_areas.error_map,
        "errors",
        "map",
        "Where on the ground is a position off?",
        "Seen from above, camera at the black triangle looking up the page; objects lie across "
        "the view. Lines: 0.5, 1 and 2 m.",
        "The same error everywhere in front of the camera, out to the 25 m within which "
        "decisions are made. Dark is good: positions there are right to within a few "
        "decimetres.",
    ),
    "deployment": ReportFigure(
        figure_areas.deployment,
        "deployment",
        "rows",
        "One camera or two, on narrow and wide roads",
        "Mean sensitivity over random trials with its 95 % confidence interval; black dashes: "
        "the same if objects that no camera sees are never detected.",
        "A second camera on the other side sees whom the first one misses. Bars compare the two"
        " for usual road widths and two ways to mount a camera.",
    ),
    "placement": ReportFigure(
        figure_areas.placement,
        "placement",
        "sensitivity",
        "How high to mount the camera, and how steep?",
        "Mean sensitivity on a 40 ft road for every height and pitch; brighter is better.",
        "Each cell is one way to mount the camera. Where two maps are shown and the right one "
        "is darker, the mount looks good on the left only because people were detected whom the"
        " camera cannot see.",
    ),
    "optimize": ReportFigure(
        figure_lines.optimize,
        "optimize",
        "trace",
        "How the parameters were found",
        "Best cost found so far; the cost weighs missed danger, false alerts, latency and fatigue.",
        "A search tries thousands of parameter sets and keeps the one of least cost on these "
        "scenarios. A curve that has been flat for long says that more search would hardly "
        "help.",
    ),
}


def draw_all(data: Mapping[str, Mapping[str, Any]], suite: Suite, folder: Path) -> list[Path]:
    """Draws every figure whose experiment is in `data` into `folder`, as PNG and PDF.

    The same data give the same bytes. BikepedError when matplotlib is not installed or a file
    cannot be written.
    """
    require("matplotlib")
    make_folder(folder)
    paths: list[Path] = []
    for figure in FIGURES.values():
        found = data.get(figure.experiment)
        if not found or not found.get(figure.needs):
            continue
        caption = figure.caption
        # Those three have their own objects and roads.
        if figure.experiment not in ("errors", "deployment", "placement"):
            caption += f" On {len(suite.scenarios)} scenarios."
        paths += figure.draw(found, figure.title, caption, folder)
    return paths
