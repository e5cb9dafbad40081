"""Pages in a real headless Chromium, and servers for them in a thread.

Browser tests are plain functions (the synchronous API) in modules of their own, named
`test_*_browser.py`: Playwright's loop and pytest-asyncio's do not share a thread, so such a
module holds no `async def` test.

    def test_it(serve, open_page):
        url = serve(lambda: make_application(access, add_mine))
        page = open_page(url + "/mine")

`open_page` fails the test at its end on any console error, page error or failed request that the
test did not expect (`page_errors(page).clear()` after an expected one). To wait for something, use
playwright's `expect` or `until(page, "an expression")`: `page.wait_for_function` evaluates text,
which the pages' policy forbids.
"""

from __future__ import annotations

import asyncio
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from aiohttp import web
from axe_playwright_python.base import AXE_SCRIPT
from playwright.sync_api import Browser, BrowserContext, Page, Playwright, expect, sync_playwright
from web_fakes import DESKTOP

from bikeped.config.output_sections import WebConfig
from bikeped.telemetry.http_server import HttpServer

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--force-color-profile=srgb",
]
PATIENCE_S = 60.0  # reached only by a failure


class Served:
    """An application served by a thread of its own at `url` until `stop`."""

    def __init__(self, make: Callable[[], web.Application], config: WebConfig) -> None:
        self._make, self._config = make, config
        self._started = threading.Event()
        self._error: BaseException | None = None
        self.url = ""
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)
        self._thread.start()
        assert self._started.wait(PATIENCE_S)
        if self._error is not None:
            raise self._error

    async def _run(self) -> None:
        self.loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        try:
            self.server = HttpServer(self._make(), self._config)
            assert await self.server.start(), self.server.error
            self.url = f"http://127.0.0.1:{self.server.port}"
        except Exception as error:  # noqa: BLE001 - the fixture raises it
            self._error = error
            return
        finally:
            self._started.set()
        await self._stop.wait()
        await self.server.stop()

    def stop(self) -> None:
        """Stops serving; does nothing when called again."""
        if self._thread.is_alive():
            self.loop.call_soon_threadsafe(self._stop.set)
            self._thread.join(PATIENCE_S)
            assert not self._thread.is_alive()


@pytest.fixture
def start_server() -> Iterator[Callable[..., Served]]:
    """Serves what a function makes (called in the server's own loop); stops at the test's end."""
    running: list[Served] = []

    def start(make: Callable[[], web.Application], **config: Any) -> Served:
        running.append(Served(make, WebConfig(**{"port": 0, **config})))
        return running[-1]

    yield start
    for served in running:
        served.stop()


@pytest.fixture
def serve(start_server: Callable[..., Served]) -> Callable[..., str]:
    """Like `start_server`, but only its address is wanted."""
    return lambda make, **config: start_server(make, **config).url


@pytest.fixture(scope="module")
def playwright() -> Iterator[Playwright]:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    expect.set_options(timeout=PATIENCE_S * 1e3)
    with sync_playwright() as running:
        yield running


@pytest.fixture(scope="module")
def browser(playwright: Playwright) -> Iterator[Browser]:
    """One Chromium for all tests of a module."""
    browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
    yield browser
    browser.close()


_errors: dict[Page, list[str]] = {}


@pytest.fixture
def page_errors() -> Callable[[Page], list[str]]:
    """What went wrong in a page so far: console errors, exceptions, requests that failed."""
    return lambda page: _errors[page]


@pytest.fixture
def until() -> Callable[[Page, str], Any]:
    """Waits until an expression in a page is true, and returns its value."""

    def wait(page: Page, expression: str) -> Any:
        deadline_s = time.monotonic() + PATIENCE_S
        while not (value := page.evaluate(expression)):
            assert time.monotonic() < deadline_s, f"never came true: {expression}"
            page.wait_for_timeout(30)
        return value

    return wait


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Opens an address in a fresh context; `viewport` (of web_fakes), `scheme` light or dark,
    further keywords as `browser.new_context` takes them."""
    contexts: list[BrowserContext] = []

    def open_it(
        url: str, viewport: dict[str, int] = DESKTOP, scheme: str = "light", **options: Any
    ) -> Page:
        options.setdefault("reduced_motion", "reduce")
        options.setdefault("has_touch", viewport["width"] < 600)
        contexts.append(browser.new_context(viewport=viewport, color_scheme=scheme, **options))
        contexts[-1].set_default_timeout(PATIENCE_S * 1e3)
        page = contexts[-1].new_page()
        watch(page)
        page.goto(url)
        return page

    yield open_it
    found = [line for context in contexts for page in context.pages for line in _errors.pop(page)]
    for context in contexts:
        context.close()
    assert found == []


def watch(page: Page) -> None:
    """Collects what goes wrong in a page."""
    found = _errors[page] = []
    page.on(
        "console",
        lambda message: (
            found.append(message.text) if message.type in ("error", "warning") else None
        ),
    )
    page.on("pageerror", lambda error: found.append(f"exception: {error}"))

    def failed(request: Any) -> None:
        # A page that is left cuts off its streams: no fault of theirs.
        if request.failure != "net::ERR_ABORTED":
            found.append(f"{request.url}: {request.failure}")

    page.on("requestfailed", failed)


@pytest.fixture
def assert_accessible() -> Callable[[Page], None]:
    """Fails on serious or critical findings of axe-core."""

    def check(page: Page) -> None:
        page.evaluate(AXE_SCRIPT)
        found = page.evaluate("() => axe.run(document, {resultTypes: ['violations']})")
        grave = [
            f"{item['id']} ({item['impact']}): {item['help']}: "
            + "; ".join(node["html"][:120] for node in item["nodes"][:3])
            for item in found["violations"]
            if item["impact"] in ("serious", "critical")
        ]
        assert grave == []

    return check
