"""The live page: a drawn crossing through the real loop, at its ALERT, and then without contact.

The boxes are those of what was drawn, and the page says so: these are pictures of the page, not of
a detector.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bikeped.config.load import LoadedConfig, load_config
from bikeped.detection.detector import DetectionResult
from bikeped.lab.rendering import Conditions, ScenePainter, scene_camera
from bikeped.lab.rendering.clip import read_sidecar, sidecar_path, write_clip
from bikeped.lab.scenarios.scenario import parse_scenario
from bikeped.pipeline.replay import replay
from bikeped.types import Detections
from bikeped.web.service_pages import ServicePages

if TYPE_CHECKING:
    from screenshots import Studio

LATE = 45  #: from this frame on there is time for a picture
CROSSING = """
name: Somebody crosses, a cyclist comes, another leaves
hazard: standard
expected: alert
vehicle: bicycle
agents:
  - {id: 1, kind: pedestrian, path: [[0.0, 6.6, -6.2], [5.0, 5.6, -2.2]]}
  - {id: 2, kind: cyclist, path: [[0.0, -13.0, -3.6], [5.0, 4.2, -3.4]]}
  - {id: 3, kind: cyclist, path: [[0.0, 9.0, 3.0], [5.0, 23.0, 3.2]]}
  - {id: 4, kind: car, path: [[0.0, 24.0, 1.2], [5.0, -8.0, 1.2]]}
"""


class _ClipDetector:
    """Reads the boxes of what was drawn; late in the clip it waits until the picture is taken."""

    name = "none: the boxes of what was drawn"
    model_hash: str | None = None
    cyclist_box_includes_rider = True

    def __init__(self, clip: Path) -> None:
        self._frames = read_sidecar(sidecar_path(clip)).frames
        self.done = threading.Event()

    def decode_size(self, width: int, height: int) -> tuple[int, int]:
        return min(width, 640), min(height, 640)

    def detect(self, picture: Any) -> DetectionResult:
        number = picture.frame.number
        self.done.wait(1.2 if number > LATE else 0.05)
        shown = [item for item in self._frames[number] if item.visible > 0.3]
        found = Detections(
            np.asarray([int(item.label) for item in shown], np.int8),
            np.full(len(shown), 0.9, np.float32),
            np.asarray([item.box_px for item in shown], np.float32).reshape(-1, 4),
        )
        return DetectionResult(found, 0.0, 0.0, 0.0)


class _Showing:
    """One replay with its pages, in a thread."""

    def __init__(self, loaded: LoadedConfig, clip: Path) -> None:
        self.detector = _ClipDetector(clip)
        self.url = ""
        self._known = threading.Event()
        pages = ServicePages(loaded)
        self._thread = threading.Thread(
            target=lambda: replay(
                loaded,
                str(clip),
                detector=self.detector,
                mqtt=False,
                pages=pages,
                serving=self._heard,
            ),
            daemon=True,
        )
        self._thread.start()
        assert self._known.wait(120)

    def _heard(self, address: str) -> None:
        self.url = address
        self._known.set()

    def end(self) -> None:
        self.detector.done.set()
        self._thread.join()


def take(studio: Studio) -> None:
    """One replay for each look, kept at the alert."""
    loaded = load_config(None, ["web.enabled=true", "web.port=0"])
    clip = studio.work / "crossing.avi"
    scenario = parse_scenario(CROSSING, "crossing.yaml")
    painter = ScenePainter(scenario, scene_camera(loaded, (1920, 1080)), Conditions())
    write_clip(painter, clip, fps=15)
    for size in ("desktop", "phone"):
        for scheme in ("light", "dark"):
            with studio.page("about:blank", size, scheme) as page:
                showing = _Showing(loaded, clip)
                page.goto(showing.url)
                page.wait_for_selector("#state[data-state=ALERT]")
                page.wait_for_function("() => document.querySelector('#picture').naturalWidth > 0")
                page.wait_for_selector("#health dd.ok-mark")
                page.wait_for_timeout(9000)  # for curves of some length
                studio.keep(page, f"live-{size}-{scheme}", whole=size == "phone")
                showing.end()
                if (size, scheme) == ("phone", "light"):
                    page.wait_for_selector("#live[data-contact=lost]")
                    studio.keep(page, "live-lost-phone-light")
