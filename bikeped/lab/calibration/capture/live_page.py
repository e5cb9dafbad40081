"""The capture in a browser: the picture with what is covered, and what to do next.

`live_routes` can be mounted in any aiohttp application; `LivePage` serves them on their own while
the command runs.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from types import TracebackType

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

from bikeped.lab.calibration.capture.live_session import LiveSession

_BOUNDARY = "bikeped-board"
_WAIT_S = 1.0
_LOCAL = frozenset({"localhost", "127.0.0.1", "[::1]", "::1"})

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>bikeped: calibration</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body{margin:0;background:#14171a;color:#eceff1;font:18px/1.4 system-ui,sans-serif}
main{max-width:960px;margin:auto;padding:12px}
img{width:100%;background:#000;display:block}
#says{font-size:1.4em;margin:.5em 0 0}#next{color:#ffcc80;margin:.2em 0 .6em;min-height:2.8em}
progress{width:100%;height:14px}
</style></head><body><main>
<img src="calibrate/stream" alt="what the camera sees; green parts are covered, orange ones open">
<p id="says" role="status">waiting for the camera</p><p id="next"></p>
<progress id="bar" max="1" value="0"></progress><p id="count"></p>
<script>
const put = (id, text) => { document.getElementById(id).textContent = text; };
async function ask() {
  try {
    const now = await (await fetch("calibrate/status")).json();
    put("says", now.says); put("next", "Next: " + now.next);
    document.getElementById("bar").value = now.coverage;
    put("count", now.kept + " boards kept, " + Math.round(100 * now.coverage) + " % covered");
  } catch (error) { put("says", "the capture has ended"); }
  setTimeout(ask, 400);
}
ask();
</script></main></body></html>
"""


def live_routes(session: LiveSession) -> list[web.RouteDef]:
    """`/calibrate` (page), `/calibrate/status` (JSON), `/calibrate/stream` (Motion JPEG)."""

    async def page(_request: web.Request) -> web.Response:
        return web.Response(text=_PAGE, content_type="text/html")

    async def status(_request: web.Request) -> web.Response:
        return web.json_response(session.status(), headers={"Cache-Control": "no-store"})

    async def stream(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(
            headers={
                "Content-Type": f"multipart/x-mixed-replace; boundary={_BOUNDARY}",
                "Cache-Control": "no-store",
            }
        )
        await response.prepare(request)
        number = 0
        with contextlib.suppress(ConnectionError):
            while not session.stopped:
                newest, jpeg = await asyncio.to_thread(session.picture, number, _WAIT_S)
                if newest == number:
                    continue
                number = newest
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\n\r\n".encode()
                await response.write(head + jpeg + b"\r\n")
        return response

    return [
        web.get("/calibrate", page),
        web.get("/calibrate/status", status),
        web.get("/calibrate/stream", stream),
    ]


class LivePage:
    """Serves `live_routes` from a thread of its own; a context manager.

    `url` is where, None when the port cannot be had (`error` says why): the console guides as well.
    """

    def __init__(self, session: LiveSession, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        self._session, self._host, self._port = session, host, port
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
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
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        app = web.Application(middlewares=[_only_for(self._host)])
        app.add_routes(live_routes(self._session))
        app.router.add_get("/", _to_page)
        runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
        try:
            self._loop.run_until_complete(self._start(runner))
            self._ready.set()
            self._loop.run_forever()
        finally:
            self._ready.set()
            self._loop.run_until_complete(runner.cleanup())
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
            self._loop.close()

    async def _start(self, runner: web.AppRunner) -> None:
        await runner.setup()
        try:
            await web.TCPSite(runner, self._host, self._port).start()
        except OSError as error:
            self.error = f"port {self._port}: {error.strerror}; set web.port to a free one"
            return
        port = runner.addresses[0][1]
        self.url = f"http://{self._host}:{port}/calibrate"


async def _to_page(_request: web.Request) -> web.Response:
    raise web.HTTPFound("/calibrate")


def _only_for(host: str) -> Middleware:
    """Refuses other names than the served one: a page elsewhere must not read the camera by giving
    its own name this machine's address."""

    @web.middleware
    async def check(request: web.Request, handler: Handler) -> web.StreamResponse:
        asked = request.host.rsplit(":", 1)[0] if not request.host.endswith("]") else request.host
        if host in _LOCAL and asked not in _LOCAL:
            raise web.HTTPForbidden(text="this page is served to this machine only\n")
        return await handler(request)

    return check
