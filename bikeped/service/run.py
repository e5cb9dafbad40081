"""`run` and `replay`: the loop with its feed, its clock and its outputs."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal as signals
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bikeped import __version__
from bikeped.capture import FrameGrabber, FrameSource, Paced, open_source
from bikeped.config import LoadedConfig
from bikeped.detection.base import load_detector
from bikeped.errors import BikepedError
from bikeped.feedback import (
    OFF,
    LightDriver,
    SignalLogic,
    SimulatedLight,
    fault_signal,
    light_driver,
    open_speaker,
)
from bikeped.service.feed import LiveFeed, RecordedFeed
from bikeped.service.judge import Judge
from bikeped.service.loop import Hung, Loop, Output
from bikeped.service.outputs import EventFile, OverlayVideo, Tally, Telemetry, as_mapping
from bikeped.service.systemd import Notifier
from bikeped.service.vision import Decoder, Eye, ModelEye
from bikeped.telemetry.audit import AuditLog
from bikeped.telemetry.events import EventWriter
from bikeped.telemetry.http import HttpServer, make_app
from bikeped.telemetry.latency import StageTimes
from bikeped.telemetry.messages import EventHeader, HealthMessage, Part, event_header
from bikeped.telemetry.metrics import Metrics
from bikeped.telemetry.mqtt import MqttPublisher
from bikeped.view import VideoSink

log = logging.getLogger(__name__)

#: A stuck thread cannot be ended; systemd starts a fresh process on this status (EX_TEMPFAIL).
EXIT_RESTART = 75
OVERLAY_SIZE = (1600, 720)


def load_eye(loaded: LoadedConfig) -> Eye:
    """The configured model; DetectorError names the key and the mend."""
    return ModelEye(load_detector(loaded.config.detection, loaded.base_dir))


def header_of(loaded: LoadedConfig, eye: Eye) -> EventHeader:
    """The header of an event file or audit log that starts now."""
    return event_header(
        config_hash=loaded.hash,
        calibration_hash=loaded.calibration_hash,
        model_hash=eye.model_hash,
        version=__version__,
        started_unix_s=time.time(),
    )


@dataclass(frozen=True)
class ReplayResult:
    """What a replay found."""

    tally: Tally
    times: StageTimes
    frames: int
    undecodable: int
    wall_s: float
    config_hash: str
    detector: str

    def as_dict(self) -> dict[str, Any]:
        """The summary, for `--json`."""
        tally = self.tally
        return {
            "frames": self.frames,
            "undecodable": self.undecodable,
            "duration_s": round(tally.last_s - (tally.first_s or 0.0), 3),
            "states": dict(sorted(tally.states.items())),
            "tracks": {kind: len(ids) for kind, ids in sorted(tally.tracks.items())},
            "alerts": tally.alerts,
            "detector": self.detector,
            "config_hash": self.config_hash,
            "frames_per_second": round(self.frames / max(self.wall_s, 1e-9), 2),
            "latency_ms": {
                stage: {name: round(value, 3) for name, value in row.items()}
                for stage, row in self.times.percentiles().items()
            },
        }


@dataclass(frozen=True)
class ReplayFiles:
    """What a replay leaves behind; None leaves it out."""

    events: Path | None = None
    overlay: Path | None = None


def replay(
    loaded: LoadedConfig,
    recording: str,
    *,
    eye: Eye | None = None,
    files: ReplayFiles = ReplayFiles(),
    realtime: bool = False,
    mqtt: bool = True,
    progress: Callable[[int], None] | None = None,
) -> ReplayResult:
    """Runs a recording through the loop; raises BikepedError with one line that says the mend."""
    camera = loaded.config.camera
    source = open_source(
        recording, width=camera.width, height=camera.height, fps=camera.fps, fourcc=camera.fourcc
    )
    with contextlib.ExitStack() as stack:
        stack.callback(source.close)
        judge = Judge(loaded)
        judge.framing_of(source.width, source.height)
        looking = eye if eye is not None else load_eye(loaded)
        return asyncio.run(_replay(loaded, source, judge, looking, files, realtime, mqtt, progress))


async def _replay(
    loaded: LoadedConfig,
    source: FrameSource,
    judge: Judge,
    eye: Eye,
    files: ReplayFiles,
    realtime: bool,
    mqtt: bool,
    progress: Callable[[int], None] | None,
) -> ReplayResult:
    config = loaded.config
    tally = Tally()
    outputs: list[Output] = [tally]
    async with contextlib.AsyncExitStack() as stack:
        publisher = await _publisher(loaded, stack) if mqtt and config.mqtt.enabled else None
        telemetry = Telemetry(loaded, judge, publisher, None)
        outputs.append(telemetry)
        if files.events is not None:
            writer = stack.enter_context(EventWriter(files.events, header_of(loaded, eye)))
            outputs.append(EventFile(writer))
        overlay = None
        if files.overlay is not None:
            fps = source.fps if source.fps > 0 else 30.0
            sink = stack.enter_context(VideoSink(files.overlay, fps, OVERLAY_SIZE))
            fov = 2 * judge.camera.lens.max_theta_rad * 180 / 3.141592653589793
            overlay = OverlayVideo(sink, judge, fov)
            outputs.append(overlay)
            stack.push_async_callback(overlay.wait)
        if progress is not None:
            outputs.append(_Progress(progress))
        light = LightDriver(SimulatedLight, fault_blink_hz=config.feedback.fault_blink_hz)
        light.start()
        stack.callback(light.close)
        decoder = Decoder(eye, OVERLAY_SIZE[0] if overlay is not None else 0)
        loop = Loop(
            feed=RecordedFeed(Paced(source) if realtime else source),
            decoder=decoder,
            eye=eye,
            judge=judge,
            logic=SignalLogic.from_config(config.feedback),
            light=light,
            speaker=None,
            outputs=outputs,
        )
        began = time.perf_counter()
        health = asyncio.create_task(_health_loop(telemetry, loop, light)) if publisher else None
        try:
            with _stop_on_signals(loop):
                await loop.run()
        finally:
            if health is not None:
                health.cancel()
        wall_s = time.perf_counter() - began
        if loop.counts.frames == 0:
            raise BikepedError(
                f"{source.name}: no frame could be read ({loop.counts.undecodable} did not "
                "decode); check the recording"
            )
    return ReplayResult(
        tally=tally,
        times=telemetry.times,
        frames=loop.counts.frames,
        undecodable=loop.counts.undecodable,
        wall_s=wall_s,
        config_hash=loaded.hash,
        detector=eye.name,
    )


class _Progress:
    def __init__(self, tell: Callable[[int], None]) -> None:
        self._tell, self._frames = tell, 0

    async def frame(self, outcome: object) -> None:
        self._frames += 1
        self._tell(self._frames)

    def signal(self, signal: object, sentence: str) -> None:
        """Nothing."""


def run_service(loaded: LoadedConfig, *, eye: Eye | None = None) -> int:
    """The service until SIGTERM; its exit status. Raises BikepedError for a bad configuration."""
    return asyncio.run(_run(loaded, eye))


async def _run(loaded: LoadedConfig, eye: Eye | None) -> int:
    config = loaded.config
    notifier = Notifier()
    judge = Judge(loaded)
    light = light_driver(config.feedback)
    async with contextlib.AsyncExitStack() as stack:
        stack.callback(notifier.close)
        light.start()
        stack.callback(light.close)  # dark, whatever ends the service
        speaker = open_speaker(config.feedback, loaded.base_dir)
        stack.push_async_callback(speaker.close)
        stop = asyncio.Event()
        loop_running = asyncio.get_running_loop()
        for number in (signals.SIGTERM, signals.SIGINT):
            loop_running.add_signal_handler(number, stop.set)
        log.info(
            "bikeped %s, configuration %s, calibration %s",
            __version__,
            loaded.hash[:12],
            (loaded.calibration_hash or "none")[:12],
        )
        looking = eye
        if looking is None:
            looking = await _load_while_alive(loaded, light, notifier, stop)
            if looking is None:
                return 0
        log.info("detector: %s", looking.name)
        publisher = await _publisher(loaded, stack) if config.mqtt.enabled else None
        audit = AuditLog(config.audit, header_of(loaded, looking), base_dir=loaded.base_dir)
        audit.start()
        stack.callback(audit.close)
        metrics = Metrics()
        telemetry = Telemetry(loaded, judge, publisher, audit, metrics)
        camera = config.camera

        def open_camera() -> FrameSource:
            source = open_source(
                camera.source,
                width=camera.width,
                height=camera.height,
                fps=camera.fps,
                fourcc=camera.fourcc,
            )
            # A recording in the camera's place is played at its own pace, as a rehearsal.
            return source if source.live else Paced(source)

        grabber = FrameGrabber(open_camera, stale_after_s=camera.stale_after_s)
        grabber.start()
        loop = Loop(
            feed=LiveFeed(grabber),
            decoder=Decoder(looking),
            eye=looking,
            judge=judge,
            logic=SignalLogic.from_config(config.feedback),
            light=light,
            speaker=speaker,
            outputs=[telemetry],
            stale_after_s=camera.stale_after_s,
            silent_after_s=config.detection.silent_after_s,
            hang_after_s=camera.hang_after_s,
            on_tick=notifier.alive,
        )

        def health() -> HealthMessage:
            extra = [f"speaker: {speaker.fault}"] if speaker.fault else []
            if audit.fault:
                extra.append(f"audit: {audit.fault}")
            fault = light.fault
            if fault:
                extra.append(fault if fault.startswith("light") else f"light: {fault}")
            part = Part(ok=fault is None, detail=fault or config.feedback.light)
            return telemetry.health(loop, tuple(extra), part)

        if config.web.enabled:
            app = make_app(metrics.registry, lambda: as_mapping(health()), host=config.web.host)
            server = HttpServer(app, config.web)
            await server.start()
            stack.push_async_callback(server.stop)
        notifier.ready(f"watching {camera.source}")
        telling = asyncio.create_task(_tell_health(telemetry, health))
        stopper = asyncio.create_task(_stop_when(stop, loop))
        try:
            await loop.run()
        except Hung as hang:
            log.critical("%s; ending so that a fresh process can start", hang)
            light.show(fault_signal((str(hang),), config.feedback.fault_blink_hz))
            return EXIT_RESTART
        finally:
            notifier.stopping()
            telling.cancel()
            stopper.cancel()
            light.show(OFF)
            telemetry.signal(OFF, "OFF: the service was stopped.")
            log.info("latency\n%s", telemetry.times.table())
    return 0


async def _load_while_alive(
    loaded: LoadedConfig, light: LightDriver, notifier: Notifier, stop: asyncio.Event
) -> Eye | None:
    """Loads the model in a thread (an engine may take minutes to build), showing FAULT meanwhile.

    None when the service was asked to stop before.
    """
    starting = fault_signal(("starting: loading the model",), loaded.config.feedback.fault_blink_hz)
    loading = asyncio.create_task(asyncio.to_thread(load_eye, loaded))
    stopping = asyncio.create_task(stop.wait())
    try:
        while not (loading.done() or stopping.done()):
            light.show(starting)
            notifier.starting(30.0, "loading the model")
            await asyncio.wait(
                {loading, stopping}, timeout=0.25, return_when=asyncio.FIRST_COMPLETED
            )
        return await loading if loading.done() else None
    finally:
        stopping.cancel()


async def _publisher(loaded: LoadedConfig, stack: contextlib.AsyncExitStack) -> MqttPublisher:
    publisher = MqttPublisher(loaded.config.mqtt, base_dir=loaded.base_dir)
    await publisher.start()
    stack.push_async_callback(publisher.stop)
    return publisher


async def _tell_health(telemetry: Telemetry, health: Callable[[], HealthMessage]) -> None:
    """Publishes and logs the health at its interval."""
    while True:
        message = telemetry.publish_health(health)
        if message is not None:
            total = message.latency_ms.get("total")
            log.info(
                "health: %s, %.1f fps, total %s ms (p95), %d faults",
                message.state,
                message.fps,
                f"{total.p95:.1f}" if total else "-",
                len(message.faults),
            )
        await asyncio.sleep(0.1)


async def _health_loop(telemetry: Telemetry, loop: Loop, light: LightDriver) -> None:
    """The health messages of a replay."""
    part = Part(ok=True, detail="simulated")
    await _tell_health(telemetry, lambda: telemetry.health(loop, (), part))


async def _stop_when(stop: asyncio.Event, loop: Loop) -> None:
    await stop.wait()
    log.info("stopping")
    loop.stop()


@contextlib.contextmanager
def _stop_on_signals(loop: Loop) -> Any:
    """SIGTERM and Ctrl-C end a replay after the frame in hand, with whole files."""
    running = asyncio.get_running_loop()
    numbers = (signals.SIGTERM, signals.SIGINT)
    try:
        for number in numbers:
            running.add_signal_handler(number, loop.stop)
    except (RuntimeError, ValueError):  # not the main thread: nobody to signal
        yield
        return
    try:
        yield
    finally:
        for number in numbers:
            running.remove_signal_handler(number)
