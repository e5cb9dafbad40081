"""What the pipeline gives the web pages, and what it expects of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from aiohttp import web
from prometheus_client import CollectorRegistry

from bikeped.config import LoadedConfig
from bikeped.pipeline.frame_result import FrameResultListener
from bikeped.pipeline.signal_dispatcher import SignalListener
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.telemetry.mqtt import MqttStatus
from bikeped.telemetry.schema import HealthMessage


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
