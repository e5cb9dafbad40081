"""Duration of each stage over the last frames, and percentiles."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from bikeped.types import FloatArray

#: The paper's stages in processing order; `total` is the processing time of a frame, `capture_age`
#: the time from capture to the light.
STAGES = (
    "acquire",
    "pre",
    "inference",
    "post",
    "track",
    "decide",
    "feedback",
    "total",
    "capture_age",
)

_INDEX = {stage: row for row, stage in enumerate(STAGES)}


class StageTimes:
    """The durations of the last `capacity` frames of each stage, in milliseconds.

    Ring buffers; percentiles are computed on request. For one thread.
    """

    def __init__(self, capacity: int = 900) -> None:
        if capacity < 1:
            raise ValueError(f"capacity: expected at least 1 frame, got {capacity}")
        self.capacity = capacity
        self._ring: FloatArray = np.zeros((len(STAGES), capacity))
        self._count = [0] * len(STAGES)

    def add(self, durations_ms: Mapping[str, float]) -> None:
        """Records one frame; NaN means not run. ValueError for a stage that is not in `STAGES`."""
        for stage, duration_ms in durations_ms.items():
            row = _INDEX.get(stage)
            if row is None:
                raise ValueError(f"{stage}: not a stage; the stages are {', '.join(STAGES)}")
            if math.isfinite(duration_ms):
                self._ring[row, self._count[row] % self.capacity] = duration_ms
                self._count[row] += 1

    def frames(self, stage: str) -> int:
        """Number of durations of `stage` recorded since the start."""
        return self._count[_INDEX[stage]]

    def values_ms(self, stage: str) -> FloatArray:
        """The durations of `stage` over the last `capacity` frames, in no particular order."""
        row = _INDEX[stage]
        return self._ring[row, : min(self._count[row], self.capacity)].copy()

    def percentiles(self) -> dict[str, dict[str, float]]:
        """p50, p95, p99 (linearly interpolated), max and mean in ms of every stage that ran."""
        rows = {}
        for stage in STAGES:
            values = self.values_ms(stage)
            if len(values):
                p50, p95, p99 = np.percentile(values, (50, 95, 99)).tolist()
                rows[stage] = {"p50": p50, "p95": p95, "p99": p99}
                rows[stage] |= {"max": float(values.max()), "mean": float(values.mean())}
        return rows

    def table(self) -> str:
        """The percentiles as aligned text, one stage a line."""
        columns = ("mean", "p50", "p95", "p99", "max")
        lines = [f"{'stage, ms':<12}" + "".join(f"{name:>10}" for name in columns)]
        for stage, row in self.percentiles().items():
            lines.append(f"{stage:<12}" + "".join(f"{row[name]:>10.2f}" for name in columns))
        return "\n".join(lines)
