"""What every benchmark measures with: rows of figures, and two ways that take turns."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Figures:
    """Rows of one benchmark: what, ours, the obvious way, unit, goal."""

    rows: list[dict[str, Any]] = field(default_factory=list)

    def add(self, what: str, ours: float, obvious: float | None, unit: str, goal: str = "") -> None:
        """One row; the ratio is ours over the obvious."""
        ratio = ours / obvious if obvious else None
        row = {"what": what, "ours": ours, "obvious": obvious}
        self.rows.append(row | {"unit": unit, "ratio": ratio, "goal": goal})
        shown = f"{obvious:12.3f}" if obvious is not None else " " * 12
        share = f"{ratio:8.3f}" if ratio is not None else " " * 8
        print(f"{what:<62}{ours:12.3f}{shown}{share}  {unit:<9}{goal}", flush=True)


def in_turns(
    ours: Callable[[], object], obvious: Callable[[], object], runs: int = 7
) -> tuple[float, float]:
    """Median seconds of both, measured in turns after one warm-up each."""
    ours()
    obvious()
    times = [(seconds(ours), seconds(obvious)) for _ in range(runs)]
    return statistics.median(a for a, _ in times), statistics.median(b for _, b in times)


def median_s(work: Callable[[], object], runs: int) -> float:
    """Median seconds after one warm-up (none for a single run, which takes seconds)."""
    if runs > 1:
        work()
    return statistics.median(seconds(work) for _ in range(runs))


def seconds(work: Callable[[], object]) -> float:
    """How long it takes."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
