"""All figures of a set of experiments, each with its caption and what it says in plain words."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bikeped.errors import BikepedError, require
from bikeped.lab.experiments import figure_areas, figure_lines
from bikeped.lab.simulation.suite import Suite

Draw = Callable[[Mapping[str, Any], str, str, Path], list[Path]]


@dataclass(frozen=True)
class FigureText:
    """Words of a figure: `caption` is printed on it, `explained` are two sentences for the report.

    `experiment` names the data that it is drawn from, `needs` the key in them that it shows.
    """

    experiment: str
    needs: str
    title: str
    caption: str
    explained: str


#: By file name without ending, in the order of the report.
FIGURES: dict[str, FigureText] = {
    "compare": FigureText(
        "compare",
        "configurations",
        "Which configuration finds danger, and which cries wolf?",
        "Up: more of the actionable danger is answered with an alert. Right: fewer alerts "
        "without danger. Filled marks include the camera's localisation error.",
        "Each mark is one way to set up the decision: the further up, the more danger it "
        "answers, the further right, the less often it alerts for nothing. Only what lies in "
        "the grey corner passes the two gates that a deployment needs.",
    ),
    "budgets": FigureText(
        "budgets",
        "rows",
        "How much time does an alert leave?",
        "Bars: mean over a scenario's alerts. Ticks: each alert. Colour and hatching go by a "
        "scenario's worst alert.",
        "From the moment of the alert to the moment at which cyclist and pedestrian are "
        "nearest, compared with how long people take to react. A hatched bar holds at least one"
        " alert that leaves a distracted person too little time.",
    ),
    "latency": FigureText(
        "latency",
        "delay_ms",
        "What does a slow camera cost?",
        "The later the picture, the later the alert. Prediction moves positions ahead by the "
        "known delay.",
        "Every camera delivers its pictures late, and what it shows has moved on meanwhile. The"
        " curves show what this costs, and whether predicting where people are by now makes up "
        "for it.",
    ),
    "loss_latency": FigureText(
        "loss_latency",
        "predictors",
        "A slow camera that also misses people",
        "Late pictures and missed detections together. Bands: 95 % confidence interval of the "
        "mean over random trials.",
        "As before, but the detector also misses people at random, as real ones do. Where the "
        "bands of two predictors overlap, their difference may be chance.",
    ),
    "montecarlo": FigureText(
        "montecarlo",
        "rows",
        "How well does it do when the detector misses people?",
        "Mean over random trials with its 95 % confidence interval. Bursts: misses come several"
        " frames in a row.",
        "Detectors miss people; here each person is missed at random as often as was measured, "
        "either frame by frame or several frames in a row. Whiskers show how sure the mean is.",
    ),
    "truth": FigureText(
        "truth",
        "rows",
        "Do the results hang on where we draw the line?",
        "One threshold of the definition of danger is varied at a time; filled marks are the "
        "default. SevFN: share of missed danger, weighted by the cyclist's energy.",
        "What counts as danger is a choice, and these are its three thresholds, each moved in "
        "turn. If the marks of a group lie close together, the result does not hang on that "
        "choice.",
    ),
    "braking": FigureText(
        "braking",
        "rows",
        "Do the results hang on how cyclists brake?",
        "The same decisions, judged as if every cyclist braked in one way (reaction time, "
        "deceleration).",
        "How soon a cyclist can stop decides what counts as danger. The bars repeat the "
        "judgement with other reaction times and brakes; the decisions themselves stay the "
        "same.",
    ),
    "errors": FigureText(
        "errors",
        "table",
        "How far off is a position?",
        "Distance between where an object stands and where the camera puts it, by how far it is"
        " and how far it is aside of the camera's axis.",
        "The camera takes the middle of a box's lower edge for the point where somebody stands,"
        " and that is a little wrong. Long objects at the edge of the view are off most.",
    ),
    "errors_map": FigureText(
        "errors",
        "map",
        "Where on the ground is a position off?",
        "Seen from above, camera at the black triangle looking up the page; objects lie across "
        "the view. Lines: 0.5, 1 and 2 m.",
        "The same error everywhere in front of the camera, out to the 25 m within which "
        "decisions are made. Dark is good: positions there are right to within a few "
        "decimetres.",
    ),
    "deployment": FigureText(
        "deployment",
        "rows",
        "One camera or two, on narrow and wide roads",
        "Mean sensitivity over random trials with its 95 % confidence interval; black dashes: "
        "the same if whoever no camera can see is never detected.",
        "A second camera on the other side sees whom the first one misses. Bars compare the two"
        " for usual road widths and two ways to mount a camera.",
    ),
    "placement": FigureText(
        "placement",
        "sensitivity",
        "How high to mount the camera, and how steep?",
        "Mean sensitivity on a 40 ft road for every height and pitch; brighter is better.",
        "Each cell is one way to mount the camera. Where two maps are shown and the right one "
        "is darker, the mount looks good on the left only because people were detected whom the"
        " camera cannot see.",
    ),
    "optimize": FigureText(
        "optimize",
        "trace",
        "How the parameters were found",
        "Best cost found so far; the cost weighs missed danger, false alerts, latency and fatigue.",
        "A search tries thousands of parameter sets and keeps the one of least cost on these "
        "scenarios. A curve that has been flat for long says that more search would hardly "
        "help.",
    ),
}
_DRAW: dict[str, Draw] = {
    "compare": figure_lines.compare,
    "budgets": figure_areas.budgets,
    "latency": figure_lines.latency,
    "loss_latency": figure_lines.loss_latency,
    "montecarlo": figure_lines.montecarlo,
    "truth": figure_lines.truth,
    "braking": figure_areas.braking,
    "errors": figure_lines.error_lines,
    "errors_map": figure_areas.error_map,
    "deployment": figure_areas.deployment,
    "placement": figure_areas.placement,
    "optimize": figure_lines.optimize,
}
#: Other names by which experiments may come.
_ALIASES = {"loss_latency": "latency_loss"}


def draw_all(data: Mapping[str, Mapping[str, Any]], suite: Suite, folder: Path) -> list[Path]:
    """Draws every figure whose experiment is in `data` into `folder`, as PNG and PDF.

    The same data give the same bytes. BikepedError when matplotlib is not installed or a file
    cannot be written.
    """
    require("matplotlib")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BikepedError(
            f"{folder}: cannot be made ({error.strerror}); choose another folder"
        ) from error
    paths: list[Path] = []
    for stem, text in FIGURES.items():
        found = data.get(text.experiment, data.get(_ALIASES.get(text.experiment, "")))
        if not found or not found.get(text.needs):
            continue
        caption = f"{text.caption} On {len(suite.scenarios)} scenarios."
        if text.experiment in ("errors", "deployment", "placement"):
            caption = text.caption  # made with single objects or roads of their own
        paths += _DRAW[stem](found, text.title, caption, folder)
    return paths
