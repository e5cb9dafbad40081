"""The test bench as a person feels it: from a slider to the redrawn page, in a real browser."""

from __future__ import annotations

import asyncio
import shutil
import statistics
import threading
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from benchmarks.figures import Figures

MOVES = 15
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]
#: What is moved, and between which values.
KNOBS = (
    ("rule: d_max", "decision.d_max_m", (9.0, 24.0)),
    ("truth: radius", "danger.cpa_radius_m", (3.0, 7.0)),
    ("mount: height", "camera.height_m", (3.0, 8.0)),
)


def run(figures: Figures) -> None:
    """Median of `performance.measure` in the page, from the change to the frame that shows it. The
    obvious way: the whole `Suite` made anew for every change, without the browser."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        print("testbench: skipped, no Chromium is installed (apt-get install chromium)")
        return
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        print("testbench: skipped, playwright is not installed (pip install bikeped[test])")
        return
    from benchmarks.figures import in_turns
    from bikeped.config.load import load_config
    from bikeped.config.schema import DecisionConfig
    from bikeped.lab.scenarios.scenario import bundled_folder, load_scenarios
    from bikeped.lab.simulation.suite import Suite

    loaded, scenarios = load_config(), load_scenarios(bundled_folder())
    one = [s for s in scenarios if s.name == "Bike Approaches Ped"]

    def anew(which: list[object]) -> float:
        def make() -> None:
            Suite.load(which, loaded).measure(DecisionConfig())  # type: ignore[arg-type]

        return in_turns(make, make, 5)[0]

    obvious = {"scenario": anew(list(one)) * 1e3, "suite": anew(list(scenarios)) * 1e3}
    goals = {"scenario": "200", "suite": "2000"}
    with _Served(loaded, scenarios) as url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.goto(f"{url}/testbench")
        idle = "#tb[data-scenario=idle][data-suite=idle]"
        page.wait_for_selector(idle)
        for name, key, values in KNOBS:
            slider = page.locator(f'input[data-key="{key}"]')
            slider.evaluate("node => { node.closest('details').open = true }")
            page.evaluate("performance.clearMeasures()")
            low, high = values
            for move in range(MOVES):
                slider.fill(f"{low + (high - low) * move / MOVES:.2f}")
                page.wait_for_selector(idle)
            for what in ("scenario", "suite"):
                found = page.evaluate(
                    "name => performance.getEntriesByName(name).map(e => e.duration)",
                    f"bench:{what}",
                )
                figures.add(
                    f"test bench, {name}, slider to redrawn {what}",
                    statistics.median(found),
                    obvious[what],
                    "ms",
                    goals[what],
                )
        browser.close()


class _Served:
    """The page, served by a thread until the block ends."""

    def __init__(self, loaded: object, scenarios: object) -> None:
        self._made = (loaded, scenarios)
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)

    def __enter__(self) -> str:
        self._thread.start()
        self._ready.wait(60)
        return f"http://127.0.0.1:{self._server.port}"

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(30)

    async def _run(self) -> None:
        from bikeped.config.output_sections import WebConfig
        from bikeped.lab.testbench.pages import add_testbench
        from bikeped.telemetry.http_server import HttpServer
        from bikeped.web.security import load_access_policy
        from bikeped.web.server import make_application

        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        config = WebConfig(port=0)
        app = make_application(
            load_access_policy(config),
            lambda app: add_testbench(app, *self._made),  # type: ignore[arg-type]
        )
        self._server = HttpServer(app, config)
        await self._server.start()
        self._ready.set()
        await self._stop.wait()
        await self._server.stop()
