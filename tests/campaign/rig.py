"""What a row runs against: the service as a process, camera, light, broker, systemd's part."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from small_crossing import MOSQUITTO, PATIENCE_S, Broker, Service, write_config, write_model

from campaign.camera import LoopbackCamera
from campaign.light import REASSURING, FileWatch, LightTimeline
from campaign.registry import Result, Row, Skip

ROOT = Path(__file__).parents[2]
LAUNCH = (sys.executable, "-m", "campaign.launch")
WEB = "web: {enabled: true, port: 0}\n"
#: How long a row waits for what should come within seconds.
WAIT_S = 60.0


class Rig:
    """The bench of one row: makes what it needs, records what it measures, ends what it started."""

    def __init__(self, row: Row, repeat: int | None = None) -> None:
        self.result = Result(row)
        self._repeat = repeat or row.repeat
        self.folder = Path(tempfile.mkdtemp(prefix=f"bikeped-fault-{row.number}-"))
        self.light = LightTimeline(self.folder / "light")
        self.control_file = self.folder / "control"
        self._stack = contextlib.ExitStack()
        self._camera: LoopbackCamera | None = None
        self._model: Path | None = None
        self._lamp_started = False

    # --- what it records

    @property
    def repetitions(self) -> Iterator[int]:
        """Counts the repetitions that the row asks for."""
        for number in range(self._repeat):
            self.result.repetitions = number + 1
            yield number

    @property
    def last(self) -> int:
        """The number of the last repetition."""
        return self._repeat - 1

    def measure(self, name: str, value: float) -> float:
        """Records a figure of the row's limit `name`; the worst one is kept."""
        limit = next(limit for limit in self.result.row.limits if limit.name == name)
        worst = self.result.worst
        worst[name] = limit.worse(worst[name], value) if name in worst else value
        return value

    def expect(self, holds: bool, otherwise: str) -> bool:
        """Fails the row, with what was seen instead, unless `holds`."""
        if not holds and otherwise not in self.result.failures:
            self.result.failures.append(otherwise)
        return holds

    def saw(self, text: str) -> None:
        """Adds to what was seen."""
        self.result.seen.append(text)

    # --- what it gives

    @property
    def camera(self) -> LoopbackCamera:
        if self._camera is None:
            self._camera = LoopbackCamera()
            self._stack.callback(self._camera.close)
        return self._camera

    @property
    def model(self) -> Path:
        if self._model is None:
            self._model = write_model(self.folder / "pedestrian.onnx")
        return self._model

    def config(self, more: str = WEB, source: str | None = None, name: str = "pole.yaml") -> Path:
        """A whole configuration of the small camera; `source` None is the loopback camera."""
        if "feedback:" not in more:
            more += "feedback: {light: simulated}\n"
        more = more.replace("complete: true\n", "") + "complete: true\n"
        return write_config(
            self.folder / name, source or self.camera.address, self.model, more, picture=True
        )

    def lamp_config(self, more: str = WEB) -> Path:
        """A configuration whose light is a process of its own, which is started, too.

        Its file keeps the lamp's state; a thread notes every change with its time.
        """
        state = self.folder / "lamps"
        lamp = (
            "feedback: {light: lamp}\n"
            f"lamp: {{driver: file, file: {state}, socket: {self.folder}/lamp.socket}}\n"
        )
        config = self.config(more + lamp)
        if not self._lamp_started:
            self._lamp_started = True
            self.popen("lamp", "-c", config)
            watch = FileWatch(state, self.light.path)
            self._stack.callback(watch.close)
        return config

    def popen(self, *arguments: object, **options: Any) -> subprocess.Popen[bytes]:
        """Starts a command of bikeped; its output goes into a file unless `options` say so."""
        with (self.folder / f"{arguments[0]}.log").open("ab") as log:
            process = subprocess.Popen(
                [*LAUNCH, "bikeped.cli.main", *map(str, arguments)],
                env={**os.environ, **self.environment()},
                cwd=self.folder,
                **{"stdout": log, "stderr": log, **options},
            )
        self._stack.callback(process.wait)  # after its end, which comes first: LIFO
        self._stack.callback(process.kill)
        return process

    def control(self, text: str = "") -> float:
        """Tells the seam inside the service what to do; returns the time."""
        fresh = self.control_file.with_suffix(".new")
        fresh.write_text(text)
        fresh.replace(self.control_file)
        return time.monotonic()

    def environment(self, seam: str = "") -> dict[str, str]:
        """The variables under which `campaign.launch` runs."""
        return {
            "CAMPAIGN_LIGHT": str(self.light.path),
            "CAMPAIGN_CONTROL": str(self.control_file),
            "CAMPAIGN_SEAM": seam,
            "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT)]),
            "PYTHONUNBUFFERED": "1",
        }

    def start(self, config: Path | None = None, *options: str, seam: str = "") -> Running:
        """Starts the service; `options` are `key=value` for `--set`."""
        running = Running(
            self.light,
            config or self.config(),
            *[part for option in options for part in ("--set", option)],
            starter=(*LAUNCH, "bikeped.cli.main"),
            environment=self.environment(seam),
            cwd=self.folder,
        )
        self._stack.callback(running.close)
        return running

    def supervise(self, config: Path | None = None, seam: str = "") -> Supervisor:
        """Starts the service as its systemd unit says."""
        supervisor = Supervisor(config or self.config(), self.environment(seam), self.folder)
        self._stack.callback(supervisor.close)
        return supervisor

    def broker(self, *lines: str) -> Broker:
        """A mosquitto, started."""
        if MOSQUITTO is None:
            raise Skip("mosquitto is not installed")
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        broker = Broker(folder, lines or ("allow_anonymous true",))
        broker.start()
        self._stack.callback(broker.kill)
        return broker

    def bikeped(
        self, *arguments: object, timeout_s: float = WAIT_S
    ) -> subprocess.CompletedProcess[str]:
        """Runs a command to its end; TimeoutExpired after `timeout_s`."""
        return subprocess.run(
            [sys.executable, "-m", "bikeped.cli.main", *map(str, arguments)],
            capture_output=True, text=True, timeout=timeout_s, cwd=self.folder, check=False,
        )  # fmt: skip

    def callback(self, function: Callable[..., object], *arguments: Any) -> None:
        """Calls `function` at the end of the row."""
        self._stack.callback(function, *arguments)

    # --- the usual course of a row

    def fault(
        self, inject: Callable[[], object], *, name: str = "FAULT", wait_s: float = 10.0
    ) -> float:
        """Injects; measures the time until FAULT's orange shows. Returns the time of injection."""
        began_s = time.monotonic()
        inject()
        self.measure(name, self.light.until(("orange",), began_s, wait_s))
        return began_s

    def not_reassuring(self, from_s: float, to_s: float | None = None) -> None:
        """Expects neither green nor blue from a time on."""
        shown_s = self.light.reassured_s(from_s, to_s or time.monotonic())
        self.expect(shown_s == 0.0, f"green or blue for {shown_s:.1f} s during the fault")

    def ready(self, since_s: float, *, name: str | None = "ready", wait_s: float = WAIT_S) -> float:
        """Measures the time from `since_s` until the light reassures again."""
        delay_s = self.light.until(REASSURING, since_s, wait_s)
        return self.measure(name, delay_s) if name else delay_s

    def close(self) -> None:
        with self._stack:
            pass
        shutil.rmtree(self.folder, ignore_errors=True)


class Running(Service):
    """A service with its light."""

    def __init__(self, light: LightTimeline, *arguments: Any, **options: Any) -> None:
        self.light = light
        self.began_s = time.monotonic()
        super().__init__(*arguments, **options)

    def settle(self, wait_s: float = WAIT_S) -> float:
        """Waits until the light reassures; returns the seconds since the start."""
        # A light that keeps its colour may show the last service's: FAULT comes first.
        delay_s = self.light.until(("orange",), self.began_s, wait_s)
        delay_s += self.light.until(REASSURING, self.began_s + min(delay_s, wait_s), wait_s)
        if delay_s > 2 * wait_s:
            raise RuntimeError(f"the service did not come up:\n{self.log[-3000:]}")
        return delay_s

    def events(self, pattern: str) -> int:
        """How many lines of the log match."""
        return sum(re.search(pattern, line) is not None for line in self.lines)

    @property
    def address(self) -> str:
        return "http://127.0.0.1:" + self.until_said(r"serving http://127\.0\.0\.1:(\d+)")[1]

    def health(self) -> tuple[int, dict[str, Any]]:
        """Status and message of /healthz."""
        try:
            answer = urllib.request.urlopen(f"{self.address}/healthz", timeout=PATIENCE_S)
        except urllib.error.HTTPError as error:
            answer = error
        with answer:
            return int(answer.status), json.load(answer)

    def until_health(
        self, wanted: Callable[[dict[str, Any]], bool], timeout_s: float = WAIT_S
    ) -> float:
        """Seconds until the health message is as wanted; infinite after `timeout_s`."""
        began_s = time.monotonic()
        while (waited_s := time.monotonic() - began_s) < timeout_s:
            if wanted(self.health()[1]):
                return waited_s
            time.sleep(0.05)
        return float("inf")


class Supervisor:
    """Keeps a service running as deploy/bikeped.service says: watchdog, stop command, restart."""

    def __init__(self, config: Path, environment: Mapping[str, str], folder: Path) -> None:
        unit = (ROOT / "deploy/bikeped.service").read_text()
        self._config, self._environment, self._folder = config, environment, folder
        self._start = self._command(_last(unit, "ExecStart"))
        self._after = (
            self._command(_last(unit, "ExecStopPost")) if "ExecStopPost=" in unit else None
        )
        self._pause_s = float(_last(unit, "RestartSec").removesuffix("s"))
        self._watchdog_s = float(_last(unit, "WatchdogSec").removesuffix("s"))
        self._abort_s = float(_last(unit, "TimeoutAbortSec").removesuffix("s"))
        self.log = folder / "service.log"
        self.began_s = time.monotonic()
        self.starts: list[float] = []
        self.ends: list[tuple[float, int]] = []
        self.process: subprocess.Popen[bytes] | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def next_start(self, since_s: float) -> float:
        """Waits for the first start after `since_s`; returns its time, infinite after WAIT_S."""
        while time.monotonic() - since_s < WAIT_S:
            for at_s in list(self.starts):
                if at_s > since_s:
                    return at_s
            time.sleep(0.02)
        return float("inf")

    def as_after_an_hour(self) -> None:
        """Forgets early ends and silences, which make the pauses of service and lamp grow."""
        (self._folder / "state" / "starts.json").unlink(missing_ok=True)
        command = [sys.executable, "-m", "bikeped.cli.main", "lamp", "reset", "-c", self._config]
        subprocess.run(command, check=False, capture_output=True, cwd=self._folder)

    def _command(self, line: str) -> Sequence[str]:
        """A line of the unit with this machine's paths, run through `campaign.launch`."""
        line = line.lstrip("-").replace("/etc/bikeped/config.yaml", str(self._config))
        line = line.replace("/var/lib/bikeped", str(self._folder / "state"))
        program, *arguments = shlex.split(line)
        if Path(program).name == "bikeped":
            return (*LAUNCH, "bikeped.cli.main", *arguments)
        return (*LAUNCH, *arguments[1:])  # python -m MODULE

    def _run(self) -> None:
        (self._folder / "state").mkdir(exist_ok=True)
        while not self._closing.is_set():
            name = f"@bikeped-campaign-{uuid.uuid4().hex}"
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
                manager.bind("\0" + name[1:])
                self._one_life(manager, {**os.environ, **self._environment, "NOTIFY_SOCKET": name})
            if not self._closing.is_set() and self._after is not None:
                self._call(self._after)
            self._closing.wait(self._pause_s)

    def _one_life(self, manager: socket.socket, environment: Mapping[str, str]) -> None:
        with self.log.open("ab") as log:
            self.starts.append(time.monotonic())
            self.process = subprocess.Popen(
                self._start, stdout=log, stderr=log, env=environment, cwd=self._folder
            )
        heard_s, watched = time.monotonic(), False
        manager.settimeout(0.05)
        while self.process.poll() is None and not self._closing.is_set():
            with contextlib.suppress(TimeoutError, socket.timeout):
                message = manager.recv(4096).decode()
                heard_s = time.monotonic() if "WATCHDOG=1" in message else heard_s
                watched = watched or "READY=1" in message
            if watched and time.monotonic() - heard_s > self._watchdog_s:
                self.process.send_signal(signal.SIGABRT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self.process.wait(self._abort_s)
                self.process.kill()
        if self._closing.is_set():
            self.process.kill()
        self.ends.append((time.monotonic(), self.process.wait()))

    def _call(self, command: Sequence[str]) -> None:
        with self.log.open("ab") as log:
            subprocess.run(
                command, stdout=log, stderr=log, check=False, timeout=PATIENCE_S,
                env={**os.environ, **self._environment, "CAMPAIGN_SEAM": ""}, cwd=self._folder,
            )  # fmt: skip

    def close(self) -> None:
        self._closing.set()
        self._thread.join(PATIENCE_S)


def _last(unit: str, key: str) -> str:
    return re.findall(rf"(?m)^{key}=(.*)$", unit)[-1]
