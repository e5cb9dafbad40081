"""The lamp's process as systemd runs it, with the file that keeps its state as a relay does."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bikeped.config.output_sections import FeedbackConfig, LampConfig
from bikeped.errors import FeedbackError
from bikeped.feedback.lamp_client import LampClient, ask_lamp, write_settings
from bikeped.lamp.colours import Colour
from bikeped.lamp.process import LampDevice, LampProcess, notify, open_device
from bikeped.types import Signal

ROOT = Path(__file__).parents[2]
PATIENCE_S = 20.0
GREEN = Signal("SAFE", Colour.GREEN)

SENDER = """
import contextlib, sys, time
from bikeped.lamp.logic import Heartbeat
from bikeped.lamp.colours import Colour
import socket
sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
while True:
    with contextlib.suppress(OSError):  # no lamp process yet
        sock.sendto(Heartbeat(time.monotonic(), Colour.GREEN, 0.0).encode(), sys.argv[1])
    time.sleep(0.05)
"""


def until(condition: Callable[[], object], what: str) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, f"{what} did not come"
        time.sleep(0.005)


class Lamp:
    """A lamp process on a file."""

    def __init__(self, folder: Path) -> None:
        self.file, self.socket = folder / "lamp", str(folder / "s")
        self.settings = folder / "lamp.json"
        self.settings.write_text(
            json.dumps({"driver": "file", "file": str(self.file), "socket": self.socket})
        )
        self.processes: list[subprocess.Popen[str]] = []

    def start(self, **environment: str) -> subprocess.Popen[str]:
        self.processes.append(
            subprocess.Popen(
                [sys.executable, "-m", "bikeped.lamp", str(self.settings)],
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, **environment},
            )
        )
        return self.processes[-1]

    def send(self) -> subprocess.Popen[str]:
        """A process that says green."""
        self.processes.append(
            subprocess.Popen([sys.executable, "-c", SENDER, self.socket], text=True)
        )
        return self.processes[-1]

    def until(self, colour: str) -> None:
        def shows() -> bool:
            return self.file.exists() and self.file.read_text() == f"{colour}\n"

        until(shows, colour)

    def ask(self, **message: bool) -> dict[str, Any]:
        return ask_lamp(self.socket, message or {"status": True}, PATIENCE_S)


@pytest.fixture
def lamp(tmp_path: Path) -> Iterator[Lamp]:
    one = Lamp(tmp_path)
    yield one
    for process in one.processes:
        process.kill()
        process.wait()
        if process.stderr is not None:
            process.stderr.close()


def test_the_process_imports_nothing_but_the_standard_library() -> None:
    code = (
        "import sys, bikeped.lamp.process, bikeped.lamp.gpio, bikeped.lamp.usb\n"
        "print(*{name.partition('.')[0] for name in sys.modules} - sys.stdlib_module_names)"
    )
    told = subprocess.run(
        [
            sys.executable,
            "-I",
            "-S",
            "-c",
            f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{code}",
        ],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert set(told) <= {"bikeped", "__main__"}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_sender_that_falls_silent_is_fault(lamp: Lamp, number: int) -> None:
    lamp.start()
    lamp.until("orange")
    sender = lamp.send()
    lamp.until("green")
    sender.send_signal(number)
    lamp.until("orange")
    lamp.until("off")
    assert lamp.ask()["fault"] == "no heartbeat for 0.5 s"


def test_it_tells_the_service_manager_and_is_dark_after_its_end(lamp: Lamp) -> None:
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind("")
    manager.settimeout(PATIENCE_S)
    process = lamp.start(NOTIFY_SOCKET="@" + manager.getsockname()[1:].decode())
    assert manager.recv(100) == b"READY=1\nWATCHDOG=1"
    assert manager.recv(100) == b"WATCHDOG=1"
    manager.close()
    process.send_signal(signal.SIGHUP)
    lamp.ask()
    process.send_signal(signal.SIGTERM)
    assert process.wait(PATIENCE_S) == 0
    assert lamp.file.read_text() == "off\n"


def test_settings_that_come_later_are_found(lamp: Lamp) -> None:
    text = lamp.settings.read_text()
    lamp.settings.write_text(text[:20])
    process = lamp.start()
    assert process.stderr is not None
    assert "lamp.json: JSONDecodeError" in process.stderr.readline()
    lamp.settings.write_text(text)
    lamp.until("orange")


def test_two_colours_latch_over_a_restart_until_reset(lamp: Lamp) -> None:
    process = lamp.start()
    lamp.send()
    lamp.until("green")

    def spoil() -> bool:
        lamp.file.write_text("green red\n")
        return bool(lamp.ask()["latched"])

    until(spoil, "the latch")
    process.kill()
    process.wait()
    lamp.start()
    until(lambda: "conflict" in str(_latched(lamp)), "the latch of the next process")
    assert lamp.ask(reset=True)["latched"] is None
    lamp.until("green")


def _latched(lamp: Lamp) -> object:
    try:
        return lamp.ask()["latched"]
    except FeedbackError:
        return None


def test_a_second_process_does_not_take_the_lamp(lamp: Lamp) -> None:
    lamp.start()
    lamp.until("orange")
    second = lamp.start()
    assert second.stderr is not None
    assert "another lamp process serves it" in second.stderr.readline()
    assert lamp.ask()["error"] is None


@pytest.mark.parametrize("data", [b"", b"{", b"[" * 500, b"\xff", b'{"sent_s":1e400}', b"0" * 600])
def test_rubbish_is_fault_and_does_not_end_it(lamp: Lamp, data: bytes) -> None:
    process = lamp.start()
    lamp.send()
    lamp.until("green")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(data, lamp.socket)
    lamp.until("orange")
    lamp.until("green")
    assert process.poll() is None


class Broken:
    """A device that fails while `why` is set."""

    def __init__(self) -> None:
        self.why: Exception | None = None
        self.colour = Colour.OFF
        self.closed = 0

    def set(self, colour: Colour) -> None:
        if self.why:
            raise self.why
        self.colour = colour

    def mismatch(self, colour: Colour) -> str | None:
        return None

    def close(self) -> None:
        self.closed += 1
        raise FeedbackError("gone")


def test_a_device_that_fails_is_reported_and_opened_again(tmp_path: Path) -> None:
    device, now_s = Broken(), [0.0]

    def opened(settings: dict[str, Any]) -> LampDevice:
        return device

    one = LampProcess({"socket": str(tmp_path / "s")}, open_device=opened, clock=lambda: now_s[0])
    for why in (FeedbackError("unplugged"), RuntimeError("a bug")):
        device.why = why
        now_s[0] += 2.0
        one.serve()
        assert str(why) in str(one.status()["error"])
        device.why = None
        one.serve()
        assert one.status()["error"]
        now_s[0] += 1.1
        one.serve()
        assert one.status()["error"] is None
    assert device.closed == 2
    one.close()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({}, "no driver None"),
        ({"driver": "file"}, "KeyError: 'file'"),
        ({"driver": "gpio", "gpio": {}}, "no red lamp|AttributeError"),
        ({"driver": "usb", "usb": 3}, "TypeError"),
        ({"driver": "file", "file": "/nowhere/lamp"}, "lamp.file"),
    ],
)
def test_settings_that_drive_nothing_say_so(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(FeedbackError, match=said):
        open_device(settings).set(Colour.RED)


def test_the_client_reports_silence_latch_and_device(tmp_path: Path) -> None:
    now_s = [100.0]
    client = LampClient(str(tmp_path / "s"), clock=lambda: now_s[0])
    client.show(GREEN)  # before the start: nothing
    client.start()
    assert client.fault is None
    client.show(GREEN)
    assert client.errors == 1
    now_s[0] += 1.1
    assert client.fault is not None
    assert client.fault.code == "lamp.silent"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as process:
        process.bind(str(tmp_path / "s"))
        for status, code in (
            ({}, None),
            ({"latched": "conflict: x"}, "lamp.latched"),
            ({"latched": "flicker: x"}, "lamp.latched"),
            ({"error": "unplugged"}, "light.error"),
        ):
            client.show(GREEN)
            message, sender = process.recvfrom(512)
            assert json.loads(message)["colour"] == "green"
            process.sendto(b"rubbish", sender)
            client.show(GREEN)
            process.sendto(json.dumps(status).encode(), sender)
            client.show(GREEN)
            assert (client.fault.code if client.fault else None) == code
        client.show(Signal("OFF", Colour.OFF))
        assert not client.close()  # the last status is an error
    client.show(GREEN)
    assert client.close() is False


def test_one_step_answers_resets_and_keeps_what_is_latched(tmp_path: Path) -> None:
    latch = tmp_path / "s.latched"
    latch.write_text("conflict: two colours")
    settings = {"driver": "file", "file": str(tmp_path / "lamp"), "socket": str(tmp_path / "s")}
    lamp = LampProcess(settings)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
        asking.settimeout(PATIENCE_S)
        asking.bind(str(tmp_path / "me"))
        asking.sendto(b'{"status": true}', settings["socket"])
        lamp.serve()
        assert json.loads(asking.recv(4096))["latched"] == "conflict: two colours"
        asking.sendto(b'{"reset": true}', settings["socket"])
        lamp.serve()
        assert json.loads(asking.recv(4096))["latched"] is None
        lamp.serve()
        assert not latch.exists()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as nameless:
        for _ in range(40):  # more than are read at once; there is no address to answer
            nameless.sendto(b"rubbish", settings["socket"])
            lamp.serve()
    lamp.serve()
    assert latch.read_text().startswith("flicker")
    assert (tmp_path / "lamp").read_text().strip() in ("orange", "off")
    lamp.close()
    assert (tmp_path / "lamp").read_text() == "off\n"


def test_a_lamp_that_was_never_opened_is_closed_and_says_its_error_once(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    settings = {
        "driver": "file",
        "file": str(tmp_path / "none" / "f"),
        "socket": str(tmp_path / "s"),
    }
    clock = iter(range(0, 1000, 5))
    lamp = LampProcess(settings, clock=lambda: float(next(clock)))
    for _ in range(3):
        lamp.serve()
    assert "lamp.file" in str(lamp.status()["error"])
    lamp.close()
    assert capfd.readouterr().err.count("the light cannot be driven") == 1


@pytest.mark.parametrize("driver", ["file", "gpio", "usb"])
def test_the_settings_hold_what_the_driver_needs(tmp_path: Path, driver: str) -> None:
    path = tmp_path / "lamp.json"
    lamp = LampConfig(driver=driver, file="/tmp/f")  # type: ignore[arg-type]
    write_settings(path, lamp, FeedbackConfig())
    settings = json.loads(path.read_text())
    assert settings.keys() == {"driver", "socket", driver}


def test_the_service_manager_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.settimeout(PATIENCE_S)
        manager.bind(str(tmp_path / "n"))
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "n"))
        notify("READY=1")
        assert manager.recv(64) == b"READY=1"
    monkeypatch.delenv("NOTIFY_SOCKET")
    notify("READY=1")
