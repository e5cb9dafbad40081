"""The checks of `bikeped doctor`: each on its own, each bounded in time, none trusting another.

A check returns a `Finding` or raises; what it raises becomes a `fail`. `fail` means that the
service cannot do its work, `warn` that it does, but somebody should look.
"""

from __future__ import annotations

import datetime as dt
import math
import os
import queue
import shutil
import statistics
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from bikeped.capture import open_source
from bikeped.capture.jpeg import JpegDecoder
from bikeped.config import LoadedConfig
from bikeped.errors import BikepedError, CaptureError
from bikeped.feedback import open_light
from bikeped.feedback.light import LAMP_COLOURS
from bikeped.feedback.sounds import make_wav
from bikeped.models import BUNDLED, NOT_FOR_STREETS
from bikeped.pipeline.application import load_detector_pool
from bikeped.pipeline.detection_stage import DecodedFrame
from bikeped.pipeline.ground_mapper import GroundMapper
from bikeped.telemetry.mqtt_auth import load_credentials
from bikeped.telemetry.mqtt_connection import BrokerConnection
from bikeped.types import Frame, Sound

Status = Literal["ok", "warn", "fail", "skipped"]

LOOK_S = 1.0  #: how long frames are counted
LAMP_S = 0.4  #: how long each colour shows
LEAST_YEAR = 2025  #: a clock before this was never set
HOT_C = 85.0  #: a Jetson slows itself down somewhat above this
MB = 1_000_000


@dataclass(frozen=True)
class Finding:
    """What one check found; `remedy` says what to do."""

    name: str
    status: Status
    detail: str
    remedy: str = ""


@dataclass(frozen=True)
class Check:
    """One check, and the longest that it may take in seconds."""

    name: str
    function: Callable[[LoadedConfig], Finding]
    limit_s: float


def checks(*, light: bool = True, sound: bool = True) -> tuple[Check, ...]:
    """All checks in the order of the table; without `light` no lamp is touched."""
    return (
        Check("configuration", check_configuration, 60),
        Check("camera", check_camera, 30),
        # Building an engine for the first time takes minutes.
        Check("model", check_model, 1800),
        Check("light", check_light if light else _left_out("light", "--no-light"), 15),
        Check("speaker", check_speaker if sound else _left_out("speaker", "--no-sound"), 15),
        Check("broker", check_broker, 15),
        Check("clock", check_clock, 10),
        Check("disk", check_disk, 10),
        Check("machine", check_machine, 10),
    )


def run_checks(loaded: LoadedConfig, todo: tuple[Check, ...]) -> Iterator[Finding]:
    """The findings one by one. A check that hangs is left behind in its thread."""
    for check in todo:
        yield _bounded(check, loaded)


def _bounded(check: Check, loaded: LoadedConfig) -> Finding:
    answers: queue.SimpleQueue[Finding] = queue.SimpleQueue()

    def work() -> None:
        try:
            answers.put(check.function(loaded))
        except BikepedError as error:
            answers.put(Finding(check.name, "fail", *_split(str(error))))
        except Exception as error:  # noqa: BLE001 - one check must not end the others
            text = f"unexpected {type(error).__name__}: {error}"
            answers.put(Finding(check.name, "fail", text, "report this"))

    threading.Thread(target=work, name=f"doctor-{check.name}", daemon=True).start()
    try:
        return answers.get(timeout=check.limit_s)
    except queue.Empty:
        return Finding(
            check.name, "fail", f"no answer within {check.limit_s:g} s", "unplug it, or restart"
        )


def check_configuration(loaded: LoadedConfig) -> Finding:
    """Whether lens, framing and ground fit together."""
    camera = GroundMapper(loaded).camera
    return Finding(
        "configuration",
        "ok",
        f"{loaded.source}, {loaded.hash[:12]}; {camera.lens.projection}, "
        f"f = {camera.lens.focal_px:.1f} px, {camera.height_m:g} m up, pitch "
        f"{camera.pitch_deg:g} degrees",
    )


def check_camera(loaded: LoadedConfig) -> Finding:
    """Opens the camera, reads for a second, decodes the last frame."""
    camera = loaded.config.camera
    try:
        frames, seconds, promised, live = _look(loaded)
    except CaptureError as error:
        return _held_by_service("camera", *_split(str(error)))
    last = frames[-1]
    GroundMapper(loaded).framing_for(last.width, last.height)
    began = time.perf_counter()
    if last.jpeg is not None:
        JpegDecoder().decode(last.jpeg)
    decode_ms = (time.perf_counter() - began) * 1e3
    what = f"{camera.source}: {last.width} x {last.height}"
    if not live:
        return Finding(
            "camera",
            "warn",
            f"{what}, a recording",
            "set camera.source to the camera, once there is one",
        )
    fps = (len(frames) - 1) / seconds if len(frames) > 1 else 0.0
    detail = f"{what}, {fps:.1f} frames/s measured, {promised:g} granted, decoded in "
    detail += f"{decode_ms:.1f} ms"
    if fps < 0.8 * camera.fps:
        return Finding(
            "camera",
            "warn",
            detail,
            f"camera.fps asks for {camera.fps:g}: is it dark (long exposure), is the cable USB 3?",
        )
    return Finding("camera", "ok", detail)


def _look(loaded: LoadedConfig) -> tuple[list[Frame], float, float, bool]:
    """Frames of a second (or of a recording), the time they took, the promised rate, live?"""
    camera = loaded.config.camera
    with open_source(
        camera.source,
        width=camera.width,
        height=camera.height,
        fps=camera.fps,
        fourcc=camera.fourcc,
    ) as source:
        frames: list[Frame] = []
        began = ended = time.monotonic()
        while ended - began < LOOK_S:
            frame = source.read()
            if frame is None:
                break
            if not frames:
                began = time.monotonic()  # the first frame comes with what starting a camera takes
            # Only the last one's picture is looked at.
            frames = [*frames[-1000:], frame]
            ended = time.monotonic()
        if not frames:
            raise CaptureError(f"{camera.source}: holds no frame; set camera.source to another")
        return frames, max(ended - began, 1e-9), source.fps, source.live


def check_model(loaded: LoadedConfig) -> Finding:
    """Loads the model and looks at a grey frame a few times."""
    camera = loaded.config.camera
    began = time.perf_counter()
    detector = load_detector_pool(loaded)
    loaded_s = time.perf_counter() - began
    width, height = detector.decode_size(camera.width, camera.height)
    rgb = np.full((height, width, 3), 114, np.uint8)
    frame = Frame(0, 0.0, camera.width, camera.height, rgb=rgb)
    times = []
    for _ in range(5):
        began = time.perf_counter()
        detector.detect(DecodedFrame(frame, rgb, began, 0.0, 0.0))
        times.append((time.perf_counter() - began) * 1e3)
    ms = statistics.median(times)
    detail = f"{detector.name}: {ms:.1f} ms a frame, loaded in {loaded_s:.1f} s"
    if loaded.config.detection.model == BUNDLED:
        return Finding("model", "warn", f"{detail}; {NOT_FOR_STREETS}", "name a model of real ones")
    if ms > 1e3 / camera.fps:
        return Finding(
            "model",
            "warn",
            detail,
            f"slower than {camera.fps:g} frames/s: use the GPU (detection.providers) or a smaller "
            "model",
        )
    return Finding("model", "ok", detail)


def check_light(loaded: LoadedConfig) -> Finding:
    """Shows every colour briefly, then darkens the light."""
    feedback = loaded.config.feedback
    try:
        light = open_light(feedback)
        try:
            for colour in LAMP_COLOURS:
                light.set(colour)
                time.sleep(LAMP_S)
        finally:
            light.close()
    except BikepedError as error:
        return _held_by_service("light", *_split(str(error)))
    if feedback.light == "simulated":
        return Finding("light", "warn", "simulated: nobody sees it", "set feedback.light")
    names = ", ".join(colour.value for colour in LAMP_COLOURS)
    return Finding("light", "ok", f"{feedback.light} answers; did you see {names}, then dark?")


def check_speaker(loaded: LoadedConfig) -> Finding:
    """Plays the chime."""
    sound = loaded.config.feedback.sound
    if not sound.enabled:
        return Finding("speaker", "skipped", "feedback.sound.enabled is false")
    program = shutil.which("aplay")
    if program is None:
        return Finding("speaker", "fail", "aplay is not installed", "apt-get install alsa-utils")
    done = subprocess.run(
        [program, "-q", "-D", sound.device],
        input=make_wav(Sound.CHIME, sound.volume),
        capture_output=True,
        timeout=10,
        check=False,
    )
    if done.returncode != 0:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines() or ["no message"]
        return Finding(
            "speaker",
            "fail",
            f"{sound.device}: {said[-1]}",
            "set feedback.sound.device to one that `aplay -L` lists",
        )
    return Finding("speaker", "ok", f"{sound.device}: did you hear the chime?")


def check_broker(loaded: LoadedConfig) -> Finding:
    """Connects to the broker, under a name of its own: the service's connection stays."""
    mqtt = loaded.config.mqtt
    if not mqtt.enabled:
        return Finding("broker", "skipped", "mqtt.enabled is false")
    connection = BrokerConnection(
        mqtt,
        load_credentials(mqtt, loaded.base_dir),
        client_id=f"bikeped-doctor-{os.getpid()}",
        timeout_s=5.0,
    )
    began = time.perf_counter()
    try:
        connection.open()
    except OSError as error:
        return Finding(
            "broker",
            "warn",  # the crossing is watched all the same
            f"{mqtt.host}:{mqtt.port}: {' '.join(str(error).split())}",
            "check mqtt.host, mqtt.port, mqtt.username, mqtt.tls, and that the broker runs",
        )
    finally:
        connection.close()
    took_ms = (time.perf_counter() - began) * 1e3
    return Finding("broker", "ok", f"{mqtt.host}:{mqtt.port} answers in {took_ms:.0f} ms")


def check_clock(_loaded: LoadedConfig) -> Finding:
    """Whether time stamps in messages and logs can be right."""
    now = dt.datetime.now(dt.timezone.utc)
    text = f"{now:%Y-%m-%d %H:%M} UTC"
    remedy = "timedatectl set-ntp true; is there a network, or a battery for the clock?"
    if now.year < LEAST_YEAR:
        return Finding("clock", "warn", f"{text}: was never set", remedy)
    synchronised = _said_by("timedatectl", "show", "--property=NTPSynchronized", "--value")
    if synchronised is None:
        return Finding("clock", "ok", f"{text}; synchronisation unknown (no timedatectl)")
    if synchronised != "yes":
        return Finding("clock", "warn", f"{text}, not synchronised", remedy)
    return Finding("clock", "ok", f"{text}, synchronised")


def check_disk(loaded: LoadedConfig) -> Finding:
    """Whether the audit log has room and may be written."""
    audit = loaded.config.audit
    if audit.path is None:
        return Finding("disk", "skipped", "audit.path is null: no audit log")
    path = loaded.base_dir / audit.path
    folder = path.parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    free_mb = shutil.disk_usage(folder).free / MB
    detail = f"{path}: {free_mb:.0f} MB free"
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        return Finding(
            "disk",
            "warn",
            f"{path}: {folder} cannot be written",
            "set audit.path to a folder that the service may write",
        )
    if free_mb < audit.min_free_mb:
        return Finding(
            "disk",
            "warn",
            f"{detail}, audit.min_free_mb is {audit.min_free_mb:g}: nothing is logged",
            "make room",
        )
    full_mb = audit.max_mb * (audit.keep + 1)
    if free_mb - full_mb < audit.min_free_mb and not path.exists():
        return Finding(
            "disk",
            "warn",
            f"{detail}, the log may grow to {full_mb:.0f} MB",
            "lower audit.max_mb or audit.keep",
        )
    return Finding("disk", "ok", detail)


def check_machine(_loaded: LoadedConfig, zones: Path = Path("/sys/class/thermal")) -> Finding:
    """Temperature, and the Jetson's power mode, as far as they can be read."""
    hottest = max((t for t in map(_celsius, zones.glob("thermal_zone*/temp"))), default=-math.inf)
    said = []
    if math.isfinite(hottest):
        said.append(f"{hottest:.0f} degrees C")
    mode = _said_by("nvpmodel", "-q")
    if mode:
        said.append(" ".join(mode.split()))
    if not said:
        return Finding("machine", "skipped", "temperature and power mode cannot be read here")
    if hottest > HOT_C:
        return Finding("machine", "warn", "; ".join(said), "give the box shade and air")
    return Finding("machine", "ok", "; ".join(said))


def _celsius(file: Path) -> float:
    try:
        return int(file.read_text()) / 1000
    except (OSError, ValueError):  # a sensor that is switched off
        return -math.inf


def _said_by(program: str, *arguments: str) -> str | None:
    """What a program prints; None when it is not there or fails."""
    path = shutil.which(program)
    if path is None:
        return None
    try:
        done = subprocess.run(
            [path, *arguments], capture_output=True, timeout=5, check=False, text=True
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _held_by_service(name: str, detail: str, remedy: str) -> Finding:
    """A device that cannot be had: no failure where it is the running service that has it."""
    if _said_by("systemctl", "is-active", "bikeped") == "active":
        return Finding(
            name, "warn", detail, "the running service may hold it: systemctl stop bikeped"
        )
    return Finding(name, "fail", detail, remedy)


def _split(message: str) -> tuple[str, str]:
    """An error's message as what is wrong, and what mends it: they are parted by a semicolon."""
    detail, _, remedy = " ".join(message.split()).partition("; ")
    return detail, remedy


def _left_out(name: str, option: str) -> Callable[[LoadedConfig], Finding]:
    return lambda _loaded: Finding(name, "skipped", f"left out by {option}")
