"""The capture in a browser: the camera's picture, what is covered, and what to do next."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
from pathlib import Path
from types import TracebackType

from aiohttp import hdrs, web

from bikeped.config.schema import WebConfig
from bikeped.lab.calibration.capture.live_session import LiveSession
from bikeped.telemetry.http_server import HttpServer
from bikeped.web.security import load_access_policy
from bikeped.web.server import Page, add_page, json_answer, make_application

_BOUNDARY = "bikeped-board"
_HEAD = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\n\r\n".encode()
_WAIT_S = 1.0
_PAGE = Page(
    "/calibrate",
    "Calibration",
    "Calibration",
    "calibrate.html",
    scripts=("calibrate.js",),
    styles=("calibrate.css",),
    folder=Path(__file__).parent,
)


def add_live_page(app: web.Application, session: LiveSession) -> None:
    """Adds `/calibrate` (page), `/calibrate/status` (JSON), `/calibrate/stream` (Motion JPEG)."""

    async def status(_request: web.Request) -> web.Response:
        return json_answer(session.status())

    async def stream(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(
            headers={hdrs.CONTENT_TYPE: f"multipart/x-mixed-replace; boundary={_BOUNDARY}"}
        )
        await response.prepare(request)
        number = 0
        with contextlib.suppress(ConnectionError):
            while not session.stopped:
                newest, jpeg = await asyncio.to_thread(session.picture, number, _WAIT_S)
                if newest != number:
                    number = newest
                    await response.write(_HEAD + jpeg + b"\r\n")
        return response

    add_page(app, _PAGE)
    app.router.add_get("/calibrate/status", status)
    app.router.add_get("/calibrate/stream", stream)


class LivePage:
    """Serves the page to this machine from a thread of its own; a context manager.

    `url` is its address, None when the port cannot be bound (`error` says why): the console guides
    as well.
    """

    def __init__(self, session: LiveSession, *, port: int = 8080) -> None:
        self._session = session
        self._config = WebConfig(host="127.0.0.1", port=port)
        self._loop = asyncio.new_event_loop()
        self._ready, self._stop = threading.Event(), asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="calibration-page", daemon=True)
        self.url: str | None = None
        self.error: str | None = None

    def __enter__(self) -> LivePage:
        self._thread.start()
        self._ready.wait()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._session.stop()
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
        finally:
            self._ready.set()
            self._loop.close()

    async def _serve(self) -> None:
        add = functools.partial(add_live_page, session=self._session)
        server = HttpServer(make_application(load_access_policy(self._config), add), self._config)
        if await server.start():
            self.url = f"{server.address}calibrate"
        self.error = server.error
        self._ready.set()
        await self._stop.wait()
        await server.stop()
