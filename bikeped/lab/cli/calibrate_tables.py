"""What `bikeped calibrate` says to people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bikeped.lab.calibration.solver.compare import paper_criterion
from bikeped.lab.calibration.solver.lens_fit import Fit
from bikeped.lab.calibration.solver.lens_model import Sightings
from bikeped.lab.cli.calibrate_run import Done

_MOST_NAMED = 8


def print_result(screen: Console, done: Done) -> None:
    """Boards, models, the choice, and what to mind."""
    calibrated, prepared = done.calibrated, done.calibrated.prepared
    sightings = prepared.sightings
    where = (
        f"in the {sightings.width} x {sightings.height} crop"
        if done.framing is not None
        else f"pictures of {sightings.width} x {sightings.height}, taken as they are"
    )
    screen.print(
        f"{len(sightings)} of {prepared.boards_total} boards, {int(sightings.seen.sum())} corners, "
        f"{where}"
    )
    for line in in_part(sightings):
        screen.print(line)
    for refused in calibrated.refused[:_MOST_NAMED]:
        screen.print(f"  not used: {escape(Path(refused.name).name)}: {escape(refused.why)}")
    if len(calibrated.refused) > _MOST_NAMED:
        screen.print(f"  and {len(calibrated.refused) - _MOST_NAMED} more (--json, --report)")
    for corner in calibrated.left_out[:_MOST_NAMED]:
        screen.print(
            f"  left out: corner {corner.corner} of {escape(Path(corner.name).name)}, "
            f"{corner.off_px:.1f} px off"
        )
    if len(calibrated.left_out) > _MOST_NAMED:
        screen.print(f"  and {len(calibrated.left_out) - _MOST_NAMED} more corners")
    screen.print(_table(done))
    if done.asked.compare:
        screen.print(f"recommended: {done.recommendation.why}")
        screen.print(paper_criterion(calibrated))
    k = done.chosen.state.terms[: done.chosen.model.terms]
    terms = "".join(f", k{n + 1} = {value:.6g}" for n, value in enumerate(k))
    screen.print(f"{done.chosen.name}{terms}")
    screen.print(f"field of view {done.field.fov_deg:.1f} degrees; ends at {done.field.ends_at}")
    for caution in done.cautions:
        screen.print(f"mind: {escape(caution)}")


def in_part(sightings: Sightings) -> list[str]:
    """A line for each board of which some corners are not used, the emptiest first."""
    whole, counts = sightings.pattern.count, sightings.seen.sum(1)
    rows = [int(row) for row in np.argsort(counts, kind="stable") if counts[row] < whole]
    lines = [
        f"  in part: {escape(Path(sightings.names[row]).name)}, {counts[row]} of {whole} corners"
        for row in rows[:_MOST_NAMED]
    ]
    if len(rows) > _MOST_NAMED:
        lines.append(f"  and {len(rows) - _MOST_NAMED} more boards in part (--json, --report)")
    return lines


def _table(done: Done) -> Table:
    table = Table(
        title=f"error in px; cross-validated: {_dealt(done)}",
        title_justify="left",
        box=None,
        pad_edge=False,
    )
    table.add_column("model")
    for name in ("cross-validated", "RMS per point", "per coordinate", "f", "cx", "cy"):
        table.add_column(name, justify="right")
    for fit in sorted(done.calibrated.fits.values(), key=_error):
        held = fit.cross_validated_px
        sigma = fit.uncertainty
        mark = " *" if fit is done.chosen else ""
        table.add_row(
            fit.name + mark,
            "-" if held is None else f"{held:.4f}",
            f"{fit.rms_px:.4f}",
            f"{fit.rms_per_coordinate_px:.4f}",
            f"{fit.focal_px:.3f} ± {sigma['f']:.3f}",
            f"{fit.cx:.2f} ± {sigma['cx']:.2f}",
            f"{fit.cy:.2f} ± {sigma['cy']:.2f}",
        )
    if len(done.calibrated.fits) > 1:
        table.caption = "* goes into the calibration file"
        table.caption_justify = "left"
    return table


def _dealt(done: Done) -> str:
    folds = done.calibrated.folds
    if folds == len(done.calibrated.prepared.sightings):
        return "each picture from all others"
    return f"each of {folds} folds from the others"


def _error(fit: Fit) -> float:
    return fit.cross_validated_px or fit.rms_px
