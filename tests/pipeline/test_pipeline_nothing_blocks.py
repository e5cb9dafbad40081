"""The service as a process: what blocks or hurries outside does not stop the light."""

from __future__ import annotations

import contextlib
import fcntl
import http.client
import json
import os
import select
import socket
import subprocess
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from small_crossing import BIKEPED, free_port

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
        except (urllib.error.URLError, json.JSONDecodeError):  # not serving yet, or full
            health = None
        if health is not None:
            goal = goal or health["counters"]["frames"] + more
            if health["counters"]["frames"] >= goal and health["state"] == "SAFE":
                return health
        assert time.monotonic() < deadline_s, health
        time.sleep(0.1)


@pytest.fixture
def full_pipe() -> Iterator[int]:
    """The writing end of a pipe of 4 KiB that is full and has no reader."""
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
    command = [*BIKEPED, "--log-level", "debug", "run", "-c"]
    with subprocess.Popen([*command, str(config)], stdout=full_pipe, stderr=full_pipe) as process:
        try:
            _until_frames(process, port, 30)
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
        finally:
            process.kill()


def test_idle_and_hurried_clients_do_not_stop_the_frames(make_clip: Any, small_config: Any) -> None:
    port = free_port()
    web = f"web: {{enabled: true, port: {port}, max_connections: 32}}\n"
    config: Path = small_config(make_clip("day.avi", 6000), more=web)
    with (
        subprocess.Popen([*BIKEPED, "run", "-c", str(config)]) as process,
        ThreadPoolExecutor() as threads,
    ):
        stop, asked = threading.Event(), threading.Event()

        def hurry() -> int:
            """The number of answers to one client that asks as fast as it can."""
            answers, client = 0, http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
            while not stop.is_set():
                client.request("GET", "/metrics")
                assert b"bikeped_frames_total" in client.getresponse().read()
                answers += 1
                asked.set()
            client.close()
            return answers

        try:
            before = _until_frames(process, port, 10)
            hurried = threads.submit(hurry)
            assert asked.wait(PATIENCE_S)
            with contextlib.ExitStack() as sockets:
                idle = [
                    sockets.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
                    for _ in range(200)
                ]
                turned_away = 0
                while turned_away < 200 - 32:
                    answered = select.select(idle, [], [], PATIENCE_S)[0]
                    # None of the others waits for ever: idle ones are closed after a while.
                    answers = {client.recv(12) for client in answered}
                    assert answers <= {b"HTTP/1.1 503", b""}
                    idle = [client for client in idle if client not in answered]
                    turned_away += len(answered)
            after = _until_frames(process, port, 60)
            stop.set()
            assert hurried.result(PATIENCE_S) > 0
        finally:
            stop.set()
            process.kill()
    assert after["counters"]["log_dropped"] == 0
    assert after["counters"]["frames"] > before["counters"]["frames"] + 60
