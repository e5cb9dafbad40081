"""The live page: what the box sees, what it decided and why, and how it is.

`/live/events` sends what changes as server-sent events, `/live/stream` the picture as Motion JPEG.
Each client has room for the newest only: who is slow sees less, and nobody waits for him.
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

from bikeped.config import WebConfig
from bikeped.pipeline.web_context import WebContext
from bikeped.telemetry.latency import STAGES
from bikeped.web.live_picture import PictureRenderer
from bikeped.web.live_state import LiveState
from bikeped.web.server import Page, add_page

#: At most so many messages a second to one page.
EVENTS_HZ = 10.0
STATUS_S = 1.0
#: A client that takes nothing for so long is let go.
WRITE_S = 10.0
#: What may be on its way to a slow client: more would only be older when it arrives.
_SEND_BUFFER = 128 * 1024
_BOUNDARY = "bikeped-picture-4c1d9f"
#: Between two pictures; Chromium shows one when it has read the headers of the next.
_EDGE = f"\r\n--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\n\r\n".encode()


class LivePage:
    """The live page of one running service or replay."""

    def __init__(self, state: LiveState, web_context: WebContext) -> None:
        self._config: WebConfig = web_context.loaded.config.web
        self._state, self._web_context = state, web_context
        self.renderer = PictureRenderer(
            state, web_context.track_and_decide, self._config.stream_width, self._config.stream_fps
        )
        self._pages = self._streams = 0
        self._status: tuple[float, bytes] = (-1.0, b"")
        self._now: tuple[tuple[int, int], bytes] = ((-1, -1), b"")

    def close(self) -> None:
        """Ends all streams."""
        self._state.close()
        self.renderer.close()

    async def events(self, request: web.Request) -> web.StreamResponse:
        """Server-sent events: `hello` once, `now` up to ten a second, `status` every second,
        `alerts` when they change."""
        with self._counted("_pages"), _until_left():
            response = web.StreamResponse(
                headers={hdrs.CONTENT_TYPE: "text/event-stream", "X-Accel-Buffering": "no"}
            )
            await response.prepare(request)
            _keep_little(request)
            await _send(request, response, _event("hello", msgspec.json.encode(self._hello())))
            number, alerts, next_status_s, trend_s = -1, -1, 0.0, 0.0
            state = self._state
            while not state.closed:
                await state.changed(number, STATUS_S)
                began_s = time.monotonic()
                number = state.number
                parts = [_event("now", self._encode_now())]
                if state.alerts_number != alerts:
                    alerts = state.alerts_number
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

    async def room(self, _request: web.Request) -> web.Response:
        """204 when there is room for one more page: browsers do not tell why a stream failed."""
        with self._counted("_pages"):
            return web.Response(status=204)

    async def stream(self, request: web.Request) -> web.StreamResponse:
        """The picture with boxes, tracks and the pair, as Motion JPEG."""
        with self._counted("_streams"), self.renderer.looking(), _until_left():
            response = web.StreamResponse(
                headers={hdrs.CONTENT_TYPE: f"multipart/x-mixed-replace; boundary={_BOUNDARY}"}
            )
            await response.prepare(request)
            _keep_little(request)
            await _send(request, response, _EDGE)
            number = -1
            while (picture := await self.renderer.next(number)) is not None:
                number, jpeg = picture
                await _send(request, response, jpeg + _EDGE)
        return response

    @contextlib.contextmanager
    def _counted(self, what: str) -> Iterator[None]:
        """Room for one more of the page's streams; HTTPServiceUnavailable when there is none."""
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
        """What does not change while the service runs."""
        loaded, lens = (
            self._web_context.loaded,
            self._web_context.track_and_decide.ground_mapper.camera.lens,
        )
        config = loaded.config
        return {
            "stages": STAGES,
            "config_hash": loaded.hash,
            "calibration_hash": loaded.calibration_hash,
            "source": display_source(self._web_context.source),
            "detector": self._web_context.detector,
            "light": config.feedback.light,
            "rule": config.decision.rule,
            "broker": None
            if self._web_context.mqtt is None
            else f"{config.mqtt.host}:{config.mqtt.port}",
            "fov_rad": 2 * lens.max_theta_rad,
            "heading_deg": self._web_context.track_and_decide.ground_mapper.camera.heading_deg,
            "range_m": config.tracking.max_range_m,
        }

    def _encode_now(self) -> bytes:
        """The moment as JSON, made once for all pages; without news anew all the same, for the
        ages in it grow."""
        key = (self._state.number, int(time.monotonic() * EVENTS_HZ))
        if self._now[0] != key:
            self._now = (key, msgspec.json.encode(self._state.snapshot()))
        return self._now[1]

    def _encode_status(self, now_s: float) -> bytes:
        """Health and broker as JSON, made once a second for all pages."""
        if now_s - self._status[0] >= 0.9 * STATUS_S:
            mqtt = None if self._web_context.mqtt is None else self._web_context.mqtt()
            status = {"health": self._web_context.health(), "mqtt": mqtt}
            self._status = (now_s, msgspec.json.encode(status))
        return self._status[1]


def display_source(source: str) -> str:
    """A camera's name for people: without a password in an address, or the way to a file."""
    if "://" in source:
        scheme, _, rest = source.partition("://")
        return f"{scheme}://{rest.rpartition('@')[2]}"
    return source if source.startswith("/dev/") else PurePath(source).name or source


def add_live(app: web.Application, live: LivePage) -> None:
    """Adds `/` and `/live/...`."""
    page = Page("/", "Live", "Live", "live.html", scripts=("live.js",), styles=("live.css",))
    add_page(app, page)
    app.router.add_get("/live/events", live.events, allow_head=False)
    app.router.add_get("/live/stream", live.stream, allow_head=False)
    app.router.add_get("/live/room", live.room)

    async def close(_app: web.Application) -> None:
        live.close()

    app.on_shutdown.append(close)


@contextlib.contextmanager
def _until_left() -> Iterator[None]:
    """A visitor who leaves is the usual end of a stream, and nothing to tell the log."""
    with contextlib.suppress(ConnectionError):
        yield


def _event(name: str, data: bytes) -> bytes:
    return b"event: %s\ndata: %s\n\n" % (name.encode(), data)


def _keep_little(request: web.Request) -> None:
    """Keeps the system from holding seconds of old pictures for a slow client."""
    transport = request.transport
    sock = None if transport is None else transport.get_extra_info("socket")
    if sock is not None:
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)


async def _send(request: web.Request, response: web.StreamResponse, data: bytes) -> None:
    """Sends, or lets a client go that takes nothing for WRITE_S."""
    try:
        await asyncio.wait_for(response.write(data), WRITE_S)
    except asyncio.TimeoutError as error:
        if request.transport is not None:
            request.transport.abort()
        raise ConnectionResetError("the client takes nothing") from error
