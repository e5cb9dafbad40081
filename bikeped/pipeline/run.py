"""`run`: the service, from FAULT at the start to a dark light at the end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import platform
import signal as signals
import sys
import time
from functools import partial

from bikeped import __version__
from bikeped.capture import open_source
from bikeped.capture.base import FrameSource
from bikeped.capture.recordings import PacedSource
from bikeped.capture.source_names import shown_source
from bikeped.config.load import LoadedConfig
from bikeped.config.provenance import check_provenance
from bikeped.faults import Fault
from bikeped.feedback import light_output
from bikeped.feedback.light import LightOutput
from bikeped.feedback.signal_logic import fault_signal
from bikeped.feedback.speaker import Speaker
from bikeped.models import BUNDLED, NOT_FOR_STREETS
from bikeped.pipeline.application import Application, Pages, load_detector_pool, new_event_header
from bikeped.pipeline.detection_scheduler import FrameDetector
from bikeped.pipeline.fault_monitor import Limits, StageHangError
from bikeped.pipeline.feed import LiveFeed
from bikeped.pipeline.runtime import WorkerThread, notify
from bikeped.pipeline.service_start import PLAIN_START, ServiceStart
from bikeped.pipeline.signal_dispatcher import SignalDispatcher
from bikeped.pipeline.single_instance import claimed
from bikeped.pipeline.track_and_decide import GroundMapper, TrackAndDecide
from bikeped.telemetry.event_files import AuditLog
from bikeped.types import Signal

log = logging.getLogger(__name__)

#: Building an engine takes minutes; what takes longer than this has hung.
LOAD_LIMIT_S = 1800.0
_REFRESH_S = 0.1  #: the lamp's process takes longer pauses for a fault
_ENDING = (signals.SIGUSR1, signals.SIGUSR2, signals.SIGALRM, signals.SIGQUIT)
LOADING = Fault("starting", "service.starting", "loading the model")


def run_service(
    loaded: LoadedConfig,
    *,
    detector: FrameDetector | None = None,
    pages: Pages | None = None,
    start: ServiceStart = PLAIN_START,
) -> int:
    """Runs until SIGTERM or SIGINT; returns the exit status: 0, or that of the fault that ended it.

    `pages` are served; None serves nothing. Raises BikepedError for what needs a person. A thread
    that hangs is left behind, so the caller should end the process without joining threads (see
    `bikeped.cli.run`).
    """
    return asyncio.run(_run(loaded, detector, pages, start))


async def _run(
    loaded: LoadedConfig, detector: FrameDetector | None, pages: Pages | None, start: ServiceStart
) -> int:
    # A thread that computes in Python gives way to the decision after 1 ms, not 5.
    sys.setswitchinterval(0.001)
    stop = asyncio.Event()
    events = asyncio.get_running_loop()
    # Any of them would end the process with the last light on. Nothing can be loaded anew: HUP is
    # ignored.
    for number in (*_ENDING, signals.SIGTERM, signals.SIGINT):
        events.add_signal_handler(number, stop.set)
    events.add_signal_handler(signals.SIGHUP, log.info, "SIGHUP is ignored: restart the service")
    log.info(
        "bikeped %s, Python %s, %s; configuration %s (%s), calibration %s",
        __version__,
        platform.python_version(),
        platform.machine(),
        loaded.hash,
        loaded.source,
        loaded.calibration_hash or "none",
    )
    provenance = check_provenance(loaded)
    log.log(logging.INFO if provenance.holds else logging.WARNING, "%s", provenance.text)
    config, ground_mapper = loaded.config, GroundMapper(loaded)
    light = light_output(config.feedback, config.lamp)
    async with contextlib.AsyncExitStack() as last, contextlib.AsyncExitStack() as stack:
        last.enter_context(claimed(loaded))
        light.start()  # shows FAULT until the first signal
        last.push_async_callback(_darken, light)  # done last, whatever ends the service
        if start.fault_s:
            reason = fault_signal((start.reason or LOADING,), config.feedback.fault_blink_hz)
            await _show_for(start.fault_s, light, reason, stop)
        if detector is None:
            detector = await _load_while_alive(loaded, light, stop)
        if detector is None:
            return _ended(start)
        log.info("detector: %s, sha256 %s", detector.name, detector.model_hash or "none")
        if config.detection.model == BUNDLED:
            log.warning("detection.model: %s", NOT_FOR_STREETS)
        speaker = Speaker(config.feedback.sound, base=loaded.base_dir)
        stack.push_async_callback(speaker.close)
        audit = None
        if config.audit.path is not None:
            header = new_event_header(loaded, detector)
            audit = AuditLog(config.audit, header, base_dir=loaded.base_dir)
            audit.start()
            stack.push_async_callback(asyncio.to_thread, audit.close)
        stale_after_s = config.camera.stale_after_s
        camera = LiveFeed(
            partial(_open_camera, loaded),
            stale_after_s=stale_after_s,
            hang_after_s=config.camera.hang_after_s,
            max_fps=config.camera.fps,
        )
        application = Application(
            loaded,
            detector,
            TrackAndDecide(loaded, detector.cyclist_box_includes_rider, ground_mapper),
            stack,
            feed=camera,
            source=shown_source(config.camera.source),
            light=light,
            mqtt=config.mqtt.enabled,
            pages=pages,
            speaker=speaker,
            audit=audit,
            limits=Limits(
                stale_after_s, config.detection.silent_after_s, config.detection.hang_after_s
            ),
            on_tick=partial(notify, "WATCHDOG=1"),
            fault_sources=start.fault_sources(),
        )
        camera.start()
        await application.serve_pages()
        application.loop.stopping = stop  # which may be set already
        notify("READY=1", f"STATUS=watching {shown_source(config.camera.source)}")
        watching = asyncio.create_task(start.watch(lambda: application.dispatcher.shown))
        last.callback(watching.cancel)
        try:
            await application.run()
        except StageHangError as hang:
            log.critical("%s; ending so that a fresh process can start", hang)
            return hang.fault.kind.exit_status or 0
        finally:
            log.info("stopping")
            notify("STOPPING=1")
            # Stopping the rest may take seconds: keeps the light's watchdog from tripping.
            last.callback(asyncio.create_task(_refresh(application.dispatcher)).cancel)
            log.info("latency\n%s", application.telemetry.times.table())
        return _ended(start)


def _ended(start: ServiceStart) -> int:
    """The exit status of an end that was asked for."""
    if start.on_steady is not None:
        start.on_steady()
    return 0


async def _show_for(
    seconds: float, light: LightOutput, signal: Signal, stop: asyncio.Event
) -> None:
    """Shows one signal for so long, or until the service is stopped."""
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s and not stop.is_set():
        light.show(signal)
        _still_starting("waiting in FAULT")
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(stop.wait(), _REFRESH_S)


def _still_starting(status: str) -> None:
    """Asks systemd for half a minute more."""
    notify("EXTEND_TIMEOUT_USEC=30000000", "WATCHDOG=1", f"STATUS={status}")


def _open_camera(loaded: LoadedConfig) -> FrameSource:
    source = open_source(loaded.config.camera, base_dir=loaded.base_dir)
    # A recording in the camera's place is played at its own pace, as a rehearsal.
    return source if source.live else PacedSource(source)


async def _load_while_alive(
    loaded: LoadedConfig, light: LightOutput, stop: asyncio.Event
) -> FrameDetector | None:
    """Loads the model in a thread (an engine may take minutes to build), showing FAULT meanwhile.

    None when the service is stopped before. After LOAD_LIMIT_S systemd is no longer asked for more
    time, and ends the process.
    """
    starting = fault_signal((LOADING,), loaded.config.feedback.fault_blink_hz)
    worker = WorkerThread("load")
    loading = worker.submit(load_detector_pool, loaded)
    began_s = time.monotonic()
    try:
        while not (loading.done() or stop.is_set()):
            light.show(starting)
            if time.monotonic() - began_s < LOAD_LIMIT_S:
                _still_starting("loading the model")
            await asyncio.wait({loading}, timeout=_REFRESH_S)
        return await loading if loading.done() else None
    finally:
        loading.cancel()
        await worker.close(0.0)


async def _refresh(dispatcher: SignalDispatcher) -> None:
    while True:
        dispatcher.refresh()
        await asyncio.sleep(_REFRESH_S)


async def _darken(light: LightOutput) -> None:
    answers = await asyncio.to_thread(light.close)
    if answers and light.name == "lamp":
        log.info("stopped: the lamp's process goes on, dark after a stop and in FAULT otherwise")
    elif answers:
        log.info("stopped: the light is off")
    else:
        log.error("stopped, but the light does not answer and may still be on")
