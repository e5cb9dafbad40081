"""A live capture: reads a source, guides the person with the board, saves the boards to keep.

The work takes place in the caller's thread; `LiveSession` is what other threads read, and
`live_page` shows it in a browser. Not run on a camera at a pole yet: tested with recorded and drawn
frames.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import queue
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from aiohttp import hdrs, web

from bikeped.capture.base import FrameSource
from bikeped.config.output_sections import WebConfig
from bikeped.errors import CalibrationError, CaptureError
from bikeped.files import make_folder, write_whole
from bikeped.lab.calibration.capture.guide import CaptureGuide, FrameStatus, FrameVerdict
from bikeped.lab.calibration.capture.images import frame_grey
from bikeped.telemetry.http_server import HttpServer
from bikeped.types import Frame, ImageArray
from bikeped.web.security import load_access_policy
from bikeped.web.server import Page, add_page, json_answer, make_application

_SHOWN_WIDTH = 960
_SILENT_S = 10.0  # without a frame from a live source: it is broken
_COVERED, _OPEN, _CORNER = (80, 160, 40), (40, 120, 230), (60, 60, 255)  # BGR


class LiveSession:
    """What a capture shows: `status()` as JSON-ready data, `picture()` as JPEG. Any thread."""

    def __init__(self, guide: CaptureGuide) -> None:
        self._guide = guide
        self._changed = threading.Condition()
        self._jpeg = b""
        self._number = 0
        self._status = self._status_with("waiting for the camera")
        self._stop = threading.Event()

    @property
    def stopped(self) -> bool:
        return self._stop.is_set()

    def stop(self) -> None:
        """Ends the capture after the current frame; the kept images stay."""
        self._stop.set()
        with self._changed:
            self._changed.notify_all()

    def status(self) -> dict[str, Any]:
        """`says`, `next`, `kept`, `coverage` (share), `enough`, `parts` of the circle."""
        with self._changed:
            return dict(self._status)

    def picture(self, after: int = 0, timeout_s: float = 0.0) -> tuple[int, bytes]:
        """Number and JPEG of the newest shown frame; waits for one after `after`."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > after or self.stopped, timeout_s)
            return self._number, self._jpeg

    def publish(self, grey: ImageArray, verdict: FrameVerdict) -> None:
        """Shows a frame and its verdict; called by the capture."""
        jpeg, status = draw_frame(grey, verdict, self._guide), self._status_with(verdict.text)
        with self._changed:
            self._jpeg, self._number, self._status = jpeg, self._number + 1, status
            self._changed.notify_all()

    def _status_with(self, text: str) -> dict[str, Any]:
        guide = self._guide
        return {
            "says": text,
            "next": guide.advice,
            "kept": len(guide.kept),
            "coverage": round(guide.coverage.share, 3),
            "enough": guide.enough,
            "parts": [
                {"where": sector.where, "corners": sector.corners, "covered": sector.covered}
                for sector in guide.coverage.sectors
            ],
        }


def capture_boards(
    source: FrameSource,
    guide: CaptureGuide,
    folder: Path,
    session: LiveSession,
    *,
    say: Callable[[str], None] = lambda _line: None,
) -> list[Path]:
    """Runs until there is enough, the source ends or `session.stop()`; returns the saved images.

    `say` gets a line whenever the verdict changes. Images go into `folder` as the camera encoded
    them (else as PNG), beside any that are there. Frames must have the guide's size. CaptureError
    when a live source gives no more frames, CalibrationError for another size.
    """
    make_folder(folder)
    saved: list[Path] = []
    last_text = ""
    for frame in _frames(source, session):
        grey = frame_grey(frame, source.name)
        if grey.shape != (guide.height, guide.width):
            raise CalibrationError(
                f"{source.name}: gives {grey.shape[1]}x{grey.shape[0]} pixels instead of "
                f"{guide.width}x{guide.height}; set camera.width and camera.height"
            )
        verdict = guide.check_frame(grey, frame.captured_s)
        session.publish(grey, verdict)
        if verdict.status is FrameStatus.KEPT:
            saved.append(_save(frame, folder))
            say(f"{verdict.text}: {saved[-1].name}. {guide.advice}")
        elif verdict.text != last_text:
            say(verdict.text)
        last_text = verdict.text
        if guide.enough:
            break
    session.stop()
    return saved


def draw_frame(grey: ImageArray, verdict: FrameVerdict, guide: CaptureGuide) -> bytes:
    """JPEG of a frame with the circle's sectors (covered green, open orange) and the corners."""
    scale = min(1.0, _SHOWN_WIDTH / grey.shape[1])
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    image = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    tint = image.copy()
    for sector in guide.coverage.sectors:
        phi = np.linspace(sector.start_rad, sector.stop_rad, 24)
        rim = np.stack([np.cos(phi), np.sin(phi)], axis=1)
        inner, outer = (
            guide.lens.radius(angle) * rim for angle in (sector.from_rad, sector.to_rad)
        )
        edge = (np.concatenate([outer, inner[::-1]]) + guide.centre_px) * scale
        shape = np.rint(edge).astype(np.int32)
        colour = _COVERED if sector.covered else _OPEN
        cv2.fillPoly(tint, [shape], colour)
        cv2.polylines(image, [shape], True, colour, 1, cv2.LINE_AA)
    image = cv2.addWeighted(tint, 0.22, image, 0.78, 0)
    for u, v in verdict.uv_px * scale:
        cv2.circle(image, (round(float(u)), round(float(v))), 3, _CORNER, 1, cv2.LINE_AA)
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1])


def _save(frame: Frame, folder: Path) -> Path:
    names = (f"board-{number:03d}" for number in itertools.count(1))
    name = next(name for name in names if not any(folder.glob(f"{name}.*")))
    path = folder / f"{name}.{'png' if frame.jpeg is None else 'jpg'}"
    if frame.jpeg is not None:
        write_whole(path, bytes(frame.jpeg))
    else:
        rgb = np.asarray(frame.rgb, np.uint8)
        write_whole(path, bytes(cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1]))
    return path


def _frames(source: FrameSource, session: LiveSession) -> Iterator[Frame]:
    """Every frame of a recording; of a live source the newest, read in a thread of its own."""
    if not source.live:
        while not session.stopped and (frame := source.read()) is not None:
            yield frame
        return
    newest: queue.Queue[Frame | CaptureError | None] = queue.Queue(1)

    def read() -> None:
        item: Frame | CaptureError | None = None
        while not session.stopped:
            try:
                item = source.read()
            except CaptureError as error:
                item = error
            with contextlib.suppress(queue.Empty):
                newest.get_nowait()  # a newer frame replaces one that was not taken
            newest.put(item)
            if not isinstance(item, Frame):
                return

    # A read that hangs in a driver cannot be ended: a daemon thread does not keep the process.
    threading.Thread(target=read, name="calibration-camera", daemon=True).start()
    while not session.stopped:
        try:
            item = newest.get(timeout=_SILENT_S)
        except queue.Empty as error:
            raise CaptureError(
                f"{source.name}: gave no picture for {_SILENT_S:.0f} s; is the camera plugged in, "
                "and used by nobody else?"
            ) from error
        if isinstance(item, CaptureError):
            raise item
        if item is None:
            return
        yield item


_BOUNDARY = "bikeped-board"
_HEAD = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\n\r\n".encode()
_WAIT_S = 1.0
_PAGE = Page(
    "/calibrate",
    "Calibration",
    "Calibration",
    "calibrate.html",
    scripts=("calibrate.js",),
    styles=("calibrate.css",),
    folder=Path(__file__).parent,
)


def add_live_page(app: web.Application, session: LiveSession) -> None:
    """Adds `/calibrate` (page), `/calibrate/status` (JSON), `/calibrate/stream` (Motion JPEG)."""

    async def status(_request: web.Request) -> web.Response:
        return json_answer(session.status())

    async def stream(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(
            headers={hdrs.CONTENT_TYPE: f"multipart/x-mixed-replace; boundary={_BOUNDARY}"}
        )
        await response.prepare(request)
        number = 0
        with contextlib.suppress(ConnectionError):
            while not session.stopped:
                newest, jpeg = await asyncio.to_thread(session.picture, number, _WAIT_S)
                if newest != number:
                    number = newest
                    await response.write(_HEAD + jpeg + b"\r\n")
        return response

    add_page(app, _PAGE)
    app.router.add_get("/calibrate/status", status)
    app.router.add_get("/calibrate/stream", stream)


@contextlib.contextmanager
def live_page(session: LiveSession, *, port: int) -> Iterator[tuple[str | None, str | None]]:
    """Serves the page to this machine from a thread of its own; gives its address and the error.

    The address is None when the port cannot be bound: the console guides as well.
    """
    config = WebConfig(host="127.0.0.1", port=port)
    add = functools.partial(add_live_page, session=session)
    server = HttpServer(make_application(load_access_policy(config), add), config)
    ready, ended = threading.Event(), threading.Event()

    async def serve() -> None:
        try:
            await server.start()
        finally:
            ready.set()
        await asyncio.to_thread(ended.wait)
        await server.stop()

    thread = threading.Thread(target=lambda: asyncio.run(serve()), daemon=True)
    thread.start()
    ready.wait()
    try:
        yield f"{server.address}calibrate" if server.address else None, server.error
    finally:
        session.stop()
        ended.set()
        thread.join()
