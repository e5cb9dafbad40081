"""A live capture: reads a source, guides, saves the boards that are kept, and shows how it stands.

The work takes place in the caller's thread; `LiveSession` is what others (the page) may look at
meanwhile. Not run on a camera at a pole yet: tested with recorded and drawn frames.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bikeped.capture import FrameSource
from bikeped.errors import CalibrationError, CaptureError
from bikeped.files import make_folder, write_whole
from bikeped.geometry import Lens
from bikeped.lab.calibration.capture.guide import Answer, Guide, Verdict
from bikeped.lab.calibration.capture.pictures import frame_grey
from bikeped.types import Frame, ImageArray

_SHOWN_WIDTH = 960
_SILENT_S = 10.0  # without a frame from a live source: it is broken
_COVERED, _OPEN, _CORNER = (80, 160, 40), (40, 120, 230), (60, 60, 255)  # BGR


class LiveSession:
    """What a capture shows: `status()` as JSON-ready data, `picture()` as JPEG. Any thread."""

    def __init__(self, guide: Guide) -> None:
        self._guide = guide
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._jpeg = b""
        self._number = 0
        self._status: dict[str, Any] = {}
        self._stop = threading.Event()
        self._tell("waiting for the camera")

    @property
    def stopped(self) -> bool:
        return self._stop.is_set()

    def stop(self) -> None:
        """Ends the capture after the frame in hand; what was kept stays."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()

    def status(self) -> dict[str, Any]:
        """`says`, `next`, `kept`, `coverage` (share), `enough`, `parts` of the circle."""
        with self._lock:
            return dict(self._status)

    def picture(self, after: int = 0, timeout_s: float = 0.0) -> tuple[int, bytes]:
        """Number and JPEG of the newest shown frame; waits for one after `after`."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > after or self.stopped, timeout_s)
            return self._number, self._jpeg

    def show(self, grey: ImageArray, verdict: Verdict) -> None:
        """The capture tells what it saw."""
        jpeg = drawn(grey, verdict, self._guide)
        self._tell(verdict.words)
        with self._changed:
            self._jpeg, self._number = jpeg, self._number + 1
            self._changed.notify_all()

    def _tell(self, says: str) -> None:
        guide = self._guide
        status = {
            "says": says,
            "next": guide.advice,
            "kept": len(guide.kept),
            "coverage": round(guide.coverage.share, 3),
            "enough": guide.enough,
            "parts": [
                {"where": part.where, "corners": part.corners, "covered": part.covered}
                for part in guide.coverage.parts
            ],
        }
        with self._lock:
            self._status = status


def capture_boards(
    source: FrameSource,
    guide: Guide,
    folder: Path,
    session: LiveSession,
    *,
    say: Callable[[str], None] = lambda _line: None,
) -> list[Path]:
    """Runs until there is enough, the source ends or `session.stop()`; the pictures it saved.

    `say` gets a line whenever there is something new to tell. Pictures go into `folder` as the
    camera encoded them (else as PNG), beside any that are there. Frames must have the guide's size.
    CaptureError when a live source falls silent, CalibrationError for another size.
    """
    make_folder(folder)
    saved: list[Path] = []
    told = ""
    for frame in _frames(source, session):
        grey = frame_grey(frame, source.name)
        if grey.shape != (guide.height, guide.width):
            raise CalibrationError(
                f"{source.name}: gives {grey.shape[1]}x{grey.shape[0]} pixels instead of "
                f"{guide.width}x{guide.height}; set camera.width and camera.height"
            )
        verdict = guide.look(grey, frame.captured_s)
        session.show(grey, verdict)
        if verdict.answer is Answer.KEPT:
            saved.append(_save(frame, folder))
            say(f"{verdict.words}: {saved[-1].name}. {guide.advice}")
        elif verdict.words != told:
            say(verdict.words)
        told = verdict.words
        if guide.enough:
            break
    session.stop()
    return saved


def assumed_lens(width: int, height: int) -> tuple[Lens, tuple[float, float]]:
    """A lens and centre that are right to some 15 per cent for any fisheye: a field of 190 degrees
    across the longer side, equidistant."""
    half = math.radians(95.0)
    lens = Lens("equidistant", max(width, height) / 2 / half, half)
    return lens, ((width - 1) / 2, (height - 1) / 2)


def drawn(grey: ImageArray, verdict: Verdict, guide: Guide) -> bytes:
    """JPEG of a frame with the parts of the circle (covered green, open orange) and the corners."""
    scale = min(1.0, _SHOWN_WIDTH / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    picture = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    tint = picture.copy()
    for part in guide.coverage.parts:
        phi = np.linspace(part.start_rad, part.stop_rad, 24)
        ring = [guide.lens.radius(angle) for angle in (part.from_rad, part.to_rad)]
        outer = np.stack([ring[1] * np.cos(phi), ring[1] * np.sin(phi)], axis=1)
        inner = np.stack([ring[0] * np.cos(phi), ring[0] * np.sin(phi)], axis=1)[::-1]
        edge = (np.concatenate([outer, inner]) + guide.centre_px) * scale
        shape = np.rint(edge).astype(np.int32)
        colour = _COVERED if part.covered else _OPEN
        cv2.fillPoly(tint, [shape], colour)
        cv2.polylines(picture, [shape], True, colour, 1, cv2.LINE_AA)
    picture = cv2.addWeighted(tint, 0.22, picture, 0.78, 0)
    for u, v in verdict.uv_px * scale:
        cv2.circle(picture, (round(float(u)), round(float(v))), 3, _CORNER, 1, cv2.LINE_AA)
    done, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return bytes(jpeg) if done else b""


def _save(frame: Frame, folder: Path) -> Path:
    suffix = "jpg" if frame.jpeg is not None else "png"
    number = 1
    while any(folder.glob(f"board-{number:03d}.*")):
        number += 1
    path = folder / f"board-{number:03d}.{suffix}"
    if frame.jpeg is not None:
        write_whole(path, bytes(frame.jpeg))
    else:
        rgb = np.asarray(frame.rgb, np.uint8)
        _, png = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        write_whole(path, bytes(png))
    return path


def _frames(source: FrameSource, session: LiveSession) -> Iterator[Frame]:
    """Every frame of a recording; of a live source the newest, read in a thread of its own."""
    if not source.live:
        while not session.stopped and (frame := source.read()) is not None:
            yield frame
        return
    newest = _Newest(source, session)
    while not session.stopped:
        live = newest.take()
        if live is None:
            return
        yield live


class _Newest:
    """The newest frame of a live source: looking at one takes longer than the next one needs."""

    def __init__(self, source: FrameSource, session: LiveSession) -> None:
        self._source, self._session = source, session
        self._fresh = threading.Condition()
        self._frame: Frame | None = None
        self._ended = False
        self._error: CaptureError | None = None
        # A read that hangs in a driver cannot be ended: a daemon does not keep the process.
        threading.Thread(target=self._read, name="calibration-camera", daemon=True).start()

    def take(self) -> Frame | None:
        until_s = time.monotonic() + _SILENT_S
        with self._fresh:
            while self._frame is None and not self._ended:
                if not self._fresh.wait(until_s - time.monotonic()):
                    raise CaptureError(
                        f"{self._source.name}: gave no picture for {_SILENT_S:.0f} s; is the "
                        "camera plugged in, and used by nobody else?"
                    )
            if self._error is not None:
                raise self._error
            frame, self._frame = self._frame, None
            return frame

    def _read(self) -> None:
        frame: Frame | None = None
        error: CaptureError | None = None
        while not self._session.stopped:
            try:
                frame = self._source.read()
            except CaptureError as broken:
                frame, error = None, broken
            with self._fresh:
                self._frame, self._ended, self._error = frame, frame is None, error
                self._fresh.notify_all()
            if frame is None:
                return
