"""What `run` and `replay` share: the detector, and the loop with telemetry and pages around it."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import msgspec
from aiohttp import web
from prometheus_client import CollectorRegistry

from bikeped import __version__
from bikeped.config.build import road_region
from bikeped.config.load import LoadedConfig
from bikeped.cores import cores
from bikeped.detection.detector import load_detector
from bikeped.errors import DetectorError
from bikeped.faults import Fault
from bikeped.feedback.light import LightOutput
from bikeped.feedback.signal_logic import SignalLogic
from bikeped.feedback.speaker import Speaker
from bikeped.pipeline.detection_scheduler import (
    MAX_INFLIGHT,
    DetectionStage,
    DetectorPool,
    FrameDetector,
)
from bikeped.pipeline.detector_watch import DetectorWatch
from bikeped.pipeline.fault_monitor import DEFAULT_LIMITS, Limits
from bikeped.pipeline.feed import Feed
from bikeped.pipeline.loop import FrameResultListener, Loop
from bikeped.pipeline.picture_monitor import UNCHECKED, picture_monitor
from bikeped.pipeline.signal_dispatcher import SignalDispatcher, SignalListener
from bikeped.pipeline.telemetry import Telemetry, report_health
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.telemetry.builders import rfc3339
from bikeped.telemetry.event_files import AuditLog
from bikeped.telemetry.http_server import HttpServer
from bikeped.telemetry.metrics import Metrics
from bikeped.telemetry.mqtt import MqttPublisher, MqttStatus
from bikeped.telemetry.schema import EventHeader, HealthMessage


@dataclass(frozen=True)
class WebContext:
    """What pages may read. Nothing here changes what the service does."""

    loaded: LoadedConfig
    track_and_decide: TrackAndDecide
    source: str  #: the camera, or the recording
    detector: str
    health: Callable[[], HealthMessage]
    metrics: CollectorRegistry
    mqtt: Callable[[], MqttStatus] | None  #: None: no broker is configured


class Pages(FrameResultListener, SignalListener, Protocol):
    """Pages take every result and every signal, queue them, and return at once."""

    def application(self, web_context: WebContext) -> web.Application:
        """The web application, with the monitoring endpoints."""


def load_detector_pool(loaded: LoadedConfig, *, recorded: bool = False) -> DetectorPool:
    """The configured model; DetectorError names the key and the remedy.

    `recorded`: for a recording, where throughput counts and not the delay of one frame. On a
    processor whose threads the configuration leaves open, two copies with half of the cores each
    then detect two frames: the threads of one inference wait for one another at every layer.
    """
    detection, base = loaded.config.detection, loaded.base_dir
    if detection.model is None:
        raise DetectorError(
            f"{loaded.source}: detection.model: no model is configured; name an .onnx or .engine "
            "file there, or with --set detection.model=FILE"
        )
    road, copies, threads = road_region(loaded), 1, cores() // MAX_INFLIGHT
    engine = detection.model.lower().endswith(".engine")
    if recorded and threads and detection.threads == 0 and not engine:
        from bikeped.detection.onnx_runtime import runs_on_cpu

        if runs_on_cpu(detection.providers):
            detection, copies = msgspec.structs.replace(detection, threads=threads), MAX_INFLIGHT
    return DetectorPool(*(load_detector(detection, base, road) for _ in range(copies)))


def new_event_header(loaded: LoadedConfig, detector: FrameDetector) -> EventHeader:
    """The header of an event file or audit log that starts now."""
    return EventHeader(
        format="bikeped-events/1",
        config_hash=loaded.hash,
        calibration_hash=loaded.calibration_hash,
        model_hash=detector.model_hash,
        version=__version__,
        started_at=rfc3339(time.time()),
    )


class Application:
    """The loop from `feed` to `light`, with the parts that the configuration asks for.

    `source` names the camera or the recording. What is started is stopped when `stack` unwinds.
    `outputs` take every frame result after telemetry; `view_width`: pixels that their pictures
    need; `latency_frames`: over how many frames percentiles are taken. Raises TelemetryError for
    MQTT settings that cannot work.
    """

    def __init__(
        self,
        loaded: LoadedConfig,
        detector: FrameDetector,
        track_and_decide: TrackAndDecide,
        stack: contextlib.AsyncExitStack,
        *,
        feed: Feed,
        source: str,
        light: LightOutput,
        mqtt: bool,
        pages: Pages | None = None,
        speaker: Speaker | None = None,
        audit: AuditLog | None = None,
        outputs: Sequence[FrameResultListener] = (),
        view_width: int = 0,
        limits: Limits = DEFAULT_LIMITS,
        fault_sources: Sequence[Callable[[], Fault | None]] = (),
        on_tick: Callable[[], None] = lambda: None,
        latency_frames: int = 900,
    ) -> None:
        self._stack, self._light, self._pages = stack, light, pages
        publisher = None
        if mqtt:
            publisher = MqttPublisher(loaded.config.mqtt, base_dir=loaded.base_dir)
            publisher.start()
            stack.push_async_callback(asyncio.to_thread, publisher.stop)
        metrics = Metrics()
        self.telemetry = Telemetry(
            loaded,
            track_and_decide,
            publisher=publisher,
            audit=audit,
            metrics=None if pages is None else metrics,
            remember=latency_frames,
        )
        watchers = () if pages is None else (pages,)
        logic = SignalLogic.from_config(loaded.config.feedback)
        self.dispatcher = SignalDispatcher(logic, light, speaker, (self.telemetry, *watchers))
        watch = DetectorWatch(loaded, detector, track_and_decide.ground_mapper.camera, feed.live)
        stack.push_async_callback(watch.close)
        self.loop = Loop(
            feed=feed,
            detection=DetectionStage(detector, view_width, picture_monitor(loaded)),
            track_and_decide=track_and_decide,
            dispatcher=self.dispatcher,
            outputs=(self.telemetry, *watchers, *outputs),
            limits=limits,
            on_tick=on_tick,
            fault_sources=(
                *fault_sources,
                lambda: None if speaker is None else speaker.fault,
                lambda: None if audit is None else audit.fault,
                lambda: None if publisher is None else publisher.fault,
                lambda: light.fault,
                lambda: track_and_decide.fault,
                lambda: None if loaded.config.monitor.picture else UNCHECKED,
            ),
            watch=watch,
        )
        self._web_context = WebContext(
            loaded=loaded,
            track_and_decide=track_and_decide,
            source=source,
            detector=detector.name,
            health=self._health,
            metrics=metrics.registry,
            mqtt=None if publisher is None else lambda: publisher.status,
        )

    async def serve_pages(self) -> HttpServer | None:
        """Serves the pages, if there are any. A port that cannot be bound is in `error`."""
        if self._pages is None:
            return None
        context = self._web_context
        server = HttpServer(self._pages.application(context), context.loaded.config.web)
        await server.start()
        self._stack.push_async_callback(server.stop)
        return server

    async def run(self) -> None:
        """Runs the loop (see `Loop.run`), reporting health meanwhile and once at the end."""
        reporting = asyncio.create_task(report_health(self.telemetry, self.loop, self._light))
        try:
            await self.loop.run()
        finally:
            reporting.cancel()
            self.telemetry.publish_health(self._health())

    def _health(self) -> HealthMessage:
        return self.telemetry.health(self.loop, self._light.name)
