"""The live page: picture, decision and its reason, health.

`/live/events` sends changes as server-sent events, `/live/stream` the picture as Motion JPEG. A
slow client skips frames; the service never waits for one.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

import msgspec
from aiohttp import hdrs, web

from bikeped.capture.source_names import shown_source
from bikeped.config.output_sections import WebConfig
from bikeped.pipeline.application import WebContext
from bikeped.telemetry.latency import STAGES
from bikeped.web.live_picture import PictureRenderer
from bikeped.web.live_state import LiveState
from bikeped.web.server import Page, add_page

#: Limit of messages per second to one page.
EVENTS_HZ = 10.0
STATUS_S = 1.0
#: A client that accepts no data for this long is disconnected.
WRITE_S = 10.0
#: Bytes in flight to a slow client: more would only be older on arrival.
_SEND_BUFFER = 128 * 1024
_BOUNDARY = "bikeped-picture-4c1d9f"
#: Between two pictures; Chromium shows one when it has read the headers of the next.
_EDGE = f"\r\n--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\n\r\n".encode()
#: Closing the page is the usual end of a stream; it is not logged.
_USUAL_END = contextlib.suppress(ConnectionError)


class LivePage:
    """Handlers of the live page of one running service or replay."""

    def __init__(self, state: LiveState, web_context: WebContext) -> None:
        self._config: WebConfig = web_context.loaded.config.web
        self._state, self._web_context = state, web_context
        self.renderer = PictureRenderer(
            state, web_context.track_and_decide, self._config.stream_width, self._config.stream_fps
        )
        self._pages = self._streams = 0
        self._status: tuple[float, bytes] = (-1.0, b"")
        self._now: tuple[tuple[int, int], bytes] = ((-1, -1), b"")

    async def close(self, _app: web.Application) -> None:
        """Ends all streams."""
        self._state.close()
        self.renderer.wake()

    async def events(self, request: web.Request) -> web.StreamResponse:
        """Server-sent events: `hello` once, `now` up to ten a second, `status` every second,
        `alerts` when they change."""
        with self._counted("_pages"), _USUAL_END:
            response = web.StreamResponse(
                headers={hdrs.CONTENT_TYPE: "text/event-stream", "X-Accel-Buffering": "no"}
            )
            await response.prepare(request)
            _limit_send_buffer(request)
            await _send(request, response, _event("hello", msgspec.json.encode(self._hello())))
            number, alerts, next_status_s, trend_s = -1, -1, 0.0, 0.0
            state = self._state
            while not state.closed:
                await state.wait_changed(number, STATUS_S)
                began_s = time.monotonic()
                number = state.revision
                parts = [_event("now", self._encode_now())]
                if state.alerts_revision != alerts:
                    alerts = state.alerts_revision
                    parts.append(_event("alerts", msgspec.json.encode(list(state.alerts))))
                if began_s >= next_status_s:
                    next_status_s = began_s + STATUS_S
                    parts.append(_event("status", self._encode_status(began_s)))
                    new = [point for point in state.trend if point.unix_s > trend_s]
                    if new:
                        trend_s = new[-1].unix_s
                        parts.append(_event("trend", msgspec.json.encode(new)))
                await _send(request, response, b"".join(parts))
                await asyncio.sleep(1.0 / EVENTS_HZ)
        return response

    async def capacity(self, _request: web.Request) -> web.Response:
        """204 when one more page may open, else 503: a failed stream gives a browser no reason."""
        with self._counted("_pages"):
            return web.Response(status=204)

    async def stream(self, request: web.Request) -> web.StreamResponse:
        """The picture with boxes, tracks and the pair, as Motion JPEG."""
        with self._counted("_streams"), self.renderer.viewer(), _USUAL_END:
            response = web.StreamResponse(
                headers={hdrs.CONTENT_TYPE: f"multipart/x-mixed-replace; boundary={_BOUNDARY}"}
            )
            await response.prepare(request)
            _limit_send_buffer(request)
            await _send(request, response, _EDGE)
            number = -1
            while (picture := await self.renderer.next(number)) is not None:
                number, jpeg = picture
                await _send(request, response, jpeg + _EDGE)
        return response

    @contextlib.contextmanager
    def _counted(self, what: str) -> Iterator[None]:
        """Counts one more stream of a kind; HTTPServiceUnavailable above `web.max_viewers`."""
        if getattr(self, what) >= self._config.max_viewers:
            raise web.HTTPServiceUnavailable(
                text=f"{self._config.max_viewers} live pages are open already, and "
                "web.max_viewers allows no more: close one.",
                headers={hdrs.RETRY_AFTER: "10"},
            )
        setattr(self, what, getattr(self, what) + 1)
        try:
            yield
        finally:
            setattr(self, what, getattr(self, what) - 1)

    def _hello(self) -> dict[str, Any]:
        """Data that stay the same while the service runs."""
        context, loaded = self._web_context, self._web_context.loaded
        config = loaded.config
        camera = context.track_and_decide.ground_mapper.camera
        return {
            "stages": STAGES,
            "config_hash": loaded.hash,
            "calibration_hash": loaded.calibration_hash,
            "source": display_source(context.source),
            "detector": context.detector,
            "light": config.feedback.light,
            "rule": config.decision.rule,
            "broker": context.mqtt and f"{config.mqtt.host}:{config.mqtt.port}",
            "fov_rad": 2 * camera.lens.max_theta_rad,
            "heading_deg": camera.heading_deg,
            "range_m": config.tracking.max_range_m,
        }

    def _encode_now(self) -> bytes:
        """The snapshot as JSON, encoded once for all pages; again without a change too, as its ages
        grow."""
        key = (self._state.revision, int(time.monotonic() * EVENTS_HZ))
        if self._now[0] != key:
            self._now = (key, msgspec.json.encode(self._state.snapshot()))
        return self._now[1]

    def _encode_status(self, now_s: float) -> bytes:
        """Health and broker as JSON, encoded once a second for all pages."""
        if now_s - self._status[0] >= 0.9 * STATUS_S:
            mqtt = None if self._web_context.mqtt is None else self._web_context.mqtt()
            status = {"health": self._web_context.health(), "mqtt": mqtt}
            self._status = (now_s, msgspec.json.encode(status))
        return self._status[1]


def display_source(source: str) -> str:
    """A camera's name without password or folder."""
    shown = shown_source(source)
    if shown != source or source.startswith("/dev/"):
        return shown
    return PurePath(source).name or source


def add_live(app: web.Application, live: LivePage) -> None:
    """Adds `/` and `/live/...`."""
    page = Page("/", "Live", "Live", "live.html", scripts=("live.js",), styles=("live.css",))
    add_page(app, page)
    app.router.add_get("/live/events", live.events, allow_head=False)
    app.router.add_get("/live/stream", live.stream, allow_head=False)
    app.router.add_get("/live/room", live.capacity)
    app.on_shutdown.append(live.close)


def _event(name: str, data: bytes) -> bytes:
    return b"event: %s\ndata: %s\n\n" % (name.encode(), data)


def _limit_send_buffer(request: web.Request) -> None:
    """Keeps the system from buffering seconds of old pictures for a slow client."""
    transport = request.transport
    sock = None if transport is None else transport.get_extra_info("socket")
    if sock is not None:
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)


async def _send(request: web.Request, response: web.StreamResponse, data: bytes) -> None:
    """Sends `data`; disconnects a client that accepts none for WRITE_S."""
    try:
        await asyncio.wait_for(response.write(data), WRITE_S)
    except asyncio.TimeoutError as error:
        if request.transport is not None:
            request.transport.abort()
        raise ConnectionResetError("the client accepts no data") from error
