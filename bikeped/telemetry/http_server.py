"""`/metrics` and `/healthz` over HTTP, and the HTTP server that serves them and the pages."""

from __future__ import annotations

import asyncio
import logging
import math
import socket
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, get_args

import msgspec
from aiohttp import web
from aiohttp.http import HttpProcessingError
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

from bikeped.config.output_sections import WebConfig
from bikeped.telemetry.schema import ShownState

log = logging.getLogger(__name__)
_requests_log = log.getChild("requests")

Health = Callable[[], Mapping[str, Any]]

_HEALTHY = frozenset(get_args(ShownState)) - {"FAULT"}
#: A connection without a request for this long is closed, to free its place.
IDLE_S = 20.0
#: Requests answered a second, by a service.
REQUESTS_HZ = 40.0
#: A client that takes nothing of its answer for this long is cut off.
SEND_S = 10.0
#: Bytes that the system holds for a slow client, and of an upload: what one turn of the loop takes.
_SEND_BUFFER, _RECEIVE_BUFFER = 128 * 1024, 16 * 1024
#: All that ask for metrics within this time get the same text.
_METRICS_S = 0.5
#: How long the rest of a refused body is read and discarded, so that the sender gets the answer.
_LINGER_S = 0.5
#: Turns of asyncio's loop from an accepted socket to its `connection_made`, and one more.
_TURNS_TO_ACCEPT = 4
_BACKLOG = 32


def add_monitoring(app: web.Application, registry: CollectorRegistry, health: Health) -> None:
    """Adds `/metrics` (Prometheus) and `/healthz` to an application.

    `health` returns the health message as a mapping; `/healthz` answers 503 when its `state` is
    FAULT, unknown or absent, and when `health` raises.
    """

    rendered: dict[str, tuple[float, asyncio.Future[bytes]]] = {}

    async def metrics(request: web.Request) -> web.Response:
        encode, content_type = choose_encoder(request.headers.get("Accept", ""))
        now_s = time.monotonic()
        made_s, body = rendered.get(content_type, (-math.inf, None))
        if body is None or now_s - made_s > _METRICS_S:
            # Rendering takes milliseconds: too long for the event loop, too long for each reader.
            body = asyncio.ensure_future(asyncio.to_thread(encode, registry))
            rendered[content_type] = now_s, body
        return web.Response(body=await asyncio.shield(body), headers={"Content-Type": content_type})

    async def healthz(_request: web.Request) -> web.Response:
        try:
            report = dict(health())
            body = msgspec.json.encode(report)
        except Exception:
            log.exception("healthz: the health report failed")
            report = {"state": "FAULT", "faults": ["the health report failed: see the log"]}
            body = msgspec.json.encode(report)
        status = 200 if report.get("state") in _HEALTHY else 503
        return web.Response(
            status=status,
            body=body,
            content_type="application/json",
            headers={"Cache-Control": "no-store"},
        )

    app.router.add_get("/metrics", metrics)
    app.router.add_get("/healthz", healthz)


def limit_rate(app: web.Application) -> None:
    """Answers at most REQUESTS_HZ requests a second, after as many at once; the others wait.

    The loop that answers is the one that watches the crossing.
    """
    free_s = -math.inf

    @web.middleware
    async def wait_for_turn(
        request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        nonlocal free_s
        now_s = time.monotonic()
        free_s = max(free_s, now_s - 1.0) + 1.0 / REQUESTS_HZ
        if free_s > now_s:
            await asyncio.sleep(free_s - now_s)
        return await handler(request)

    app.middlewares.insert(0, wait_for_turn)


class HttpServer:
    """Serves an application at `config.host` and `config.port`, up to `config.max_connections`.

    A port that cannot be bound is reported in `error`; the service goes on.
    """

    def __init__(self, app: web.Application, config: WebConfig) -> None:
        self._app = app
        self._config = config
        self._runner: web.AppRunner | None = None
        self._server: asyncio.Server | None = None
        self.error: str | None = None  #: why it is not serving, one line with the remedy
        self.port: int | None = None  #: None while it does not serve

    async def start(self) -> bool:
        """Binds and serves; returns whether that worked. After a failure, retry with a new
        application: this one cannot be reused."""
        config = self._config
        runner = web.AppRunner(
            self._app,
            access_log=None,  # it would be mostly scrapes
            logger=_requests_log,
            shutdown_timeout=1.0,
            keepalive_timeout=IDLE_S,
            lingering_time=_LINGER_S,
        )
        await runner.setup()
        accept = runner.server
        if accept is None:  # pragma: no cover - set by setup()
            raise RuntimeError("the application is not set up")

        def new_connection() -> asyncio.BaseProtocol:
            full = len(accept.connections) >= config.max_connections
            return _RejectConnection() if full else accept()

        try:
            self._server = await asyncio.get_running_loop().create_server(
                new_connection, config.host, config.port, backlog=_BACKLOG
            )
        except OSError as exc:
            await runner.cleanup()
            self.error = _bind_error(config, exc)
            log.error("web: %s", self.error)
            return False
        for listening in self._server.sockets:
            _bound_buffers(listening)
        self._runner = runner
        self.error = None
        self.port = int(self._server.sockets[0].getsockname()[1])
        log.info("web: serving %s", self.address)
        return True

    @property
    def address(self) -> str | None:
        """What to open in a browser; None while it does not serve."""
        if self.port is None:
            return None
        host = f"[{self._config.host}]" if ":" in self._config.host else self._config.host
        return f"http://{host}:{self.port}/"

    async def stop(self) -> None:
        """Stops serving; open requests get a second to end, then they are cut off."""
        runner, self._runner, self.port = self._runner, None, None
        if self._server is not None:
            self._server.close()
            self._server = None
        accepting = None if runner is None else runner.server
        if runner is None or accepting is None:
            return
        for _ in range(_TURNS_TO_ACCEPT):  # connections being accepted at close() exist after this
            await asyncio.sleep(0)
        connections = [c.transport for c in accepting.connections if c.transport is not None]
        await runner.cleanup()
        connections += [c.transport for c in accepting.connections if c.transport is not None]
        for connection in connections:
            connection.abort()
        for _ in range(_TURNS_TO_ACCEPT):  # until their closing is processed
            await asyncio.sleep(0)


def _bound_buffers(listening: Any) -> None:
    """What the sockets of accepted connections inherit: small buffers, and an end to waiting."""
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux
        limit_ms = round(SEND_S * 1e3)
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, limit_ms)


def _not_malformed(record: logging.LogRecord) -> bool:
    """Malformed requests (port scans, a 9 kB address) are answered with 400 and not logged."""
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


_requests_log.addFilter(_not_malformed)


def port_error(config: WebConfig) -> str | None:
    """Why `HttpServer` could not serve at `config` now, one line with the remedy; None if it could.

    For a check before long work; the port may still be taken by the time of serving.
    """
    try:
        found = socket.getaddrinfo(config.host, config.port, type=socket.SOCK_STREAM)
        for family, _, _, _, place in found:
            socket.create_server(place, family=family).close()
    except OSError as exc:
        return _bind_error(config, exc)
    return None


def _bind_error(config: WebConfig, error: OSError) -> str:
    return (
        f"cannot serve http://{config.host}:{config.port} "
        f"({error.strerror or error}): set web.host and web.port to a free one of this machine"
    )


class _RejectConnection(asyncio.Protocol):
    """Answers a connection above the limit with 503 and closes it."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if isinstance(transport, asyncio.WriteTransport):
            text = b"Too many connections are open: close a page, or try again later.\n"
            transport.write(
                b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: text/plain\r\n"
                b"Retry-After: 5\r\nConnection: close\r\n"
                b"Content-Length: %d\r\n\r\n%s" % (len(text), text)
            )
        transport.close()


def host_name(header: str) -> str:
    """The host of a Host header, lower-case, without port and brackets."""
    name = header.strip().lower()
    if name.startswith("["):
        return name[1:].partition("]")[0]
    return name.partition(":")[0]
