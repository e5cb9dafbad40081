"""A rendered scenario as a frame source: JPEG, like the camera on the pole."""

from __future__ import annotations

from collections.abc import Sequence

import simplejpeg

from bikeped.capture.base import FrameSource
from bikeped.lab.rendering import DrawnObject, ScenePainter
from bikeped.types import Frame

#: Roughly that of the pole's camera: its compression affects small figures.
JPEG_QUALITY = 90


class DrawnSource(FrameSource):
    """Renders a frame at each read; `objects` holds the drawn objects of each, in order."""

    def __init__(self, painter: ScenePainter, name: str, time_s: Sequence[float], fps: float):
        self._painter = painter
        self._time_s = tuple(time_s)
        self.name = name
        self.width, self.height = painter.camera.size
        self.fps = fps
        self.live = False
        self.objects: list[tuple[DrawnObject, ...]] = []

    def read(self) -> Frame | None:
        number = len(self.objects)
        if number >= len(self._time_s):
            return None
        t = self._time_s[number]
        rgb, objects = self._painter.draw(t)
        self.objects.append(tuple(objects))
        jpeg: bytes = simplejpeg.encode_jpeg(
            rgb, quality=JPEG_QUALITY, colorspace="RGB", colorsubsampling="420"
        )
        return Frame(number, t, self.width, self.height, jpeg=jpeg)

    def close(self) -> None:
        """Nothing to release."""
