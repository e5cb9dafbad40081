"""The console output of `bikeped calibrate`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bikeped.cli.common import text_table
from bikeped.lab.calibration.report.results import MODEL_COLUMNS, CalibrationResult, model_row
from bikeped.lab.calibration.solver.lens_model import CornerObservations
from bikeped.lab.calibration.solver.model_comparison import paper_criterion

_MOST_NAMED = 8


def print_result(screen: Console, result: CalibrationResult, compare: bool) -> None:
    """Boards, models, the recommendation, and cautions."""
    prepared, chosen = result.comparison.prepared, result.chosen
    observations = prepared.observations
    size = f"{observations.width} x {observations.height}"
    where = (
        f"pictures of {size}, taken as they are"
        if result.framing is None
        else f"in the {size} crop"
    )
    corners = int(observations.visible.sum())
    lines = [
        f"{len(observations)} of {prepared.images} boards, {corners} corners, {where}",
        *partial_board_lines(observations),
        *_first(
            (f"  not used: {_name(r.file)}: {escape(r.reason)}" for r in prepared.refused),
            "more (--json, --report)",
        ),
        *_first(
            (
                f"  left out: corner {c.corner} of {_name(c.file)}, {c.off_px:.1f} px off"
                for c in prepared.outliers
            ),
            "more corners",
        ),
    ]
    for line in lines:
        screen.print(line)
    screen.print(_table(result))
    if compare:
        screen.print(f"recommended: {result.recommendation.reason}")
        screen.print(paper_criterion(result.comparison))
    k = chosen.state.terms[: chosen.model.terms]
    terms = "".join(f", k{n + 1} = {value:.6g}" for n, value in enumerate(k))
    screen.print(f"{chosen.name}{terms}")
    screen.print(
        f"field of view {result.field.fov_deg:.1f} degrees; ends at {result.field.ends_at}"
    )
    for caution in result.cautions:
        screen.print(f"caution: {escape(caution)}")


def partial_board_lines(observations: CornerObservations) -> list[str]:
    """A line for each board of which some corners are not used, the emptiest first."""
    whole, counts = observations.pattern.count, observations.visible.sum(1)
    rows = [int(row) for row in np.argsort(counts, kind="stable") if counts[row] < whole]
    return _first(
        (
            f"  in part: {_name(observations.names[n])}, {counts[n]} of {whole} corners"
            for n in rows
        ),
        "more boards in part (--json, --report)",
    )


def _first(lines: Iterable[str], what: str) -> list[str]:
    """The first few lines, and one that counts the others."""
    every = list(lines)
    more = len(every) - _MOST_NAMED
    return every[:_MOST_NAMED] + ([f"  and {more} {what}"] if more > 0 else [])


def _name(file: str) -> str:
    return escape(Path(file).name)


def _table(result: CalibrationResult) -> Table:
    fits, folds = result.comparison.ranked, result.comparison.folds
    every_image = folds == len(result.comparison.prepared.observations)
    how = (
        "each picture from all others" if every_image else f"each of {folds} folds from the others"
    )
    rows = [model_row(fit) for fit in fits]
    return text_table(
        MODEL_COLUMNS,
        [(f"{row[0]} *" if row[0] == result.chosen.name else row[0], *row[1:]) for row in rows],
        title=f"error in px; cross-validated: {how}",
        note="* goes into the calibration file" if len(fits) > 1 else "",
    )
