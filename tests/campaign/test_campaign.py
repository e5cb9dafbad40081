"""The short rows of the fault campaign, once each; `scripts/faults` runs all of them, 20 times."""

from __future__ import annotations

import math

import pytest

from campaign.registry import Limit, Result, Row, limits
from campaign.runner import load_rows, page, run_row

ROWS = load_rows()


@pytest.mark.parametrize("number", [number for number, row in ROWS.items() if row.in_tests])
def test_row(number):
    result = run_row(ROWS[number], repeat=1)
    if result.skipped:
        pytest.skip(result.skipped)
    # How fast it was is not asserted, only that it came: machines that run tests are busy.
    assert not result.failures
    assert set(result.worst) == {limit.name for limit in ROWS[number].limits}
    for limit in ROWS[number].limits:
        assert math.isfinite(result.worst[limit.name]), f"{limit}: {result.measured}"
        if limit.unit not in ("s", "ms", "MB"):
            assert limit.holds(result.worst[limit.name]), f"{limit}: {result.measured}"


def test_a_limit_reads_and_judges():
    above, below = limits("FAULT <= 1 s; found >= 99.5 %")
    assert (above, below) == (Limit("FAULT", "<=", 1, "s"), Limit("found", ">=", 99.5, "%"))
    assert above.holds(1)
    assert not above.holds(1.01)
    assert not above.holds(float("nan"))
    assert above.worse(0.2, 0.7) == 0.7
    assert below.worse(100, 98) == 98
    with pytest.raises(ValueError, match="not a limit"):
        Limit.parse("soon")


def test_a_row_fails_by_a_figure_by_what_was_seen_and_by_what_was_not_measured():
    row = Row(1, "a fault", "FAULT", limits("FAULT <= 1 s"), lambda rig: None)
    assert Result(row, {"FAULT": 0.5}).verdict == "pass"
    assert Result(row, {"FAULT": 1.5}).verdict == "fail"
    assert Result(row, {"FAULT": 0.5}, ["green"]).verdict == "fail"
    assert Result(row).verdict == "fail"
    assert Result(row, skipped="no broker").verdict == "not tried"
    assert "| 1 | a fault | FAULT | FAULT <= 1 s | FAULT 1.5 s | **fail** |" in page(
        [Result(row, {"FAULT": 1.5})]
    )
