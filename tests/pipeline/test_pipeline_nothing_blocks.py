"""The service as a process: what blocks or hurries outside does not stop the light."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from small_crossing import free_port

PATIENCE_S = 60.0


def _health(port: int) -> dict[str, Any]:
    try:
        answer = urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=PATIENCE_S)
    except urllib.error.HTTPError as error:
        answer = error
    with answer:
        found: dict[str, Any] = json.load(answer)
    return found


def _until_frames(process: subprocess.Popen[bytes], port: int, more: int) -> dict[str, Any]:
    """Health once `more` frames were processed from now on."""
    deadline_s, goal = time.monotonic() + PATIENCE_S, None
    while True:
        assert process.poll() is None
        try:
            health = _health(port)
        except urllib.error.URLError:  # not serving yet
            health = None
        if health is not None:
            goal = goal or health["counters"]["frames"] + more
            if health["counters"]["frames"] >= goal and health["state"] == "SAFE":
                return health
        assert time.monotonic() < deadline_s, health
        time.sleep(0.1)


@pytest.fixture
def full_pipe() -> Iterator[int]:
    """The writing end of a pipe of 4 KiB that is full and that nobody reads."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, 1031, 4096)  # F_SETPIPE_SZ, a constant of Python 3.10 on some systems only
    os.set_blocking(writing, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writing, b"x" * 1024)
    os.set_blocking(writing, True)
    yield writing
    os.close(reading)
    os.close(writing)


def test_a_standard_error_that_blocks_stops_neither_the_light_nor_the_end(
    make_clip: Any, small_config: Any, full_pipe: int
) -> None:
    port = free_port()
    config: Path = small_config(
        make_clip("day.avi", 3000), more=f"web: {{enabled: true, port: {port}}}\n"
    )
    command = [sys.executable, "-m", "bikeped.cli.main", "--log-level", "debug", "run", "-c"]
    with subprocess.Popen([*command, str(config)], stdout=full_pipe, stderr=full_pipe) as process:
        try:
            _until_frames(process, port, 30)
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()
