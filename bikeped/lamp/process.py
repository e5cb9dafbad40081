"""The lamp's process: one thread, one Unix datagram socket, one device.

Datagrams are JSON: a heartbeat (`logic.Heartbeat`), or `{"reset": true}` or `{"status": true}`.
Each is answered with the status to its sender. The process never waits for anybody: an answer that
does not fit into the sender's queue is dropped.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

from bikeped.errors import FeedbackError
from bikeped.lamp.colours import Colour, Light
from bikeped.lamp.logic import Heartbeat, LampLogic

POLL_S = 0.1  #: the longest sleep, and the pace of reading back
ASSERT_S = 1.0  #: between two sendings of an unchanged colour: a replugged light is noticed
RETRY_S = 1.0  #: pause after a device error
SETTINGS_S = 1.0  #: between two looks for lamp.json
MAX_BYTES = 512
MAX_BURST = 32  #: datagrams read before the device is looked after again


class LampDevice(Light, Protocol):
    """A light that can be read back."""

    def mismatch(self, colour: Colour) -> str | None:
        """What is lit instead of `colour`; None where it agrees or the device cannot tell."""


class FileLight:
    """A light that is a file with the colour, for tests: like a relay it keeps its state."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._partial = path.with_name(f".{path.name}.partial")

    def set(self, colour: Colour) -> None:
        try:
            # Not by bikeped.files: its imports cost as much as this whole process.
            self._partial.write_text(f"{colour.value}\n")
            self._partial.replace(self._path)
        except OSError as error:
            raise FeedbackError(f"lamp.file: {error}") from error

    def mismatch(self, colour: Colour) -> str | None:
        try:
            lit = self._path.read_text().split()
        except OSError as error:
            raise FeedbackError(f"lamp.file: {error}") from error
        return None if lit == [colour.value] else f"the file says {' and '.join(lit) or 'nothing'}"

    def close(self) -> None:
        self.set(Colour.OFF)


def open_device(settings: dict[str, Any]) -> LampDevice:
    """The device that lamp.json names; FeedbackError when it is not there."""
    driver = settings.get("driver")
    try:
        if driver == "file":
            return FileLight(Path(settings["file"]))
        if driver == "gpio":
            from bikeped.lamp.gpio import GpioLight

            return GpioLight(_wiring(settings["gpio"]))
        if driver == "usb":
            from bikeped.lamp.usb import UsbLight

            return UsbLight(_wiring(settings["usb"]))
    except (KeyError, TypeError, AttributeError) as error:
        raise FeedbackError(f"lamp.json: {type(error).__name__}: {error}") from error
    raise FeedbackError(f"lamp.json: no driver {driver!r}; choose gpio, usb or file")


def _wiring(section: dict[str, Any]) -> Any:
    return SimpleNamespace(**section)


class LampProcess:
    """Drives the device of `settings` by the heartbeats that come to its socket.

    Raises FeedbackError when the socket cannot be bound or another lamp process answers on it.
    """

    def __init__(
        self,
        settings: dict[str, Any],
        *,
        open_device: Callable[[dict[str, Any]], LampDevice] = open_device,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._settings, self._open, self._clock = settings, open_device, clock
        path = Path(str(settings["socket"]))
        # What is latched outlives this process, but not the power: the socket lies in /run.
        self._latch = path.with_suffix(".latched")
        with contextlib.suppress(OSError):
            self._saved: str | None = None
            self._saved = self._latch.read_text()
        self.logic = LampLogic(latched=self._saved)
        self.socket = bind(path)
        self._device: LampDevice | None = None
        self._set: Colour | None = None
        self._set_s = self._retry_s = float("-inf")
        self.error: str | None = "not opened yet"

    def serve(self) -> None:
        """Handles what has come and drives the device, once; sleeps until something is due."""
        now_s = self._clock()
        colour, due_s = self.logic.shows(now_s)
        self._drive(colour, now_s)
        self._save()
        self.socket.settimeout(max(0.001, min(POLL_S, due_s - self._clock())))
        for _ in range(MAX_BURST):
            try:
                data, sender = self.socket.recvfrom(MAX_BYTES)
            except (TimeoutError, socket.timeout, BlockingIOError):  # noqa: UP041 - Python 3.10
                return
            self.socket.setblocking(False)
            self._take(data)
            if sender:
                with contextlib.suppress(OSError):
                    self.socket.sendto(json.dumps(self.status()).encode(), sender)

    def _take(self, data: bytes) -> None:
        now_s = self._clock()
        try:
            message = json.loads(data)
            if message == {"reset": True}:
                self.logic.reset()
            elif message != {"status": True}:
                self.logic.heartbeat(Heartbeat.decode(message), now_s)
        except (ValueError, RecursionError):
            self.logic.heartbeat(None, now_s)

    def status(self) -> dict[str, Any]:
        """The answer: colour lit now, why FAULT is shown, what is latched, the device's error."""
        return {
            "colour": None if self._set is None else self._set.value,
            "fault": self.logic.fault(self._clock()),
            "latched": self.logic.latched,
            "error": self.error,
        }

    def _drive(self, colour: Colour, now_s: float) -> None:
        if now_s < self._retry_s:
            return
        try:
            if self._device is None:
                self._device = self._open(self._settings)
            if colour is not self._set or now_s - self._set_s >= ASSERT_S:
                if self._set is not None:  # before it is covered up by setting anew
                    self.logic.readback(self._device.mismatch(self._set), now_s)
                self._device.set(colour)
                self._set, self._set_s = colour, now_s
            else:
                self.logic.readback(self._device.mismatch(colour), now_s)
        except Exception as error:  # noqa: BLE001 - no bug of a driver may end this process
            self._failed(error, now_s)
            return
        self.error = None

    def _failed(self, error: Exception, now_s: float) -> None:
        expected = isinstance(error, FeedbackError)
        text = str(error) if expected else f"{type(error).__name__}: {error}"
        device, self._device, self._set = self._device, None, None
        self._retry_s = now_s + RETRY_S
        if device is not None:
            with contextlib.suppress(Exception):
                device.close()
        if text != self.error:
            say(f"the light cannot be driven: {text}")
        self.error = text

    def close(self) -> None:
        """Darkens the lamp and gives device and socket back."""
        if self._device is not None:
            with contextlib.suppress(Exception):
                self._device.close()
        self.socket.close()

    def _save(self) -> None:
        if self.logic.latched == self._saved:
            return
        self._saved = self.logic.latched
        say(f"latched: {self._saved}" if self._saved else "reset")
        with contextlib.suppress(OSError):
            if self._saved is None:
                self._latch.unlink()
            else:
                self._latch.write_text(self._saved)


def bind(path: Path) -> socket.socket:
    """The socket at `path`, in place of one that no process serves; FeedbackError otherwise."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
    try:
        with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
                probe.connect(str(path))
            raise FeedbackError(f"lamp.socket: {path}: another lamp process serves it")
        path.unlink(missing_ok=True)
        sock.bind(str(path))
        path.chmod(0o660)
    except OSError as error:
        sock.close()
        raise FeedbackError(f"lamp.socket: {path}: {error}") from error
    except FeedbackError:
        sock.close()
        raise
    return sock


def say(text: str) -> None:
    """One line for the journal; dropped where standard error is full: it must not block."""
    with contextlib.suppress(OSError):
        os.write(sys.stderr.fileno(), f"bikeped lamp: {text}\n".encode())


def notify(text: str) -> None:
    """sd_notify(3), by hand."""
    name = os.environ.get("NOTIFY_SOCKET")
    if not name:
        return
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sending:
        sending.setblocking(False)
        sending.sendto(text.encode(), "\0" + name[1:] if name.startswith("@") else name)


def main(arguments: list[str]) -> int:
    """Drives the lamp until the process is ended; `arguments`: the path of lamp.json."""
    path = Path(arguments[0] if arguments else "/run/bikeped/lamp.json")
    with contextlib.suppress(OSError):
        os.set_blocking(sys.stderr.fileno(), False)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2):
        signal.signal(number, _end)
    lamp: LampProcess | None = None
    said = None
    told_s = float("-inf")
    try:
        while True:
            if lamp is not None:
                lamp.serve()
            else:
                try:
                    lamp = LampProcess(json.loads(path.read_bytes()))
                except (OSError, ValueError, KeyError, TypeError, FeedbackError) as error:
                    # Without settings there is nothing to drive: wait, and say so once.
                    if str(error) != said:
                        said = str(error)
                        say(f"{path}: {type(error).__name__}: {said}")
                    time.sleep(SETTINGS_S)
            if time.monotonic() - told_s >= 0.5:
                first, told_s = told_s < 0, time.monotonic()
                notify("READY=1\nWATCHDOG=1" if first else "WATCHDOG=1")
    finally:
        if lamp is not None:
            lamp.close()


def _end(number: int, _: object) -> None:
    raise SystemExit(0)
