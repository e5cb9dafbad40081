"""`/metrics` and `/healthz` over HTTP."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, get_args

import msgspec
from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.exposition import choose_encoder

from bikeped.config import WebConfig
from bikeped.telemetry.messages import ShownState

log = logging.getLogger(__name__)

Health = Callable[[], Mapping[str, Any]]
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

_WELL = frozenset(get_args(ShownState)) - {"FAULT"}


def make_app(
    registry: CollectorRegistry,
    health: Health,
    *,
    host: str = "127.0.0.1",
    allowed_hosts: tuple[str, ...] = (),
    client_max_size: int = 64 * 1024,
) -> web.Application:
    """The application with `/metrics` and `/healthz`, to which pages may be added.

    `health` returns the health message as a mapping; without a `state` that is known and not FAULT,
    or when it raises, `/healthz` answers 503. Bound to a loopback `host`, requests must name this
    machine (or one of `allowed_hosts`) in their Host header: otherwise any web page could have a
    visitor's browser read the pole under a name of its own (DNS rebinding). Bound elsewhere the
    owner has chosen to be reachable, under names that only he knows.
    """
    middlewares = []
    if is_loopback(host):
        names = {"localhost", "127.0.0.1", "::1", host.lower(), *map(str.lower, allowed_hosts)}
        middlewares.append(_only_hosts(frozenset(names)))
    app = web.Application(middlewares=middlewares, client_max_size=client_max_size)

    async def metrics(request: web.Request) -> web.Response:
        encode, content_type = choose_encoder(request.headers.get("Accept", ""))
        # Rendering takes milliseconds, which the loop that judges frames does not have.
        body = await asyncio.to_thread(encode, registry)
        return web.Response(body=body, headers={"Content-Type": content_type})

    async def healthz(_request: web.Request) -> web.Response:
        try:
            report = dict(health())
            body = msgspec.json.encode(report)
        except Exception:
            log.exception("healthz: the health report failed")
            report = {"state": "FAULT", "faults": ["the health report failed: see the log"]}
            body = msgspec.json.encode(report)
        status = 200 if report.get("state") in _WELL else 503
        return web.Response(
            status=status,
            body=body,
            content_type="application/json",
            headers={"Cache-Control": "no-store"},
        )

    app.router.add_get("/metrics", metrics)
    app.router.add_get("/healthz", healthz)
    return app


class HttpServer:
    """Serves an application at `config.host` and `config.port`.

    A port that cannot be bound is a line in `error`, never the end of the service.
    """

    def __init__(self, app: web.Application, config: WebConfig) -> None:
        self._app = app
        self._config = config
        self._runner: web.AppRunner | None = None
        self.error: str | None = None  #: why it is not serving, one line with the mend
        self.port: int | None = None  #: the port it serves; None while it does not

    async def start(self) -> bool:
        """Binds and serves; whether that worked. After a failure the application may not be reused:
        make a new one to try again."""
        # No access log: a scrape every few seconds for months is not news.
        runner = web.AppRunner(self._app, access_log=None, shutdown_timeout=1.0)
        await runner.setup()
        try:
            await web.TCPSite(runner, self._config.host, self._config.port).start()
        except OSError as exc:
            await runner.cleanup()
            self.error = (
                f"cannot serve http://{self._config.host}:{self._config.port} "
                f"({exc.strerror or exc}): set web.host and web.port to a free one of this machine"
            )
            log.error("web: %s", self.error)
            return False
        self._runner = runner
        self.error = None
        self.port = int(runner.addresses[0][1])
        log.info("web: serving http://%s:%d", self._config.host, self.port)
        return True

    async def stop(self) -> None:
        """Stops serving; open requests get a second to end."""
        runner, self._runner, self.port = self._runner, None, None
        if runner is not None:
            await runner.cleanup()


def is_loopback(host: str) -> bool:
    """Whether `host`, a name or an address, is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def host_name(header: str) -> str:
    """The name in a Host header, in small letters, without port and brackets."""
    name = header.strip().lower()
    if name.startswith("["):
        return name[1:].partition("]")[0]
    return name.partition(":")[0]


def _only_hosts(names: frozenset[str]) -> Any:
    @web.middleware
    async def check(request: web.Request, handler: _Handler) -> web.StreamResponse:
        if host_name(request.headers.get("Host", "")) not in names:
            raise web.HTTPForbidden(text="This Host is not allowed: open http://localhost instead.")
        return await handler(request)

    return check
