"""The real service and the lamp's process: the lamp is FAULT whatever befalls the service."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from small_crossing import Service

from bikeped.cli.main import cli
from bikeped.config.load import load_config
from bikeped.pipeline import doctor

PATIENCE_S = 40.0

#: Holds the interpreter for six seconds when the file appears that is named first.
HOLDS = """
import ctypes, os, sys, threading, time
from bikeped.cli.main import main

def hold():
    while not os.path.exists(HELD):
        time.sleep(0.01)
    ctypes.PyDLL(None).usleep(6_000_000)

threading.Thread(target=hold, daemon=True).start()
sys.exit(main(sys.argv[1:]))
"""


class Bench:
    """A configuration whose lamp is a file, and the lamp's process."""

    def __init__(self, config: Path) -> None:
        self.config, self.file, self.held = config, config.parent / "lamp", config.parent / "held"
        settings = config.parent / "lamp.json"
        assert self.command("--write", str(settings)) == ""
        self.process = subprocess.Popen([sys.executable, "-m", "bikeped.lamp", str(settings)])

    def command(self, *arguments: str) -> str:
        done = CliRunner().invoke(
            cli, ["lamp", "-c", str(self.config), *arguments], catch_exceptions=False
        )
        assert done.exit_code == 0
        return done.output

    def until(self, *colours: str) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while not (self.file.exists() and self.file.read_text().strip() in colours):
            assert time.monotonic() < end_s, f"{colours} did not come"
            time.sleep(0.005)


@pytest.fixture
def bench(
    tmp_path: Path, make_clip: Callable[..., Path], small_config: Callable[..., Path]
) -> Iterator[Bench]:
    lines = (
        f"feedback: {{light: lamp}}\n"
        f"lamp: {{driver: file, file: {tmp_path}/lamp, socket: {tmp_path}/s}}\n"
    )
    one = Bench(small_config(make_clip("day.avi", 1800), lines))
    yield one
    one.process.kill()
    one.process.wait()


@pytest.mark.parametrize("how", ["killed", "stopped", "held"])
def test_a_service_that_cannot_speak_is_fault(bench: Bench, how: str) -> None:
    program = HOLDS.replace("HELD", repr(str(bench.held))) if how == "held" else None
    service = Service(bench.config, program=program)
    try:
        bench.until("green")
        if how == "held":
            bench.held.touch()
        else:
            service.process.send_signal(signal.SIGKILL if how == "killed" else signal.SIGSTOP)
        bench.until("orange")
        bench.until("off")  # it blinks
    finally:
        service.close()


def test_a_stopped_service_is_dark_and_its_lamp_can_be_asked(bench: Bench) -> None:
    service = Service(bench.config)
    try:
        bench.until("green")
        service.process.send_signal(signal.SIGHUP)
        service.until_said("SIGHUP is ignored")
        assert doctor.check_light(load_config(bench.config)).status == "ok"
        assert service.stop(signal.SIGUSR1) == 0
    finally:
        service.close()
    bench.until("off")
    time.sleep(0.7)  # longer than the silence that is FAULT
    assert bench.file.read_text() == "off\n"
    assert "the lamp is reset" in bench.command("reset")


def test_a_lamp_that_is_gone_is_the_services_fault(bench: Bench) -> None:
    service = Service(bench.config)
    try:
        bench.until("green")
        bench.process.kill()
        service.until_said("FAULT: .*lamp: its process does not answer")
    finally:
        service.close()
    assert doctor.check_light(load_config(bench.config)).status == "fail"


def test_settings_are_removed_where_another_light_is_configured(bench: Bench) -> None:
    settings = bench.config.parent / "lamp.json"
    assert json.loads(settings.read_text())["driver"] == "file"
    arguments = ["lamp", "-c", str(bench.config), "--set", "feedback.light=simulated"]
    done = CliRunner().invoke(cli, [*arguments, "--write", str(settings)])
    assert done.exit_code != 0
    assert not settings.exists()


def test_the_command_becomes_the_lamps_process(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[list[str]] = []
    monkeypatch.setattr(os, "execv", lambda path, arguments: started.append(arguments))
    bench.command()
    assert started == [
        [sys.executable, "-m", "bikeped.lamp", str(bench.config.parent / "lamp.json")]
    ]
