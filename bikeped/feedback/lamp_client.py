"""The service's side of the lamp's own process: a heartbeat with every signal.

Heartbeats are sent where the loop shows a signal, and nowhere else: a loop that hangs, a process
that is stopped or killed, an interpreter that is held all fall silent, and silence is FAULT there.
"""

from __future__ import annotations

import contextlib
import json
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bikeped.config.output_sections import FeedbackConfig, LampConfig
from bikeped.errors import FeedbackError
from bikeped.faults import Fault
from bikeped.feedback.signal_logic import OFF
from bikeped.files import write_whole
from bikeped.lamp.logic import Heartbeat
from bikeped.types import Colour, Signal

SILENT_S = 1.0  #: without an answer: a fault


class LampClient:
    """Sends signals to the lamp's process, never waiting, and reports what it answers."""

    name = "lamp"

    def __init__(self, path: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._clock = path, clock
        self._socket: socket.socket | None = None
        self._answered_s = clock()
        self._status: dict[str, Any] = {}
        self._sending_failed: str | None = None
        self._off = False
        self.errors = 0  #: heartbeats that could not be sent, since the start

    def start(self) -> None:
        """Opens the service's end; the lamp shows FAULT until the first `show`."""
        self._socket = open_socket()
        self._answered_s = self._clock()

    def show(self, signal: Signal) -> None:
        """Sends one heartbeat and takes the answers that have come. Returns at once, always."""
        if self._socket is None:
            return
        now_s = self._clock()
        beat = Heartbeat(now_s, signal.colour, signal.blink_hz)
        try:
            self._socket.sendto(beat.encode(), self._path)
            self._sending_failed = None
        except OSError as error:
            self.errors += 1
            self._sending_failed = error.strerror
        self._off = signal.colour is Colour.OFF
        self._hear(now_s)

    def _hear(self, now_s: float) -> None:
        with contextlib.suppress(OSError, ValueError):
            while self._socket is not None:
                status = json.loads(self._socket.recv(4096))
                if isinstance(status, dict):
                    self._status, self._answered_s = status, now_s

    @property
    def fault(self) -> Fault | None:
        """What is wrong with the lamp now; None when it answers and obeys."""
        if self._clock() - self._answered_s > SILENT_S:
            why = f" ({self._sending_failed})" if self._sending_failed else ""
            return Fault("lamp", "lamp.silent", f"its process does not answer{why}")
        latched, error = self._status.get("latched"), self._status.get("error")
        if latched:
            return Fault("lamp", "lamp.latched", f"{latched}; end it by `bikeped lamp reset`")
        return Fault("light", "light.error", str(error)) if error else None

    def close(self, timeout_s: float = 2.0) -> bool:
        """Ends the heartbeats: the lamp stays dark after OFF, and shows FAULT after all else.

        False when the lamp's process does not answer or obey.
        """
        if self._off:
            self.show(OFF)
        self._hear(self._clock())
        works = self.fault is None
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        return works


def open_socket() -> socket.socket:
    """A datagram socket that can be answered and never blocks."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
    sock.bind("")  # the kernel chooses a name, unix(7)
    sock.setblocking(False)
    return sock


def ask_lamp(path: str, message: dict[str, bool], timeout_s: float = 1.0) -> dict[str, Any]:
    """The lamp's status after `message`; FeedbackError when its process does not answer."""
    with open_socket() as sock:
        sock.settimeout(timeout_s)
        try:
            sock.sendto(json.dumps(message).encode(), path)
            answer: dict[str, Any] = json.loads(sock.recv(4096))
        except OSError as error:
            raise FeedbackError(
                f"lamp.socket: {path}: the lamp's process does not answer ({error}); is it running?"
            ) from error
    return answer


def write_settings(path: Path, lamp: LampConfig, feedback: FeedbackConfig) -> None:
    """Writes the lamp.json that `python -m bikeped.lamp` reads. Raises BikepedError."""
    settings: dict[str, Any] = {"driver": lamp.driver, "socket": lamp.socket}
    if lamp.driver == "file":
        settings["file"] = lamp.file
    elif lamp.driver is not None:
        section = feedback.gpio if lamp.driver == "gpio" else feedback.usb
        settings[lamp.driver] = {key: getattr(section, key) for key in section.__struct_fields__}
    write_whole(path, json.dumps(settings, indent=2) + "\n")
