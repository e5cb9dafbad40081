"""The live page's streams over a real socket: what they say, and that nobody waits for them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Coroutine
from functools import partial
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
import simplejpeg
from aiohttp import web
from web_fakes import OPEN, SIGNALS, Scene, small, web_context

from bikeped.config.load import load_config
from bikeped.pipeline.application import WebContext
from bikeped.pipeline.replay import replay
from bikeped.telemetry.http_server import HttpServer
from bikeped.telemetry.latency import STAGES
from bikeped.telemetry.mqtt import MqttStatus
from bikeped.web.live import LivePage, add_live, display_source
from bikeped.web.live_state import ALERTS, TREND_S, LiveState
from bikeped.web.server import make_application
from bikeped.web.service_pages import ServicePages

PATIENCE_S = 20.0


class Page:
    """The live page's server with a state that the test feeds."""

    def __init__(self, within: WebContext) -> None:
        self.web_context = within
        self.state = LiveState()
        self.live = LivePage(self.state, within)
        self.scene = Scene(within.track_and_decide)
        app = make_application(OPEN, partial(add_live, live=self.live))
        self.server = HttpServer(app, within.loaded.config.web)
        self.url = ""

    async def start(self) -> None:
        assert await self.server.start()
        self.url = f"http://127.0.0.1:{self.server.port}"

    async def show(self, signal: str = "SAFE", sentence: str = "a sentence", **more: Any) -> None:
        result = self.scene.next(signal, **more)
        self.state.on_signal(SIGNALS[signal], sentence, result.tracking.decision)
        await self.state.on_frame_result(result)


@pytest.fixture
async def make_page() -> AsyncIterator[Callable[..., Any]]:
    pages: list[Page] = []

    async def make(*overrides: str, **options: Any) -> Page:
        pages.append(Page(web_context(small(*overrides), **options)))
        await pages[-1].start()
        return pages[-1]

    yield make
    for page in pages:
        await page.server.stop()


class Events:
    """Reads server-sent events."""

    def __init__(self, answer: aiohttp.ClientResponse) -> None:
        self._answer = answer

    async def until(self, name: str, fits: Callable[[Any], bool] = lambda data: True) -> Any:
        """The data of the next event `name` that fits."""

        async def read() -> Any:
            event = ""
            while line := (await self._answer.content.readuntil(b"\n")).decode():
                if line.startswith("event: "):
                    event = line[7:].strip()
                elif line.startswith("data: ") and event == name and fits(json.loads(line[6:])):
                    return json.loads(line[6:])
            raise AssertionError("the stream ended")

        return await asyncio.wait_for(read(), PATIENCE_S)


async def test_events_tell_the_state_the_reason_and_the_tracks(make_page):
    page = await make_page()
    await page.show("SAFE")
    async with aiohttp.ClientSession() as session, session.get(f"{page.url}/live/events") as answer:
        assert answer.headers["Content-Type"] == "text/event-stream"
        events = Events(answer)
        hello = await events.until("hello")
        assert hello["stages"] == list(STAGES)
        assert hello["source"] == "drawn.avi"
        assert hello["config_hash"] == page.web_context.loaded.hash
        now = await events.until("now")
        assert (now["signal"], now["colour"], now["sentence"]) == ("SAFE", "green", "a sentence")
        for _ in range(4):
            await page.show("ALERT", "ALERT: too near")
        now = await events.until("now", lambda data: data["frame"] == 4)
        assert (now["signal"], now["blink_hz"]) == ("ALERT", 2.0)
        assert [track["kind"] for track in now["tracks"]] == ["pedestrian", "cyclist"]
        tracks = page.state.result.tracking.tracks
        assert [(t["x"], t["y"]) for t in now["tracks"]] == [
            tuple(xy) for xy in tracks.xy_m.round(3).tolist()
        ]
        assert 0 <= now["frame_age_s"] < PATIENCE_S
        page.state.on_signal(SIGNALS["FAULT"], "camera: no frame for 2.0 s", None)
        now = await events.until("now", lambda data: data["signal"] == "FAULT")
        assert now["faults"] == ["camera: no frame for 2.0 s"]
        status = await events.until("status")
        assert status["health"]["counters"]["dropped"] == 2
        assert status["mqtt"] is None


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("/dev/video0", "/dev/video0"),
        ("/home/someone/rides/day.avi", "day.avi"),
        ("rtsp://camera.lan/1", "rtsp://camera.lan/..."),
        ("rtsp://admin:p@ss/word@10.0.0.4:554/1", "rtsp://..."),
        ("0", "0"),
    ],
)
def test_no_password_and_no_folder_of_a_source_is_shown(source, shown):
    assert display_source(source) == shown


async def test_the_broker_is_told_as_it_stands(make_page):
    down = MqttStatus(
        connected=False, error="refused", connects=0, published=0, dropped=3, superseded=0, queued=1
    )
    page = await make_page(mqtt=down)
    async with aiohttp.ClientSession() as session, session.get(f"{page.url}/live/events") as answer:
        events = Events(answer)
        assert (await events.until("hello"))["broker"] == "localhost:1883"
        status = await events.until("status")
        assert (status["mqtt"]["connected"], status["mqtt"]["error"]) == (False, "refused")


async def test_without_news_the_ages_grow(make_page):
    page = await make_page()
    await page.show()
    async with aiohttp.ClientSession() as session, session.get(f"{page.url}/live/events") as answer:
        events = Events(answer)
        first = await events.until("now")
        later = await events.until("now", lambda data: data["signal_age_s"] > 1.0)
        assert later["number"] == first["number"]
        assert later["frame_age_s"] > 1.0


async def test_alerts_are_kept_with_their_numbers_and_bounded():
    page = Page(web_context(small("decision.d_min_m=0.1", "decision.memory_frames=0")))
    state = page.state
    for _ in range(20):
        await page.show()
    assert len(state.alerts) == 1
    (alert,) = state.alerts
    assert alert.pair is not None
    assert alert.nearest_m < alert.pair["distance_m"]  # the cyclist came nearer
    assert alert.sentence.startswith("ALERT: ")
    assert alert.frames > 10
    assert alert.ended_unix_s is None
    number = state.alerts_revision
    for _ in range(3 * ALERTS):
        page.web_context.track_and_decide.reset()
        page.scene = Scene(page.web_context.track_and_decide)
        for _ in range(6):
            await page.show()
    assert len(state.alerts) == ALERTS
    assert state.alerts_revision > number
    assert all(alert.ended_unix_s is not None for alert in list(state.alerts)[:-1])


async def test_latencies_become_a_point_a_second_and_are_bounded():
    now_s = [1000.0]
    state = LiveState(wall_clock=lambda: now_s[0])
    scene = Scene(web_context().track_and_decide)
    results = [scene.next() for _ in range(6)]
    for second in range(TREND_S + 30):
        now_s[0] = 1000.0 + second
        for result in results:
            await state.on_frame_result(result)
    assert len(state.trend) == TREND_S
    point = state.trend[-1]
    assert (point.unix_s, point.fps) == (1000.0 + TREND_S + 28, 6)
    inference = [result.latency_ms["inference"] for result in results]
    row = STAGES.index("inference")
    assert point.p50[row] == round(float(np.percentile(inference, 50)), 2)
    assert point.p95[row] == round(float(np.percentile(inference, 95)), 2)
    assert point.p50[STAGES.index("decide")] is None  # a stage that did not run


# --- the picture


class Pictures:
    """Reads the parts of a Motion JPEG stream."""

    def __init__(self, answer: aiohttp.ClientResponse) -> None:
        self._content = answer.content
        boundary = answer.headers["Content-Type"].partition("boundary=")[2]
        self._edge = f"\r\n--{boundary}\r\nContent-Type: image/jpeg\r\n\r\n".encode()
        self._read = b""

    async def next(self) -> np.ndarray:
        """The next picture that is whole: the edge after it has come."""

        async def read() -> np.ndarray:
            while True:
                data, edge, rest = self._read.partition(self._edge)
                if edge and data:
                    self._read = rest
                    return simplejpeg.decode_jpeg(data)
                self._read = rest if edge else self._read + await self._content.readany()

        return await asyncio.wait_for(read(), PATIENCE_S)


async def test_the_stream_shows_the_newest_picture_with_what_was_found(make_page):
    page = await make_page("web.stream_width=480", "web.stream_fps=30")
    await page.show(grey=40)
    async with aiohttp.ClientSession() as session, session.get(f"{page.url}/live/stream") as answer:
        assert answer.headers["Content-Type"].startswith("multipart/x-mixed-replace")
        pictures = Pictures(answer)
        first = await pictures.next()
        assert first.shape == (320, 480, 3)
        assert abs(int(first[30, 30, 0]) - 40) < 6
        assert np.ptp(first[125:165, 200:220].astype(int)) > 60  # the pedestrian's box
        await page.show(grey=200)
        while abs(int((await pictures.next())[30, 30, 0]) - 200) > 6:
            pass


async def test_nothing_is_drawn_while_nobody_looks(make_page):
    page = await make_page("web.stream_fps=30")
    for _ in range(5):
        await page.show()
    assert page.live.renderer.number == 0
    async with aiohttp.ClientSession() as session:
        async with session.get(f"{page.url}/live/stream") as answer:
            await Pictures(answer).next()
        # The visitor leaves; as soon as the server learns of it, the drawing ends.
        while page.live.renderer._drawing is not None:
            await page.show()
            await asyncio.sleep(0.01)
        drawn = page.live.renderer.number
        for _ in range(20):
            await page.show()
            await asyncio.sleep(0.01)
        assert page.live.renderer.number == drawn


async def test_many_lookers_share_one_drawing(make_page):
    page = await make_page("web.max_viewers=5", "web.stream_fps=30")
    await page.show()
    async with aiohttp.ClientSession() as session:
        answers = [await session.get(f"{page.url}/live/stream") for _ in range(5)]
        for answer in answers:
            await Pictures(answer).next()
        assert page.live.renderer.number == 1
        for answer in answers:
            answer.close()


async def test_a_damaged_frame_is_a_picture_less_and_no_more(make_page, caplog):
    page = await make_page("web.stream_fps=30")
    result = page.scene.next()
    object.__setattr__(result.decoded.frame, "jpeg", b"\xff\xd8 no picture")
    await page.state.on_frame_result(result)
    async with aiohttp.ClientSession() as session, session.get(f"{page.url}/live/stream") as answer:
        waiting = asyncio.create_task(Pictures(answer).next())
        while not waiting.done():
            await page.show()
            await asyncio.sleep(0.01)
        assert (await waiting).shape == (640, 960, 3)
    assert "picture" in caplog.text


# --- caps, and slow clients


@pytest.mark.parametrize("path", ["/live/events", "/live/stream"])
async def test_more_viewers_than_allowed_are_turned_away_and_room_is_used_again(make_page, path):
    page = await make_page("web.max_viewers=2")
    await page.show()
    async with aiohttp.ClientSession() as session:
        first = await session.get(page.url + path)
        second = await session.get(page.url + path)
        async with session.get(page.url + path) as third:
            assert third.status == 503
            assert third.headers["Retry-After"]
            assert "web.max_viewers" in await third.text()
        second.close()

        async def again() -> None:
            while True:
                async with session.get(page.url + path) as answer:
                    if answer.status == 200:
                        return

        await asyncio.wait_for(again(), PATIENCE_S)
        first.close()


def at_once(call: Coroutine[Any, Any, None]) -> None:
    """Runs a coroutine to its end and fails if it waits for anything at all."""
    with pytest.raises(StopIteration):
        call.send(None)


async def test_a_client_that_reads_nothing_holds_nobody_up(make_page, monkeypatch):
    monkeypatch.setattr("bikeped.web.live.WRITE_S", 1.0)
    page = await make_page("web.stream_fps=30", "web.stream_width=960")
    port = page.server.port
    lazy = []
    for path in (b"/live/stream", b"/live/stream", b"/live/events"):
        reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1024)
        writer.write(b"GET " + path + b" HTTP/1.1\r\nHost: localhost\r\n\r\n")
        lazy.append((reader, writer))
    async with aiohttp.ClientSession() as session, session.get(f"{page.url}/live/stream") as answer:
        pictures = Pictures(answer)
        waiting = asyncio.create_task(pictures.next())
        # Until both lazy streams are let go, frames are taken as ever, and the eager one sees them.
        while page.live._streams > 1 or page.state.frame_count < 60:
            at_once(page.show(grey=int(page.state.frame_count) % 200))
            if waiting.done():
                await waiting
                waiting = asyncio.create_task(pictures.next())
            await asyncio.sleep(0.005)
        waiting.cancel()
        assert page.live._streams == 1
    for _, writer in lazy:
        writer.close()


async def test_stopping_the_server_ends_the_streams_at_once(make_page):
    page = await make_page()
    await page.show()
    async with aiohttp.ClientSession() as session:
        events = await session.get(f"{page.url}/live/events")
        stream = await session.get(f"{page.url}/live/stream")
        await page.server.stop()
        await asyncio.wait_for(events.content.read(), PATIENCE_S)
        await asyncio.wait_for(stream.content.read(), PATIENCE_S)


# --- within the service


class Probe(ServicePages):
    """The service's own pages, with a visitor in the same loop who asks while frames come."""

    def __init__(self, loaded: Any, visit: Callable[[str, web.Application], Any]) -> None:
        super().__init__(loaded)
        self._visit = visit
        self.found: Any = None

    def application(self, within: WebContext) -> web.Application:
        self.app = super().application(within)
        return self.app

    async def on_frame_result(self, result: Any) -> None:
        await super().on_frame_result(result)
        if self.state.frame_count == 3:
            self.found = await self._visit("", self.app)


def routes(app: web.Application) -> set[tuple[str, str]]:
    return {
        (route.method, route.resource.canonical)
        for route in app.router.routes()
        if route.resource is not None
    }


def test_no_page_of_the_service_changes_what_it_decides(make_clip, small_config):
    """Everything that takes a change is listed here: nothing of it reaches the running service."""
    loaded = load_config(small_config(make_clip("c.avi", 8)), ["web.enabled=true", "web.port=0"])

    async def visit(_url: str, app: web.Application) -> set[tuple[str, str]]:
        return routes(app)

    pages = Probe(loaded, visit)
    replay(loaded, str(loaded.path(loaded.config.camera.source)), pages=pages)
    changing = {route for route in pages.found if route[0] not in ("GET", "HEAD")}
    assert {path for _, path in changing} <= {
        "/login",
        "/logout",
        # Answers about an alignment, and the camera section of the file; the running service keeps
        # what it was started with.
        "/align/fit",
        "/align/grid",
        "/align/save",
    }
    assert not [path for _, path in pages.found if "decision" in path or "config" in path]
    reading = {path for _, path in pages.found}
    assert {"/", "/live/events", "/live/stream", "/metrics", "/healthz"} <= reading


def test_pages_change_no_decision(make_clip, small_config, tmp_path):
    """The same events, byte for byte, with a visitor and without."""
    from bikeped.telemetry.builders import decision_view

    clip = make_clip("c.avi", 20)
    views = []
    for run in range(2):
        loaded = load_config(small_config(clip), ["web.enabled=true", "web.port=0"])
        events: Path = tmp_path / f"{run}.jsonl"
        pages = ServicePages(loaded) if run else None
        replay(loaded, str(clip), events=events, pages=pages)
        lines = events.read_bytes().splitlines()[1:]
        views.append([decision_view(line) for line in lines])
    assert views[0] == views[1]
