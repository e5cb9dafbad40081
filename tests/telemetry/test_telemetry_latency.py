"""Stage times: percentiles by hand, the ring, and what is not recorded."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bikeped.telemetry.latency import STAGES, StageTimes


def test_percentiles_of_known_durations():
    times = StageTimes(capacity=1000)
    for ms in range(101):
        times.add({"total": float(ms), "track": 2.0})
    rows = times.percentiles()
    assert rows["total"] == {"p50": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0, "mean": 50.0}
    assert rows["track"] == {"p50": 2.0, "p95": 2.0, "p99": 2.0, "max": 2.0, "mean": 2.0}
    assert list(rows) == ["track", "total"]  # in the order of a frame's way; idle stages left out


@given(st.lists(st.floats(0, 1e5), min_size=1, max_size=60), st.integers(min_value=1, max_value=20))
def test_only_the_last_frames_count(durations: list[float], capacity: int):
    times = StageTimes(capacity)
    for ms in durations:
        times.add({"inference": ms})
    kept = durations[-capacity:]
    assert sorted(times.values_ms("inference")) == sorted(kept)
    assert times.frames("inference") == len(durations)
    assert times.percentiles()["inference"]["max"] == max(kept)
    assert times.percentiles()["inference"]["p95"] == np.percentile(kept, 95)


def test_a_stage_that_did_not_run_changes_nothing():
    times = StageTimes()
    times.add({"pre": math.nan, "post": math.inf})
    assert times.percentiles() == {}
    assert times.frames("pre") == 0


def test_an_unknown_stage_is_refused():
    with pytest.raises(ValueError, match=r"lunch: not a stage.*inference"):
        StageTimes().add({"lunch": 1.0})
    with pytest.raises(ValueError, match="capacity"):
        StageTimes(0)


def test_the_table_has_a_line_a_stage_that_ran():
    times = StageTimes()
    times.add(dict.fromkeys(STAGES, 12.345))
    lines = times.table().splitlines()
    assert [line.split()[0] for line in lines[1:]] == list(STAGES)
    assert lines[0].split() == ["stage,", "ms", "mean", "p50", "p95", "p99", "max"]
    assert all(line.split()[1:] == ["12.35"] * 5 or "12.34" in line for line in lines[1:])
    assert len({len(line) for line in lines}) == 1
