"""The test bench at an alert, with a contest, while drawing; and the report."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import TYPE_CHECKING

from playwright.sync_api import Page

if TYPE_CHECKING:
    from screenshots import Studio

PATIENCE_MS = 120_000
_IDLE = "#tb[data-scenario=idle][data-suite=idle]"


def take(studio: Studio) -> None:
    """All looks of the page, and one of each further thing to see."""
    words = [sys.executable, "-m", "bikeped.cli.main", "testbench"]
    process = subprocess.Popen([*words, "--port", "0"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"http://\S+", line)
        assert found is not None, line
        url = found[0]

        def ready(page: Page) -> None:
            page.wait_for_selector(_IDLE, timeout=PATIENCE_MS)

        def contest(page: Page) -> None:
            ready(page)
            page.locator(".tb-suite").scroll_into_view_if_needed()
            page.evaluate("document.querySelector('.tb-suite').scrollIntoView()")

        def draw(page: Page) -> None:
            ready(page)
            page.click("#edit")

        desktop, light = ("desktop",), ("light",)
        studio.shoot("testbench", url, ready)
        compared = '#scenario=Late%20Turn%20Toward%20Ped&beside=%5B"ttc","narrow"%5D'
        studio.shoot("testbench-compare", url + compared, ready, desktop, ("dark",))
        weaker = "#decision.d_max_m=12&decision.speed_adaptive=false"
        studio.shoot("testbench-contest", url + weaker, contest, desktop, light)
        studio.shoot("testbench-draw", url + "#scenario=Cyclist%20Abort", draw, desktop, light)
    finally:
        process.terminate()
        process.wait()
    report = studio.work / "report.html"
    subprocess.run([*words, "export", str(report)], check=True, stdout=subprocess.DEVNULL)
    studio.shoot(
        "report",
        report.as_uri(),
        lambda page: page.wait_for_selector("#strips canvas"),
        schemes=("light",),
        whole=(),
    )
