"""`/align`: the installer's page. It changes the camera's mount and lens values only.

The browser has no lens model: at every change it requests the ground grid, which is computed by
the geometry that the service uses. Pictures come from `frame`: the camera's newest frame in the
service, a picture or a recording's frame with `bikeped align`.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import msgspec
import simplejpeg
from aiohttp import hdrs, web
from msgspec import Meta

from bikeped.capture.jpeg import JpegDecoder
from bikeped.config.build import framing, ground_camera
from bikeped.config.load import LoadedConfig, load_config
from bikeped.config.schema import CameraConfig
from bikeped.errors import GeometryError
from bikeped.geometry.alignment import PARAMETER_NAMES, Alignment
from bikeped.types import Frame, ImageArray
from bikeped.web.align_grid import ground_grid
from bikeped.web.align_points import (
    STEPS,
    FrameSize,
    Point,
    Points,
    Values,
    at_ten_metres,
    fit_json,
    fit_points,
    readings,
    with_values,
)
from bikeped.web.align_save import ChangedError, Saved, file_hash, lines, save, why_not
from bikeped.web.server import Page, add_page, json_answer, json_body

log = logging.getLogger(__name__)

#: Returns the newest picture: a frame, or a JPEG file's bytes; None while there is none.
FrameSource = Callable[[], "Frame | bytes | None"]

_PAGE = Page("/align", "Align", "Align the camera", "align.html", ("align.js",), ("align.css",))
_QUALITY = 92
#: A slider's lowest and highest value; those that are missing depend on the radius.
_SLIDER = {"height_m": (1.0, 10.0), "pitch_deg": (-60.0, 20.0), "heading_deg": (-45.0, 45.0)}


class GridRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What to draw: the camera's values, the picture's size, and marks to evaluate."""

    values: Values
    frame: FrameSize
    marks: Annotated[list[Point], Meta(max_length=40)] = []


class SaveRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera's keys to write, and the hash of the file that they were edited for."""

    values: Annotated[dict[str, float], Meta(max_length=10)]
    sha256: str


class AlignHandlers:
    """The page's HTTP handlers. They compute in threads, one at a time, because they share the
    event loop with the pipeline."""

    def __init__(self, loaded: LoadedConfig, frame: FrameSource, *, live: bool) -> None:
        self._loaded, self._frame, self._live = loaded, frame, live
        self._path = Path(loaded.source)
        self._camera = ground_camera(loaded)  # of this process
        self._computing, self._writing = asyncio.Lock(), asyncio.Lock()

    async def state(self, _request: web.Request) -> web.Response:
        """Values of this process and of the file, their origin, and whether they can be saved."""
        return json_answer(await asyncio.to_thread(self._state))

    async def frame(self, _request: web.Request) -> web.Response:
        """The newest picture as JPEG, in full size: marks are set to the pixel."""
        newest = self._frame()
        if newest is None:
            return json_answer({"error": "no picture yet: the camera has not delivered one"}, 503)
        jpeg = newest if isinstance(newest, bytes) else await asyncio.to_thread(_jpeg, newest)
        return web.Response(
            body=jpeg, content_type="image/jpeg", headers={hdrs.CACHE_CONTROL: "no-store"}
        )

    async def grid(self, request: web.Request) -> web.Response:
        """The grid for the values, what the marks read, and the effect at 10 m."""
        body = await json_body(request, GridRequest)
        async with self._computing:
            return json_answer(await asyncio.to_thread(self._grid, body))

    async def fit(self, request: web.Request) -> web.Response:
        """The values that fit the marks best, or `refused`: why they cannot be fitted."""
        body = await json_body(request, Points)
        async with self._computing:
            return json_answer(await asyncio.to_thread(self._fit, body))

    async def save(self, request: web.Request) -> web.Response:
        """Writes the camera's changed keys into config.yaml."""
        body = await json_body(request, SaveRequest)
        async with self._writing:
            try:
                saved = await asyncio.to_thread(self._save, body)
            except ChangedError as error:
                return json_answer({"error": str(error)}, 409)
        log.warning(
            "align: %s written by %s: %s; before: %s",
            saved.config,
            request.remote,
            ", ".join(f"camera.{key} {value:g}" for key, value in saved.keys.items()),
            saved.backup.name,
        )
        files = {"config": str(saved.config), "backup": str(saved.backup)}
        files["reference"] = "" if saved.reference is None else str(saved.reference)
        return json_answer({**asdict(saved), **files, "restart": self._live})

    def _save(self, body: SaveRequest) -> Saved:
        newest = self._frame()
        picture = None if newest is None else frame_rgb(newest)
        return save(self._path, body.values, body.sha256, picture=picture)

    def _state(self) -> dict[str, Any]:
        in_file = load_config(self._path)
        running = asdict(Alignment.of(self._camera))
        filed = asdict(Alignment.of(ground_camera(in_file)))
        return {
            "live": self._live,
            "source": str(self._path),
            "sha256": file_hash(self._path),
            "cannot_save": why_not(self._path),
            "calibration": in_file.config.camera.calibration,
            # The service reads its file at the start only: after a save the file is newer.
            "start": filed if self._live else running,
            "running": running,
            "filed": filed,
            "fields": [_field(key, in_file, running[key], filed[key]) for key in PARAMETER_NAMES],
        }

    def _grid(self, body: GridRequest) -> dict[str, Any]:
        frame = framing(self._loaded).for_frame(body.frame.width, body.frame.height)
        camera = with_values(self._camera, body.values)
        return {
            "grid": ground_grid(camera, frame),
            "at_10m": at_ten_metres(camera, self._camera, frame),
            "marks": readings(camera, frame, body.marks),
            "yaml": lines(msgspec.structs.asdict(body.values)),
        }

    def _fit(self, body: Points) -> dict[str, Any]:
        try:
            return fit_json(fit_points(self._camera, framing(self._loaded), body)[0])
        except GeometryError as error:  # shown in the page: what to measure
            return {"refused": str(error)}


def add_align(
    app: web.Application, loaded: LoadedConfig, frame: FrameSource, *, live: bool = True
) -> None:
    """Adds the page and its routes. `live`: the page of a running service, which reads its file at
    its start only; else the page of a given picture, which starts with the overrides applied.
    """
    page = AlignHandlers(loaded, frame, live=live)
    add_page(app, _PAGE)
    app.router.add_get("/align/state", page.state)
    app.router.add_get("/align/frame.jpg", page.frame)
    app.router.add_post("/align/grid", page.grid)
    app.router.add_post("/align/fit", page.fit)
    app.router.add_post("/align/save", page.save)


def frame_rgb(frame: Frame | bytes) -> ImageArray:
    """The picture [h, w, 3] of a frame, or of a JPEG file's bytes. Raises CaptureError."""
    if isinstance(frame, Frame) and frame.rgb is not None:
        return frame.rgb
    return JpegDecoder().decode((frame.jpeg or b"") if isinstance(frame, Frame) else frame)


def _jpeg(frame: Frame) -> bytes:
    if frame.jpeg is not None:
        return bytes(frame.jpeg)
    return bytes(simplejpeg.encode_jpeg(frame.rgb, quality=_QUALITY, colorspace="RGB"))


def _field(key: str, in_file: LoadedConfig, running: float, filed: float) -> dict[str, Any]:
    """One value for the page: its steps, its range, the slider's range, where it comes from."""
    low, high = _RANGES[key]
    around = (0.85 * running, 1.15 * running) if running > 1 else (low, high)
    start, end = _SLIDER.get(key, around)
    return {
        "key": key,
        "step": STEPS[key] / 10,
        "coarse": STEPS[key],
        "min": low,
        "max": high,
        "from": min(start, running, filed),
        "to": max(end, running, filed),
        "origin": _origin(key, in_file),
    }


def _origin(key: str, in_file: LoadedConfig) -> str:
    """Where the value comes from, and what saving it means, in words."""
    camera = in_file.config.camera
    calibration = None if camera.calibration is None else Path(camera.calibration).name
    configured = getattr(camera, key) is not None
    if key in _SLIDER or (configured and calibration is None):
        return f"camera.{key}"
    if configured:
        what = "the focal length" if key == "radius_px" else "the optical centre"
        return f"camera.{key}, which overrides {what} in {calibration}"
    if calibration is not None:
        return f"{calibration}; saving writes camera.{key}, which then overrides it"
    return f"the middle of the crop; saving writes camera.{key}"


def _range(key: str) -> tuple[float, float]:
    """The smallest and largest value that the configuration takes."""
    _, parts = msgspec.json.schema_components([CameraConfig], ref_template="{name}")
    item = parts["CameraConfig"]["properties"][key]
    choice = next((c for c in item.get("anyOf", ()) if "maximum" in c), item)
    low = choice.get("minimum", choice.get("exclusiveMinimum"))
    return float(low), float(choice["maximum"])


_RANGES = {key: _range(key) for key in PARAMETER_NAMES}
