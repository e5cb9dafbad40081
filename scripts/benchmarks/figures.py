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
        self.rows.append(
            {
                "what": what,
                "ours": ours,
                "obvious": obvious,
                "unit": unit,
                "ratio": ratio,
                "goal": goal,
            }
        )
        shown = f"{obvious:12.3f}" if obvious is not None else " " * 12
        share = f"{ratio:8.3f}" if ratio is not None else " " * 8
        print(f"{what:<62}{ours:12.3f}{shown}{share}  {unit:<9}{goal}", flush=True)


def in_turns(
    ours: Callable[[], object], obvious: Callable[[], object], runs: int = 7
) -> tuple[float, float]:
    """Median seconds of both, measured in turns after one warm-up each."""
    ours()
    obvious()
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(runs):
        for way, kept in ((ours, times[0]), (obvious, times[1])):
            began = time.perf_counter()
            way()
            kept.append(time.perf_counter() - began)
    return statistics.median(times[0]), statistics.median(times[1])
