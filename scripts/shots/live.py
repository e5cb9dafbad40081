"""The live page: the demo's drawn crossing through the real loop, at its ALERT, and no contact."""

from __future__ import annotations

import re
import subprocess
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from screenshots import Studio

PATIENCE_MS = 120_000


def take(studio: Studio) -> None:
    """Four pages look at one replay; each is kept at the alert."""
    options = ["--out", str(studio.work), "--seconds", "12", "--web", "0"]
    process = subprocess.Popen(
        [sys.executable, "-m", "bikeped.cli.main", "--log-level", "info", "demo", *options],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    assert process.stderr is not None
    url = next(found[0] for line in process.stderr if (found := re.search(r"http://\S+", line)))
    with ExitStack() as stack:
        pages = {
            f"{size}-{scheme}": stack.enter_context(studio.page(url, size, scheme))
            for size in ("desktop", "phone")
            for scheme in ("light", "dark")
        }
        for name, page in pages.items():
            page.wait_for_selector("#state[data-state=ALERT]", timeout=PATIENCE_MS)
            studio.keep(page, f"live-{name}", whole=name.startswith("phone"))
        process.kill()
        process.wait()
        page = pages["phone-light"]
        page.wait_for_selector("#live[data-contact=lost]", timeout=PATIENCE_MS)
        studio.keep(page, "live-lost-phone-light")
