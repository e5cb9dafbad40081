"""The checks of `bikeped doctor`: independent of one another, each bounded in time.

A check returns a `Finding` or raises; what it raises becomes a `fail`. `fail` means that the
service cannot work, `warn` that it works, but a person should look into it.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import math
import os
import shutil
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from bikeped.capture import open_source
from bikeped.capture.jpeg import JpegDecoder
from bikeped.capture.source_names import shown_source
from bikeped.config.load import LoadedConfig
from bikeped.errors import BikepedError, CaptureError
from bikeped.feedback import open_light
from bikeped.feedback.lamp_client import ask_lamp
from bikeped.feedback.sounds import make_wav
from bikeped.lamp.colours import LAMP_COLOURS
from bikeped.models import BUNDLED, NOT_FOR_STREETS
from bikeped.pipeline.application import load_detector_pool
from bikeped.pipeline.detection_scheduler import DecodedFrame
from bikeped.pipeline.runtime import WorkerThread
from bikeped.pipeline.track_and_decide import GroundMapper
from bikeped.telemetry.mqtt_connection import BrokerConnection, load_credentials
from bikeped.types import Frame, Sound

Status = Literal["ok", "warn", "fail", "skipped"]

MEASURE_S = 1.0  #: how long frames are counted
LAMP_S = 0.4  #: how long each colour shows
FIRST_YEAR = 2025  #: a clock before this was never set
HOT_C = 85.0  #: a Jetson throttles a few degrees above this
MB = 1_000_000
BESIDE_SERVICE_S = 18.0  #: all checks, while a service runs


@dataclass(frozen=True)
class Finding:
    """What one check found; `remedy` says what to do. `run_checks` fills the name in."""

    status: Status
    detail: str
    remedy: str = ""
    name: str = ""


#: Name of a check, its function, and the longest that it may take in seconds.
Check = tuple[str, Callable[[LoadedConfig], Finding], float]


def checks(
    *, light: bool = True, sound: bool = True, beside: tuple[str, int] | None = None
) -> tuple[Check, ...]:
    """All checks in the order of the table; without `light` no lamp is touched.

    `beside` a running service (what it holds, and its pid) nothing that it may hold is touched, and
    all together take at most `BESIDE_SERVICE_S`.
    """
    skip = None
    if beside is not None:
        held = f"{beside[0]} is in use by the running service (pid {beside[1]})"
        skip = _skip(held, "its pages, /healthz and MQTT say how it does")
    shine = check_light if light else _skip("left out by --no-light")
    play = check_speaker if sound else _skip("left out by --no-sound")
    found: tuple[Check, ...] = (
        ("configuration", check_configuration, 60),
        ("camera", skip or check_camera, 30),
        # Building an engine for the first time takes minutes.
        ("model", skip or check_model, 1800),
        ("light", skip or shine, 15),
        ("speaker", skip or play, 15),
        ("broker", partial(check_broker, timeout_s=1.5) if skip else check_broker, 15),
        ("clock", check_clock, 10),
        ("disk", check_disk, 10),
        ("machine", check_machine, 10),
    )
    most_s = math.inf if skip is None else BESIDE_SERVICE_S / len(found)
    return tuple((name, check, min(limit_s, most_s)) for name, check, limit_s in found)


def _skip(why: str, remedy: str = "") -> Callable[[LoadedConfig], Finding]:
    return lambda _loaded: Finding("skipped", why, remedy)


def run_checks(loaded: LoadedConfig, todo: Iterable[Check]) -> Iterator[Finding]:
    """The findings one by one. A check that hangs is left behind in its thread."""
    for name, function, limit_s in todo:
        try:
            finding = asyncio.run(_run_bounded(function, loaded, limit_s))
        except BikepedError as error:
            finding = _failed(error)
        except Exception as error:  # noqa: BLE001 - one check must not end the others
            text = f"unexpected {type(error).__name__}: {error}"
            finding = Finding("fail", text, "report this")
        yield replace(finding, name=name)


async def _run_bounded(
    function: Callable[[LoadedConfig], Finding], loaded: LoadedConfig, limit_s: float
) -> Finding:
    worker = WorkerThread("doctor")
    answer = worker.submit(function, loaded)
    await asyncio.wait({answer}, timeout=limit_s)
    await worker.close(0.0)
    if answer.cancel():
        text = f"no answer within {limit_s:g} s"
        return Finding("fail", text, "unplug the device, or restart")
    return answer.result()


def check_configuration(loaded: LoadedConfig) -> Finding:
    """Whether lens, framing and ground fit together."""
    camera = GroundMapper(loaded).camera
    lens = f"{camera.lens.projection}, f = {camera.lens.focal_px:.1f} px"
    pose = f"{camera.height_m:g} m up, pitch {camera.pitch_deg:g} degrees"
    return Finding("ok", f"{loaded.source}, {loaded.hash[:12]}; {lens}, {pose}")


def check_camera(loaded: LoadedConfig) -> Finding:
    """Opens the camera, reads for a second, decodes the last frame."""
    camera = loaded.config.camera
    name = shown_source(camera.source)
    try:
        with open_source(camera, base_dir=loaded.base_dir) as source:
            last, more = source.read(), 0
            # Counted from the first frame on, which comes with what starting a camera takes.
            began = ended = time.monotonic()
            while ended - began < MEASURE_S and (frame := source.read()) is not None:
                last, more, ended = frame, more + 1, time.monotonic()
        if last is None:
            raise CaptureError(f"{name}: holds no frame; set camera.source to another")
    except CaptureError as error:
        return _failed(error, device=True)
    GroundMapper(loaded).framing_for(last.width, last.height)
    decoding = time.perf_counter()
    if last.jpeg is not None:
        JpegDecoder().decode(last.jpeg)
    decode_ms = (time.perf_counter() - decoding) * 1e3
    what = f"{name}: {last.width} x {last.height}"
    if not source.live:
        return Finding("warn", f"{what}, a recording", "set camera.source to a camera")
    fps = more / max(ended - began, 1e-9)
    rate = f"{fps:.1f} frames/s measured, {source.fps:g} granted"
    detail = f"{what}, {rate}, decoded in {decode_ms:.1f} ms"
    if fps < 0.8 * camera.fps:
        remedy = f"camera.fps asks for {camera.fps:g}: is it dark (long exposure), the cable USB 3?"
        return Finding("warn", detail, remedy)
    return Finding("ok", detail)


def check_model(loaded: LoadedConfig) -> Finding:
    """Loads the model and times it on a grey frame."""
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
        remedy = "set detection.model to one trained on real streets"
        return Finding("warn", f"{detail}; {NOT_FOR_STREETS}", remedy)
    if ms > 1e3 / camera.fps:
        remedy = "use the GPU (detection.providers) or a smaller model"
        return Finding("warn", f"{detail}, slower than {camera.fps:g} frames/s", remedy)
    return Finding("ok", detail)


def check_light(loaded: LoadedConfig) -> Finding:
    """Shows every colour briefly, then darkens the light."""
    feedback = loaded.config.feedback
    try:
        if feedback.light == "lamp":  # which owns the lines: no other process may drive them
            return _check_lamp(loaded.config.lamp.socket)
        with contextlib.closing(open_light(feedback)) as light:
            for colour in LAMP_COLOURS:
                light.set(colour)
                time.sleep(LAMP_S)
    except BikepedError as error:
        return _failed(error, device=True)
    if feedback.light == "simulated":
        return Finding("warn", "simulated: no lamp is connected", "set feedback.light")
    names = ", ".join(colour.value for colour in LAMP_COLOURS)
    return Finding("ok", f"{feedback.light} answers; did you see {names}, then dark?")


def _check_lamp(path: str) -> Finding:
    status = ask_lamp(path, {"status": True})
    if status.get("error"):
        return Finding("fail", f"lamp: {status['error']}", "journalctl -u bikeped-lamp")
    if status.get("latched"):
        remedy = "find the cause, then: bikeped lamp reset"
        return Finding("fail", f"lamp: {status['latched']}", remedy)
    return Finding("ok", f"the lamp's process answers and shows {status.get('colour')}")


def check_speaker(loaded: LoadedConfig) -> Finding:
    """Plays the chime."""
    sound = loaded.config.feedback.sound
    if not sound.enabled:
        return Finding("skipped", "feedback.sound.enabled is false")
    program = shutil.which("aplay")
    if program is None:
        return Finding("fail", "aplay is not installed", "apt-get install alsa-utils")
    done = subprocess.run(
        [program, "-q", "-D", sound.device],
        input=make_wav(Sound.CHIME, sound.volume),
        capture_output=True,
        timeout=10,
        check=False,
    )
    if done.returncode != 0:
        message = done.stderr.decode("utf-8", "replace").strip().splitlines() or ["no message"]
        remedy = "set feedback.sound.device to one that `aplay -L` lists"
        return Finding("fail", f"{sound.device}: {message[-1]}", remedy)
    return Finding("ok", f"{sound.device}: did you hear the chime?")


def check_broker(loaded: LoadedConfig, timeout_s: float = 5.0) -> Finding:
    """Connects to the broker, with a client id of its own: the service's connection stays."""
    mqtt = loaded.config.mqtt
    if not mqtt.enabled:
        return Finding("skipped", "mqtt.enabled is false")
    connection = BrokerConnection(
        mqtt,
        load_credentials(mqtt, loaded.base_dir),
        client_id=f"bikeped-doctor-{os.getpid()}",
        timeout_s=timeout_s,
    )
    began = time.perf_counter()
    try:
        connection.open()
    except OSError as error:
        detail = f"{mqtt.host}:{mqtt.port}: {' '.join(str(error).split())}"
        remedy = "check mqtt.host, mqtt.port, mqtt.username, mqtt.tls, and that the broker runs"
        return Finding("warn", detail, remedy)  # the service works without a broker
    finally:
        connection.close()
    took_ms = (time.perf_counter() - began) * 1e3
    return Finding("ok", f"{mqtt.host}:{mqtt.port} answers in {took_ms:.0f} ms")


def check_clock(_loaded: LoadedConfig) -> Finding:
    """Whether time stamps in messages and logs can be right."""
    now = dt.datetime.now(dt.timezone.utc)
    text = f"{now:%Y-%m-%d %H:%M} UTC"
    remedy = "timedatectl set-ntp true; is there a network, or a battery for the clock?"
    if now.year < FIRST_YEAR:
        return Finding("warn", f"{text}: was never set", remedy)
    synchronised = _output_of("timedatectl", "show", "--property=NTPSynchronized", "--value")
    if synchronised is None:
        return Finding("ok", f"{text}; synchronisation unknown (no timedatectl)")
    if synchronised != "yes":
        return Finding("warn", f"{text}, not synchronised", remedy)
    return Finding("ok", f"{text}, synchronised")


def check_disk(loaded: LoadedConfig) -> Finding:
    """Whether the audit log has room and may be written."""
    audit = loaded.config.audit
    if audit.path is None:
        return Finding("skipped", "audit.path is null: no audit log")
    path = loaded.base_dir / audit.path
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    free_mb = shutil.disk_usage(folder).free / MB
    detail = f"{path}: {free_mb:.0f} MB free"
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        remedy = "set audit.path to a folder that the service may write"
        return Finding("warn", f"{path}: {folder} cannot be written", remedy)
    if free_mb < audit.min_free_mb:
        detail += f", audit.min_free_mb is {audit.min_free_mb:g}: nothing is logged"
        return Finding("warn", detail, "free disk space")
    full_mb = audit.max_mb * (audit.keep + 1)
    if free_mb - full_mb < audit.min_free_mb and not path.exists():
        detail += f", the log may grow to {full_mb:.0f} MB"
        return Finding("warn", detail, "lower audit.max_mb or audit.keep")
    return Finding("ok", detail)


def check_machine(_loaded: LoadedConfig, zones: Path = Path("/sys/class/thermal")) -> Finding:
    """Temperature, and the Jetson's power mode, as far as they can be read."""
    hottest = max(map(_celsius, zones.glob("thermal_zone*/temp")), default=-math.inf)
    temperature = f"{hottest:.0f} degrees C" if math.isfinite(hottest) else ""
    power_mode = " ".join((_output_of("nvpmodel", "-q") or "").split())
    detail = "; ".join(filter(None, (temperature, power_mode)))
    if not detail:
        return Finding("skipped", "temperature and power mode cannot be read here")
    if hottest > HOT_C:
        return Finding("warn", detail, "provide shade and ventilation")
    return Finding("ok", detail)


def _celsius(file: Path) -> float:
    try:
        return int(file.read_text()) / 1000
    except (OSError, ValueError):  # a sensor that is switched off
        return -math.inf


def _output_of(program: str, *arguments: str) -> str | None:
    """What a program prints; None when it is not there or fails."""
    command = [program, *arguments]
    try:
        done = subprocess.run(command, capture_output=True, timeout=2, check=False, text=True)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _failed(error: BikepedError, *, device: bool = False) -> Finding:
    """What is wrong and its remedy: a semicolon separates them in the message of an error.

    For a `device` only a warning while the running service may hold it.
    """
    detail, _, remedy = " ".join(str(error).split()).partition("; ")
    if device and _output_of("systemctl", "is-active", "bikeped") == "active":
        return Finding("warn", detail, "the running service may hold it: systemctl stop bikeped")
    return Finding("fail", detail, remedy)
