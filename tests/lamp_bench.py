"""The lamp's process with a file for a lamp, and the real service before it, for what ends them.

`LAMP_REPETITIONS=20 pytest -s tests/lamp/test_lamp_faults.py` injects each fault so often and
prints the worst time to FAULT. The campaign can use `Bench` and `FAULTS` by themselves.
"""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import msgspec

from bikeped.config.load import load_config
from bikeped.feedback.lamp_client import ask_lamp, write_settings

HERE = Path(__file__).parent
LONG_S = 60.0
REASSURING = ("green", "blue")


class Bench:
    """One folder with `config.yaml` (feedback.light: lamp), a lamp, and a service on demand.

    `config` is the text of the configuration; its light becomes the lamp. Leave it as a context
    manager, which ends what it started.
    """

    def __init__(self, folder: Path, config: str) -> None:
        self.folder, self.file, self.socket = folder, folder / "lamp", str(folder / "lamp.socket")
        self.config = folder / "config.yaml"
        data = msgspec.yaml.decode(config)
        data["feedback"] = {**data.get("feedback", {}), "light": "lamp"}
        data["lamp"] = {"driver": "file", "socket": self.socket, "file": str(self.file)}
        data["complete"] = data.pop("complete", True)  # the last line
        self.config.write_bytes(msgspec.yaml.encode(data))
        self.lamp: subprocess.Popen[bytes] | None = None
        self.service: subprocess.Popen[bytes] | None = None
        self._unread: list[int] = []

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        end(self.service)
        end(self.lamp)
        for handle in self._unread:
            os.close(handle)

    def start_lamp(self) -> float:
        """Starts `bikeped lamp`; returns the seconds until it showed FAULT."""
        settings, config = self.folder / "lamp.json", load_config(self.config).config
        write_settings(settings, config.lamp, config.feedback)
        began_s = time.monotonic()
        with (self.folder / "lamp.log").open("ab") as log:
            self.lamp = subprocess.Popen(
                [sys.executable, "-m", "bikeped.lamp", str(settings)], stderr=log
            )
        return self.until({"orange"}, began_s)

    def start_service(self, *, unread_stderr: bool = False) -> None:
        """Starts `bikeped run`, and waits for green or blue.

        `unread_stderr`: its standard error is a pipe of 4 KiB that is not read.
        """
        end(self.service)
        if unread_stderr:
            reading, stderr = os.pipe()
            fcntl.fcntl(stderr, fcntl.F_SETPIPE_SZ, 4096)
            self._unread.append(reading)
        else:
            log = self.folder / "service.log"
            stderr = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        self.service = subprocess.Popen(
            [sys.executable, str(HERE / "lamp_service.py"), "run", "-c", str(self.config)],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
        )
        os.close(stderr)
        self.until(REASSURING, time.monotonic())

    def tell(self, text: str) -> None:
        """A word for the seams of the service (see lamp_service)."""
        assert self.service is not None
        assert self.service.stdin is not None
        self.service.stdin.write(f"{text}\n".encode())
        self.service.stdin.flush()

    def ask(self, message: str = "status") -> dict[str, Any]:
        """The lamp's status, after a `reset` where that is the message."""
        return ask_lamp(self.socket, {message: True}, LONG_S)

    def shown(self) -> str:
        """The lamp that is on now, or off."""
        return self.file.read_text().strip() if self.file.exists() else "off"

    def until(self, colours: Collection[str], since_s: float, timeout_s: float = LONG_S) -> float:
        """Seconds from `since_s` until the lamp is one of `colours`."""
        while time.monotonic() < since_s + timeout_s:
            if self.shown() in colours:
                return time.monotonic() - since_s
            time.sleep(0.005)
        raise TimeoutError(f"none of {colours} within {timeout_s} s; {self.shown()}\n{self.log()}")

    def log(self) -> str:
        """What lamp and service wrote."""
        files = (self.folder / "lamp.log", self.folder / "service.log")
        return "\n".join(file.read_text()[-3000:] for file in files if file.exists())

    def fault_after(self, inject: Callable[[Bench], None]) -> float:
        """Injects a fault beside green or blue; seconds until FAULT. Then the service is ended.

        A service that is ended in order leaves the lamp dark, which counts as well.
        """
        self.ask("reset")  # which a service must follow with a second of heartbeats
        self.until({"orange", "off"}, time.monotonic())
        if self.service is None or self.service.poll() is not None:
            self.start_service()
        self.until(REASSURING, time.monotonic())
        began_s = time.monotonic()
        inject(self)
        took_s = self.until({"orange", "off"}, began_s)
        end(self.service)
        return took_s


def end(process: subprocess.Popen[bytes] | None) -> None:
    """Ends a process, which may be stopped or have ended."""
    if process is not None:
        process.kill()
        process.wait()
        if process.stdin is not None:
            process.stdin.close()


def send(number: signal.Signals) -> Callable[[Bench], None]:
    """Sends a signal to the service."""

    def inject(bench: Bench) -> None:
        assert bench.service is not None
        bench.service.send_signal(number)

    return inject


FAULTS: dict[str, Callable[[Bench], None]] = {
    "SIGKILL": send(signal.SIGKILL),
    "SIGSTOP": send(signal.SIGSTOP),
    "interpreter held for 6 s": lambda bench: bench.tell("hold 6"),
    "event loop blocked for 6 s": lambda bench: bench.tell("block 6"),
    **{
        name: send(getattr(signal, name))
        for name in ("SIGUSR1", "SIGUSR2", "SIGALRM", "SIGQUIT", "SIGTERM")
    },
}
