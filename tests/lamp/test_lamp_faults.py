"""The real service before the lamp's process: killed, stopped, held, blocked, its log unread."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from lamp_bench import FAULTS, REASSURING, Bench

REPETITIONS = int(os.environ.get("LAMP_REPETITIONS", "1"))
LIMIT_S = 1.0


@pytest.fixture
def crossing(
    tmp_path: Path, small_config: Callable[..., Path], make_clip: Callable[..., Path]
) -> Iterator[Bench]:
    """A lamp that runs, and what a service before it needs."""
    with Bench(tmp_path, small_config(make_clip("day.avi", 3600)).read_text()) as bench:
        bench.start_lamp()
        yield bench


def report(name: str, took_s: list[float]) -> None:
    print(f"\n{name}: FAULT after {max(took_s):.2f} s, the worst of {len(took_s)}")
    assert max(took_s) <= LIMIT_S


@pytest.mark.parametrize("name", FAULTS)
def test_the_lamp_shows_fault_without_the_service(crossing: Bench, name: str) -> None:
    report(name, [crossing.fault_after(FAULTS[name]) for _ in range(REPETITIONS)])


def test_a_standard_error_that_nobody_reads_stops_neither_light_nor_fault(crossing: Bench) -> None:
    took_s = []
    for _ in range(REPETITIONS):
        crossing.start_service(unread_stderr=True)
        crossing.tell("log 500")
        time.sleep(1.5)
        assert crossing.shown() in REASSURING  # as decided
        assert crossing.ask()["fault"] is None
        took_s.append(crossing.fault_after(FAULTS["SIGSTOP"]))
    report("standard error not read, then SIGSTOP", took_s)


def test_a_hangup_ends_nothing(crossing: Bench) -> None:
    crossing.start_service()
    assert crossing.service is not None
    crossing.service.send_signal(signal.SIGHUP)
    with pytest.raises(subprocess.TimeoutExpired):
        crossing.service.wait(1)
    assert crossing.shown() in REASSURING
