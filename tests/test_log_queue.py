"""Log lines through the queue: none blocks who logs, lost ones are named, the process ends."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from bikeped.log_queue import QueuedLog, dropped_lines, log_through_queue

PATIENCE_S = 40.0


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reading, writing = os.pipe()
    yield reading, writing
    for end in (reading, writing):
        with contextlib.suppress(OSError):
            os.close(end)


def _logger(writing: int, lines: int) -> tuple[logging.Logger, QueuedLog]:
    stream = os.fdopen(writing, "w", closefd=False)
    handler = logging.StreamHandler(stream)
    handler.setFormatter(logging.Formatter("%(levelname)s %(message)s"))
    queued = QueuedLog(handler, lines)
    logger = logging.Logger("of the test")
    logger.addHandler(queued)
    return logger, queued


def test_lines_keep_their_format_and_order(pipe):
    logger, queued = _logger(pipe[1], 100)
    for number in range(20):
        logger.warning("line %d", number)
    try:
        raise ValueError("why")
    except ValueError:
        logger.exception("failed")
    queued.flush()
    lines = os.read(pipe[0], 65536).decode().splitlines()
    assert lines[:20] == [f"WARNING line {number}" for number in range(20)]
    assert lines[20] == "ERROR failed"
    assert lines[-1] == "ValueError: why"
    assert queued.dropped == 0


def test_a_pipe_that_nobody_reads_blocks_nobody_and_the_loss_is_named(pipe):
    logger, queued = _logger(pipe[1], 10)
    count = 2000  # of 101 bytes: more than any pipe and the queue hold

    def log_all() -> None:
        for number in range(count):
            logger.warning("%091d", number)

    logging_thread = threading.Thread(target=log_all, daemon=True)
    logging_thread.start()
    logging_thread.join(PATIENCE_S)
    assert not logging_thread.is_alive()
    assert queued.dropped > 0
    queued.flush()  # returns although nothing more can be written

    text, named, written = "", 0, 0
    while written + queued.dropped < count or named < queued.dropped:
        text += os.read(pipe[0], 65536).decode()
        named = sum(
            map(int, re.findall(r"^(\d+) log lines were lost: standard", text, re.MULTILINE))
        )
        written = len(re.findall(r"^WARNING \d{91}$", text, re.MULTILINE))
    assert (written + named, named) == (count, queued.dropped)


def test_a_reader_that_left_costs_its_lines_only(pipe):
    logger, queued = _logger(pipe[1], 10)
    os.close(pipe[0])
    logger.warning("nobody reads this")
    queued.flush()
    assert queued.dropped == 1
    logger.warning("nor this")
    queued.flush()
    assert queued.dropped == 2


PROGRAM = """
import logging, sys, warnings
from bikeped.log_queue import dropped_lines, log_through_queue
logging.basicConfig(format="%(message)s")
log_through_queue(); log_through_queue()
assert len(logging.getLogger().handlers) == 1
for number in range(int(sys.argv[1])):
    logging.warning("%0100d", number)
warnings.warn("one of Python's own")
print(dropped_lines(), flush=True)
"""


def _run(count: int) -> tuple[subprocess.Popen[str], int]:
    reading, writing = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(count)],
        stdout=subprocess.PIPE,
        stderr=writing,
        text=True,
    )
    os.close(writing)
    return process, reading


def test_a_process_ends_while_its_standard_error_blocks():
    process, reading = _run(20_000)
    try:
        said, _ = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        os.close(reading)
    assert process.returncode == 0
    assert int(said) > 0


def test_the_last_lines_are_written_before_the_process_ends():
    process, reading = _run(3)
    said, _ = process.communicate(timeout=PATIENCE_S)
    with os.fdopen(reading) as lines:
        text = lines.read()
    assert process.returncode == 0
    assert int(said) == 0
    assert [line.lstrip("0") for line in text.splitlines()[:3]] == ["", "1", "2"]
    assert "one of Python's own" in text


def test_the_handlers_of_others_are_left_alone():
    before = logging.getLogger().handlers[:]
    log_through_queue()
    kept = logging.getLogger().handlers
    assert [h for h in before if type(h) is not logging.StreamHandler] == kept
    assert dropped_lines() == 0
