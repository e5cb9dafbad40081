"""Pictures of the pages, each in a real headless Chromium, into docs/screenshots/.

`scripts/screenshots` takes all, `scripts/screenshots live` some; `--out DIR` puts them elsewhere.
Each module of `scripts/shots/` has a `take(studio)` that serves its page and calls `studio.shoot`.
"""

from __future__ import annotations

import argparse
import importlib
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(Path(__file__).parent))

Scheme = Literal["light", "dark"]

SIZES = {"desktop": (1440, 900, 1.0), "phone": (390, 844, 2.0)}
SCHEMES: tuple[Scheme, ...] = ("light", "dark")
QUALITY = 80
PATIENCE_MS = 300_000  #: on a busy machine everything comes late
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"]


class Studio:
    """Opens pages in every look and keeps their pictures as WebP."""

    def __init__(self, browser: Browser, out: Path, work: Path) -> None:
        self._browser, self._out = browser, out
        self.work = work  #: a folder for clips and the like

    @contextmanager
    def page(self, url: str, size: str, scheme: Scheme) -> Iterator[Page]:
        """`url` in a fresh context of the given look."""
        width, height, scale = SIZES[size]
        context = self._browser.new_context(
            viewport={"width": width, "height": height},
            device_scale_factor=scale,
            color_scheme=scheme,
            has_touch=size == "phone",
            reduced_motion="reduce",
        )
        context.set_default_timeout(PATIENCE_MS)
        page = context.new_page()
        page.goto(url)
        try:
            yield page
        finally:
            context.close()

    def shoot(
        self,
        name: str,
        url: str,
        ready: Callable[[Page], None],
        sizes: tuple[str, ...] = tuple(SIZES),
        schemes: tuple[Scheme, ...] = SCHEMES,
        whole: tuple[str, ...] = ("phone",),
    ) -> None:
        """Pictures of `url` in each look, taken when `ready(page)` returns; of the whole page, not
        only of its first screen, in the sizes of `whole`."""
        for size in sizes:
            for scheme in schemes:
                with self.page(url, size, scheme) as page:
                    ready(page)
                    self.keep(page, f"{name}-{size}-{scheme}", whole=size in whole)

    def keep(self, page: Page, name: str, whole: bool = False) -> None:
        """What `page` shows now, as `name`.webp."""
        # Not scaled back to CSS pixels, and without waiting for a stream that never ends.
        png = page.screenshot(full_page=whole, scale="device", animations="disabled")
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        path = self._out / f"{name}.webp"
        cv2.imwrite(str(path), image, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
        print(f"{path}  {image.shape[1]} x {image.shape[0]}  {path.stat().st_size / 1e3:.0f} kB")


def main() -> int:
    known = sorted(path.stem for path in (ROOT / "scripts" / "shots").glob("[a-z]*.py"))
    parser = argparse.ArgumentParser(description="Pictures of the pages.")
    parser.add_argument("pages", nargs="*", help=f"some of: {', '.join(known)}")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "screenshots")
    given = parser.parse_args()
    unknown = set(given.pages) - set(known)
    if unknown:
        parser.error(f"{', '.join(sorted(unknown))}: no such page; known: {', '.join(known)}")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        print("no Chromium is installed: apt-get install chromium", file=sys.stderr)
        return 2
    given.out.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as work:
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        studio = Studio(browser, given.out, Path(work))
        for name in given.pages or known:
            importlib.import_module(f"shots.{name}").take(studio)
        browser.close()
    total = sum(path.stat().st_size for path in given.out.glob("*.webp"))
    print(f"{total / 1e6:.2f} MB in all")
    return 0


if __name__ == "__main__":
    sys.exit(main())
