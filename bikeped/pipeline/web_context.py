"""The seam to the pages: the service shows them what it does, and knows nothing of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from aiohttp import web
from prometheus_client import CollectorRegistry

from bikeped.config import LoadedConfig, WebConfig
from bikeped.pipeline.frame_result import FrameResultListener
from bikeped.pipeline.signal_dispatcher import SignalListener
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.telemetry.builders import HealthMessage
from bikeped.telemetry.http_server import HttpServer
from bikeped.telemetry.mqtt import MqttStatus


@dataclass(frozen=True)
class WebContext:
    """What pages may look at. Nothing here changes what the service does."""

    loaded: LoadedConfig
    track_and_decide: TrackAndDecide
    source: str  #: the camera, or the recording
    detector: str
    health: Callable[[], HealthMessage]
    metrics: CollectorRegistry
    mqtt: Callable[[], MqttStatus] | None  #: None: no broker is configured


class Pages(FrameResultListener, SignalListener, Protocol):
    """Pages hear every result and every signal, put them aside, and return at once."""

    def application(self, web_context: WebContext) -> web.Application:
        """What is served, the monitoring included."""


async def open_pages(
    pages: Pages, web_context: WebContext, config: WebConfig, stack: contextlib.AsyncExitStack
) -> HttpServer:
    """Serves the pages until `stack` unwinds. A port that cannot be bound is in `error`."""
    server = HttpServer(pages.application(web_context), config)
    await server.start()
    stack.push_async_callback(server.stop)
    return server
