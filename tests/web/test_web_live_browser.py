"""The live page in a real browser: a moving replay in the real loop, every state, no contact."""

from __future__ import annotations

import asyncio
import logging
import re
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from aiohttp import web
from drawn_detectors import clip_detector
from playwright.sync_api import Page, expect
from web_fakes import DESKTOP, OPEN, PHONE, SIGNALS, Scene, small, web_context

from bikeped.config.load import load_config
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.rendering.clip import sidecar_path, write_clip
from bikeped.lab.scenarios.scenario import Scenario, parse_scenario
from bikeped.pipeline.replay import ReplayResult, replay
from bikeped.telemetry.builders import parse_event
from bikeped.web.live import LivePage, add_live
from bikeped.web.live_state import LiveState
from bikeped.web.server import make_application
from bikeped.web.service_pages import ServicePages

PATIENCE_S = 60.0

CROSSING = """
name: A cyclist comes up to a pedestrian
hazard: standard
expected: alert
vehicle: bicycle
agents:
  - {id: 1, kind: pedestrian, path: [[0.0, 5.0, -6.0], [4.0, 5.0, -4.0]]}
  - {id: 2, kind: cyclist, path: [[0.0, -11.0, -4.0], [4.0, 3.0, -5.0]]}
"""


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drawn seconds, small, with the boxes beside them."""
    path = tmp_path_factory.mktemp("clip") / "crossing.avi"
    loaded = load_config(None, ["camera.source=x"])
    scenario: Scenario = parse_scenario(CROSSING, "crossing.yaml")
    write_clip(ScenePainter(scenario, scene_camera(loaded, (640, 360)), Conditions()), path, fps=15)
    return path


class SlowDetector:
    """Takes its time over every frame until it may hurry: a slow browser misses nothing."""

    def __init__(self, clip: Path) -> None:
        self._detector = clip_detector(sidecar_path(clip))
        self.name, self.model_hash = self._detector.name, None
        self.cyclist_box_includes_rider = self._detector.cyclist_box_includes_rider
        self.decode_size = self._detector.decode_size
        self.hurry = threading.Event()

    def detect(self, picture: Any) -> Any:
        self.hurry.wait(0.3)
        return self._detector.detect(picture)


class Running:
    """A replay with its pages, in a thread."""

    def __init__(self, clip: Path, events: Path) -> None:
        overrides = ["web.enabled=true", "web.port=0", "web.stream_width=640"]
        self.loaded = load_config(None, overrides)
        self.pages = ServicePages(self.loaded)
        self.result: ReplayResult | None = None
        self._clip, self._events = clip, events
        self.detector = SlowDetector(clip)
        self._address = threading.Event()
        self.url = ""
        handler = logging.Handler(logging.INFO)
        handler.emit = self._heard  # type: ignore[method-assign]
        self._log = logging.getLogger("bikeped.telemetry.http_server")
        self._handler, self._level = handler, self._log.level
        self._log.addHandler(handler)
        self._log.setLevel(logging.INFO)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._address.wait(PATIENCE_S)

    def _heard(self, record: logging.LogRecord) -> None:
        found = re.search(r"http://\S+", record.getMessage())
        if found:
            self.url = found[0]
            self._address.set()

    def _run(self) -> None:
        self.result = replay(
            self.loaded,
            str(self._clip),
            detector=self.detector,
            events=self._events,
            mqtt=False,
            pages=self.pages,
        )

    def wait(self) -> None:
        self.detector.hurry.set()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        self._log.removeHandler(self._handler)
        self._log.setLevel(self._level)


#: Keeps every state that the page shows, from its first moment.
FOLLOW = """() => {
  window.states = [];
  const state = document.querySelector('#state');
  const note = () => window.states.push(state.dataset.state);
  new MutationObserver(note).observe(state, {attributes: true, attributeFilter: ['data-state']});
  note();
}"""

#: The picture's grey values, coarsely: two different frames differ.
LOOK = """() => {
  const image = document.querySelector('#picture');
  if (!image.naturalWidth) return null;
  const canvas = document.createElement('canvas');
  canvas.width = 64; canvas.height = 36;
  const context = canvas.getContext('2d');
  context.drawImage(image, 0, 0, 64, 36);
  return Array.from(context.getImageData(0, 0, 64, 36).data).join(',');
}"""


def test_a_moving_replay_from_the_first_frame_to_no_contact(
    clip, tmp_path, open_page, until, page_errors
):
    # The browser first: its start must not eat the recording.
    page: Page = open_page("about:blank", DESKTOP)
    running = Running(clip, tmp_path / "events.jsonl")
    page.goto(running.url)
    page.evaluate(FOLLOW)
    first = until(page, f"({LOOK})()")
    until(page, f"({LOOK})() !== '{first}'")  # frames change
    expect(page.locator("#state")).to_have_attribute("data-state", "ALERT")
    expect(page.locator("#state-word")).to_have_text("Alert")
    expect(page.locator("#tracks")).to_contain_text("cyclist")
    expect(page.locator("#tracks")).to_contain_text("pedestrian")
    expect(page.locator("#why")).to_contain_text("cyclist")
    expect(page.locator("#alerts li")).to_have_count(1)
    assert page_errors(page) == []
    running.wait()
    expect(page.locator("#state-word")).to_have_text("No contact")
    expect(page.locator("#live")).to_have_attribute("data-contact", "lost")
    page_errors(page).clear()  # the browser says that it was cut off

    assert running.result is not None
    lines = (tmp_path / "events.jsonl").read_bytes().splitlines()[1:]
    lit = {parse_event(line).light for line in lines}
    shown = page.evaluate("window.states")
    assert {"ALERT", "FAULT"} <= lit  # FAULT, until a few frames were good
    assert set(shown) - {"STALE", "OFF"} <= lit
    assert shown[-1] == "STALE"


# --- the page with a service whose state the test chooses


class LiveServer:
    """A live page's server that repeats the signal which the test sets."""

    def __init__(self, start: Callable[..., Any]) -> None:
        self.within = web_context(small("web.stream_fps=30", "decision.d_min_m=0.1"))
        self.state = LiveState()
        self.scene = Scene(self.within.track_and_decide)
        self._signal = ("SAFE", "Somebody is here.")
        self.ticks = True
        self.served = start(self._make)
        self.url = self.served.url

    def _make(self) -> web.Application:
        self.live = LivePage(self.state, self.within)
        app = make_application(OPEN, partial(add_live, live=self.live))

        async def begin(_app: web.Application) -> None:
            self._task = asyncio.create_task(self._tick())

        async def end(_app: web.Application) -> None:
            self._task.cancel()

        app.on_startup.append(begin)
        app.on_cleanup.append(end)
        return app

    async def _tick(self) -> None:
        while True:
            name, sentence = self._signal
            if self.ticks:
                decision = None
                if self.state.result is not None:
                    decision = self.state.result.tracking.decision
                self.state.on_signal(SIGNALS[name], sentence, decision)
            await asyncio.sleep(0.05)

    def set_signal(self, name: str, sentence: str = "Because.") -> None:
        self._signal = (name, sentence)

    def show_frame(self, count: int = 1) -> None:
        async def show() -> None:
            for _ in range(count):
                await self.state.on_frame_result(self.scene.next())

        asyncio.run_coroutine_threadsafe(show(), self.served.loop).result(PATIENCE_S)


@pytest.fixture
def live_server(start_server: Callable[..., Any]) -> Iterator[LiveServer]:
    return LiveServer(start_server)


@pytest.mark.parametrize("name", ["IDLE", "SAFE", "WARNING", "ALERT", "FAULT", "OFF"])
def test_every_state_has_a_word_a_shape_and_a_reason(
    live_server, open_page, assert_accessible, name
):
    live_server.set_signal(name, f"{name}: because of this")
    live_server.show_frame(3)
    page = open_page(live_server.url, PHONE)
    state = page.locator("#state")
    expect(state).to_have_attribute("data-state", name)
    expect(page.locator("#state-word")).to_have_text(name.capitalize())
    expect(page.locator("#state-sentence")).to_have_text("Because of this")
    expect(page.locator("#state-mark svg")).to_have_count(1)
    expect(page).to_have_title(f"{name.capitalize()} · Live · bikeped")
    expect(page.locator("#announcer")).to_contain_text(name.capitalize())
    assert_accessible(page)


def test_no_two_states_share_a_shape(live_server, open_page):
    page = open_page(live_server.url)
    shapes = page.evaluate(
        "import('/static/ui.js').then(ui => Object.keys(ui.STATES).map("
        "name => ui.stateIcon(name).outerHTML))"
    )
    assert len(shapes) == len(set(shapes)) == 7


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("viewport", [PHONE, DESKTOP], ids=["phone", "desktop"])
def test_the_whole_page_is_accessible_and_fits(
    live_server, open_page, assert_accessible, viewport, scheme
):
    live_server.show_frame(12)
    live_server.set_signal("ALERT", "Cyclist 2 and pedestrian 1 are near one another.")
    page = open_page(live_server.url, viewport, scheme)
    expect(page.locator("#tracks tr")).to_have_count(2)
    expect(page.locator("#latency tr")).to_have_count(9)
    expect(page.locator("#health")).to_contain_text("frames/s")
    expect(page.locator("#health")).to_contain_text("0.16 m at 10 m")
    page.locator("#checks").evaluate("checks => { checks.open = true; }")
    expect(page.locator("#checks-rows")).to_contain_text("blurred1.501.002.5")
    assert_accessible(page)
    assert page.evaluate("document.scrollingElement.scrollWidth <= innerWidth")
    small_ones = page.evaluate(
        "[...document.querySelectorAll('button, nav a')].map(e => e.getBoundingClientRect())"
        ".filter(r => r.width < 36 || r.height < 36).length"
    )
    assert small_ones == 0


def test_a_fault_says_why_and_is_never_green(live_server, open_page):
    live_server.show_frame()
    page = open_page(live_server.url)
    expect(page.locator("#state")).to_have_attribute("data-state", "SAFE")
    live_server.set_signal("FAULT", "camera: no frame for 2.0 s")
    expect(page.locator("#state-word")).to_have_text("Fault")
    expect(page.locator("#state-sentence")).to_have_text("Camera: no frame for 2.0 s")
    expect(page.locator("#light-now")).to_have_text("orange, blinking")
    colour = page.evaluate("getComputedStyle(document.querySelector('#state')).backgroundColor")
    assert colour == "rgb(245, 168, 0)"
    expect(page.locator("#picture-note")).to_contain_text("old")


def test_a_service_that_no_longer_decides_is_no_contact(live_server, open_page, until):
    live_server.show_frame()
    page = open_page(live_server.url)
    expect(page.locator("#state")).to_have_attribute("data-state", "SAFE")
    live_server.ticks = False  # the server answers, but nothing is decided any more
    expect(page.locator("#state")).to_have_attribute("data-state", "STALE")
    expect(page.locator("#state-sentence")).to_contain_text("has decided nothing")
    expect(page.locator("#live")).to_have_attribute("data-contact", "lost")
    live_server.ticks = True
    expect(page.locator("#state")).to_have_attribute("data-state", "SAFE")
    expect(page.locator("#live")).to_have_attribute("data-contact", "live")


def test_a_dead_server_leaves_no_reassuring_colour(live_server, open_page, page_errors):
    live_server.show_frame()
    page = open_page(live_server.url)
    expect(page.locator("#state")).to_have_attribute("data-state", "SAFE")
    safe = page.evaluate("getComputedStyle(document.querySelector('#state')).backgroundColor")
    live_server.served.stop()
    expect(page.locator("#state-word")).to_have_text("No contact")
    expect(page.locator("#announcer")).to_contain_text("No contact")
    grey = page.evaluate("getComputedStyle(document.querySelector('#state')).backgroundColor")
    assert grey != safe
    red, green, blue = map(int, re.findall(r"\d+", grey)[:3])
    assert max(red, green, blue) - min(red, green, blue) < 12  # grey
    expect(page.locator("#picture-note")).to_have_text(re.compile("stopped|out of date"))
    assert page.evaluate("getComputedStyle(document.querySelector('.radar')).opacity") < "0.6"
    page_errors(page).clear()


def test_markup_in_a_sentence_is_text(live_server, open_page):
    live_server.set_signal("SAFE", "<img src=x onerror='window.bad=1'><b>bold</b>")
    page = open_page(live_server.url)
    expect(page.locator("#state-sentence")).to_contain_text("<img src=x")
    assert page.locator("#state-sentence *").count() == 0
    assert page.evaluate("window.bad") is None


def test_a_hidden_or_paused_page_costs_nothing(live_server, open_page, until):
    live_server.show_frame(2)
    page = open_page(live_server.url)
    until(page, f"({LOOK})()")
    assert (live_server.live._pages, live_server.live._streams) == (1, 1)

    def gone() -> None:
        while live_server.live._pages or live_server.live._streams:
            live_server.show_frame()
            page.wait_for_timeout(20)

    page.click("#picture-switch")
    expect(page.locator("#picture-note")).to_have_text("Paused: no picture is sent.")
    while live_server.live._streams:
        live_server.show_frame()
        page.wait_for_timeout(20)
    assert live_server.live._pages == 1
    page.click("#picture-switch")
    until(page, f"({LOOK})()")
    page.evaluate(
        "Object.defineProperty(document, 'hidden', {get: () => true, configurable: true});"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )
    gone()
    assert live_server.live.renderer._drawing is None
    page.evaluate(
        "Object.defineProperty(document, 'hidden', {get: () => false, configurable: true});"
        "document.dispatchEvent(new Event('visibilitychange'))"
    )
    live_server.show_frame()
    expect(page.locator("#live")).to_have_attribute("data-contact", "live")


def test_too_many_viewers_are_refused_with_a_reason(start_server, open_page, page_errors):
    live_server = LiveServer(start_server)
    live_server.live._config = small("web.max_viewers=1").config.web
    first = open_page(live_server.url)
    expect(first.locator("#live")).to_have_attribute("data-contact", "live")
    second = open_page(live_server.url)
    expect(second.locator("#state-sentence")).to_contain_text(
        "The device allows no more live pages"
    )
    page_errors(second).clear()
    first.close()
    page_errors(second).clear()


def test_the_radar_draws_what_the_table_says(live_server, open_page, until):
    """A pedestrian 7 m ahead: the mark's colour is where the rings say 7 m is."""
    live_server.show_frame(3)
    page = open_page(live_server.url)
    expect(page.locator("#tracks tr")).to_have_count(2)
    tracks = live_server.state.snapshot().tracks
    # The picture of a state is drawn in the browser's next frame, after its table.
    page.wait_for_function(
        """([x, y, colour]) => {
          const canvas = document.querySelector('#radar');
          const {width, height} = canvas.getBoundingClientRect();
          const scale = Math.min((width - 20) / 60, (height - 20) / 36);
          const u = width / 2 + scale * y;
          const v = (height - scale * 36) / 2 + scale * 30 - scale * x;
          const k = canvas.width / width;
          // Read from a copy: the browser warns of a drawn canvas that is read again and again.
          const copy = new OffscreenCanvas(1, 1).getContext('2d', {willReadFrequently: true});
          copy.drawImage(canvas, Math.floor(u * k), Math.floor(v * k), 1, 1, 0, 0, 1, 1);
          return [...copy.getImageData(0, 0, 1, 1).data].join() === colour;
        }""",
        arg=[tracks[0].x, tracks[0].y, "138,75,0,255"],  # --pedestrian of the light scheme
    )
