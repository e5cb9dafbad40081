"""Serving pages from a command until it is stopped: `bikeped align`, `bikeped testbench`."""

from __future__ import annotations

import asyncio
import signal as signals
from collections.abc import Callable
from pathlib import Path

from aiohttp import web

from bikeped.config import WebConfig
from bikeped.errors import BikepedError
from bikeped.telemetry.http_server import HttpServer
from bikeped.web.security import load_access_policy
from bikeped.web.server import make_application


def serve_pages(
    config: WebConfig,
    *page_adders: Callable[[web.Application], None],
    announce: Callable[[str], None],
    base_dir: Path = Path(),
    source: str = "web",
) -> None:
    """Serves the pages that `page_adders` add until SIGINT or SIGTERM; `announce` gets the address.

    Raises ConfigError when others could reach them without a token, BikepedError when the port
    cannot be bound.
    """
    access = load_access_policy(config, base_dir, source)
    asyncio.run(_serve(config, make_application(access, *page_adders), announce))


async def _serve(config: WebConfig, app: web.Application, announce: Callable[[str], None]) -> None:
    stop = asyncio.Event()
    for number in (signals.SIGTERM, signals.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    server = HttpServer(app, config)
    if not await server.start():
        raise BikepedError(str(server.error))
    try:
        announce(str(server.address))
        await stop.wait()
    finally:
        await server.stop()
