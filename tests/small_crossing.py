"""A small crossing that every service and command-line test can afford, and what runs beside it.

Pictures, clip, model and configuration of a camera of 96 x 64; `bikeped run` as a process; a real
mosquitto. Shared by the tests and the fault campaign (tests/campaign).
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import simplejpeg
from onnx import TensorProto, helper, numpy_helper

from bikeped.lab.rendering.clip import AviWriter

MOSQUITTO = shutil.which("mosquitto", path="/usr/local/sbin:/usr/sbin:/usr/local/bin:/usr/bin")
DEADLINE_S = 30.0  # generous: reached only by a failure
PATIENCE_S = 40.0
SIZE = (96, 64)
BIKEPED = (sys.executable, "-m", "bikeped.cli.main")

SMALL_CONFIG = """
camera:
  source: {source}
  width: 96
  height: 64
  projection: perspective
  pad_size: null
  crop_size: null
  radius_px: 58
  fov_deg: 73
  height_m: 5.0
  pitch_deg: -35
monitor: {{picture: {picture}}}
detection: {{model: {model}, providers: [cpu], threads: 1, rider_overlap: 1.0}}
mqtt:
  health_interval_s: 0.2
"""


def small_pictures() -> list[bytes]:
    """Eight JPEG pictures of 96 x 64 that differ."""
    v, u = np.mgrid[0:64, 0:96]
    pictures = []
    for n in range(8):
        rgb = np.stack([u * 2, v * 3, (u + v + 20 * n) % 200], axis=2).astype(np.uint8)
        pictures.append(simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), colorspace="RGB"))
    return pictures


def write_clip(path: Path, frames: int, pictures: Sequence[bytes], fps: int = 30) -> Path:
    """Writes a Motion JPEG AVI; `pictures` are used in turn."""
    with AviWriter(path, fps, SIZE) as clip:
        for number in range(frames):
            clip.write(pictures[number % len(pictures)])
    return path


def write_model(path: Path) -> Path:
    """A real ONNX model that sees one pedestrian, 7 m ahead, in every picture."""
    anchors = 12 * 8 + 6 * 4 + 3 * 2  # of strides 8, 16 and 32 on 96 x 64
    answer = np.zeros((1, 4 + 2, anchors), np.float32)
    answer[0, :, 5] = (48, 22, 10, 26, 0.9, 0.0)  # cx cy w h, person, bicycle
    graph = helper.make_graph(
        [helper.make_node("Identity", ["answer"], ["output0"])],
        "one pedestrian",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 96))],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, answer.shape)],
        [numpy_helper.from_array(answer, "answer")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    for key, value in {
        "names": "{0: 'person', 1: 'bicycle'}",
        "task": "detect",
        "imgsz": "[64, 96]",
    }.items():
        model.metadata_props.add(key=key, value=value)
    onnx.save(model, path)
    return path


def write_config(
    path: Path, source: Path | str, model: Path | str, more: str = "", *, picture: bool = False
) -> Path:
    """Writes the small camera's configuration; `more` are lines of YAML after section mqtt.

    `picture`: whether the pictures' health is judged.
    """
    text = SMALL_CONFIG.format(source=source, model=model, picture=str(picture).lower())
    if "feedback:" not in more:
        more += "feedback: {light: simulated}\n"
    path.write_text(text + more, encoding="utf-8")
    return path


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Broker:
    """One mosquitto process on one port; can be killed and started again."""

    def __init__(self, directory: Path, lines: tuple[str, ...] = ("allow_anonymous true",)) -> None:
        assert MOSQUITTO is not None
        self.directory = directory
        self.port = free_port()
        # Started as root it would otherwise become a user who cannot read the test's files.
        options = ("user root", "persistence false", f"listener {self.port} 127.0.0.1", *lines)
        self.config = directory / "mosquitto.conf"
        self.config.write_text("\n".join(options) + "\n")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with (self.directory / "mosquitto.log").open("ab") as output:
            self.process = subprocess.Popen(
                [str(MOSQUITTO), "-c", str(self.config)], stdout=output, stderr=output
            )
        deadline = time.monotonic() + DEADLINE_S
        while True:
            with contextlib.suppress(OSError):
                socket.create_connection(("127.0.0.1", self.port), 1).close()
                return
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError((self.directory / "mosquitto.log").read_text())

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


class Service:
    """A `bikeped run` process, its log as it comes, and what it tells the service manager."""

    def __init__(
        self,
        config: Path,
        *options: str,
        program: str | None = None,
        starter: Sequence[str] = BIKEPED,
        environment: Mapping[str, str] | None = None,
        cwd: Path | None = None,
    ) -> None:
        """`program`: Python source that stands for `bikeped`; `starter`: another command."""
        name = f"@bikeped-test-{uuid.uuid4().hex}"
        self.manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.manager.bind("\0" + name[1:])
        self.manager.settimeout(PATIENCE_S)
        start = [sys.executable, "-c", program] if program else starter
        self.process = subprocess.Popen(
            [*start, "run", "-c", str(config), *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "NOTIFY_SOCKET": name, **(environment or {})},
            cwd=cwd,
        )
        self.lines: list[str] = []
        self._news = threading.Condition()
        self._ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._news:
                self.lines.append(line.rstrip())
                self._news.notify()
        with self._news:
            self._ended = True
            self._news.notify()

    @property
    def log(self) -> str:
        return "\n".join(self.lines)

    def until_said(self, pattern: str) -> re.Match[str]:
        def found() -> re.Match[str] | None:
            return re.search(pattern, self.log)

        with self._news:
            self._news.wait_for(lambda: found() or self._ended, PATIENCE_S)
        match = found()
        assert match, f"{pattern!r} was not said:\n{self.log}"
        return match

    def until_told(self, message: str) -> None:
        while message not in self.manager.recv(4096).decode().split("\n"):
            pass

    def stop(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        status = self.process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        return status

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join(PATIENCE_S)
        assert self.process.stdout is not None
        self.process.stdout.close()
        self.manager.close()
