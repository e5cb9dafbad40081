"""`/align`: the installer's page. It may move the camera's numbers, and nothing else.

The browser has no lens model: for every move of a slider it asks for the grid, which comes from the
geometry that the service decides by. Pictures come from `frame`, in the service the newest frame of
the camera, with `bikeped align` a picture or a recording's frame.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import simplejpeg
from aiohttp import hdrs, web
from msgspec import Meta

from bikeped.config import CameraConfig, LoadedConfig, framing, ground_camera, load_config
from bikeped.errors import GeometryError
from bikeped.geometry import GroundCamera
from bikeped.geometry.alignment import PARAMETER_NAMES
from bikeped.types import Frame
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
    values_of,
    with_values,
)
from bikeped.web.align_save import ChangedError, file_hash, lines, save, why_not
from bikeped.web.server import Page, add_page, json_answer, json_body

log = logging.getLogger(__name__)

#: The newest picture: a frame, or a JPEG file's bytes; None while there is none.
Newest = Callable[[], "Frame | bytes | None"]

_PAGE = Page("/align", "Align", "Align the camera", "align.html", ("align.js",), ("align.css",))
_QUALITY = 92
#: What a thumb sweeps: from, to, about the value where they are shares of the radius.
_SWEEP: dict[str, tuple[float, float]] = {
    "height_m": (1.0, 10.0),
    "pitch_deg": (-60.0, 20.0),
    "heading_deg": (-45.0, 45.0),
}


class GridRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What to draw: numbers of the camera, the picture's size, and marks to be read."""

    values: Values
    frame: FrameSize
    marks: Annotated[list[Point], Meta(max_length=40)] = []


class SaveRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera's keys to write, and the hash of the file that they were made for."""

    values: Annotated[dict[str, float], Meta(max_length=10)]
    sha256: str


class Aligner:
    """The page's answers. Everything that takes milliseconds runs in threads, one at a time: the
    loop that it shares with the service judges frames."""

    def __init__(self, loaded: LoadedConfig, frame: Newest, *, live: bool) -> None:
        self._loaded, self._frame, self._live = loaded, frame, live
        self._path = Path(loaded.source)
        self._busy = asyncio.Lock()
        self._writing = asyncio.Lock()

    async def state(self, _request: web.Request) -> web.Response:
        """Values in force and in the file, where they come from, whether they can be saved."""
        return json_answer(await asyncio.to_thread(self._state))

    async def frame(self, _request: web.Request) -> web.Response:
        """The newest picture as JPEG, whole: marks are set to the pixel."""
        newest = self._frame()
        if newest is None:
            return json_answer({"error": "no picture yet: the camera has not delivered one"}, 503)
        jpeg = newest if isinstance(newest, bytes) else await asyncio.to_thread(_jpeg, newest)
        return web.Response(
            body=jpeg, content_type="image/jpeg", headers={hdrs.CACHE_CONTROL: "no-store"}
        )

    async def grid(self, request: web.Request) -> web.Response:
        """The grid for some numbers, what the marks read, and what that does at 10 m."""
        asked = await json_body(request, GridRequest)
        async with self._busy:
            return json_answer(await asyncio.to_thread(self._grid, asked))

    async def fit(self, request: web.Request) -> web.Response:
        """The numbers that explain the marks best, or `refused`: why the marks do not tell."""
        asked = await json_body(request, Points)
        async with self._busy:
            return json_answer(await asyncio.to_thread(self._fit, asked))

    async def save(self, request: web.Request) -> web.Response:
        """Writes the camera's changed keys into config.yaml."""
        asked = await json_body(request, SaveRequest)
        async with self._writing:
            try:
                saved = await asyncio.to_thread(save, self._path, asked.values, asked.sha256)
            except ChangedError as error:
                return json_answer({"error": str(error)}, 409)
        log.warning(
            "align: %s written by %s: %s; before: %s",
            saved.config,
            request.remote,
            ", ".join(f"camera.{key} {value:g}" for key, value in saved.keys.items()),
            saved.backup.name,
        )
        return json_answer(
            {
                "config": str(saved.config),
                "backup": str(saved.backup),
                "keys": saved.keys,
                "sha256": saved.sha256,
                "restart": self._live,
                "promoted": saved.promoted,
            }
        )

    def _base(self) -> GroundCamera:
        """The camera as this process knows it; what a request's numbers are put into."""
        return ground_camera(self._loaded)

    def _state(self) -> dict[str, Any]:
        in_file = load_config(self._path)
        running = msgspec.structs.asdict(values_of(self._base()))
        filed = msgspec.structs.asdict(values_of(ground_camera(in_file)))
        return {
            "live": self._live,
            "source": str(self._path),
            "sha256": file_hash(self._path),
            "cannot_save": why_not(self._path),
            "calibration": in_file.config.camera.calibration,
            # The service reads its file at the start; a page that is opened after a save goes on
            # from what was saved.
            "start": filed if self._live else running,
            "running": running,
            "filed": filed,
            "fields": [_field(key, in_file, running[key], filed[key]) for key in PARAMETER_NAMES],
        }

    def _grid(self, asked: GridRequest) -> dict[str, Any]:
        frame = framing(self._loaded).for_frame(asked.frame.width, asked.frame.height)
        camera = with_values(self._base(), asked.values)
        return {
            "grid": ground_grid(camera, frame),
            "at_10m": at_ten_metres(camera, self._base(), frame),
            "marks": readings(camera, frame, asked.marks),
            "yaml": lines(msgspec.structs.asdict(asked.values)),
        }

    def _fit(self, asked: Points) -> dict[str, Any]:
        try:
            found, _ = fit_points(self._base(), framing(self._loaded), asked)
        except GeometryError as error:  # an answer, too: what to measure
            return {"refused": str(error)}
        return fit_json(found)


def add_align(
    app: web.Application, loaded: LoadedConfig, frame: Newest, *, live: bool = True
) -> None:
    """Adds the page and its routes. `live`: the service's own, which reads its file at its start;
    else a picture that was given, and the page goes on from the configuration with its overrides.
    """
    page = Aligner(loaded, frame, live=live)
    add_page(app, _PAGE)
    app.router.add_get("/align/state", page.state)
    app.router.add_get("/align/frame.jpg", page.frame)
    app.router.add_post("/align/grid", page.grid)
    app.router.add_post("/align/fit", page.fit)
    app.router.add_post("/align/save", page.save)


def _jpeg(frame: Frame) -> bytes:
    if frame.jpeg is not None:
        return bytes(frame.jpeg)
    return bytes(simplejpeg.encode_jpeg(frame.rgb, quality=_QUALITY, colorspace="RGB"))


def _field(key: str, in_file: LoadedConfig, running: float, filed: float) -> dict[str, Any]:
    """What the page needs to know of one number."""
    low, high = _RANGES[key]
    if key in _SWEEP:
        sweep = _SWEEP[key]
    else:
        sweep = (0.85 * running, 1.15 * running) if running > 1 else (low, high)
    return {
        "key": key,
        "step": STEPS[key] / 10,
        "coarse": STEPS[key],
        "min": low,
        "max": high,
        "from": min(sweep[0], running, filed),
        "to": max(sweep[1], running, filed),
        "origin": _origin(key, in_file),
    }


def _origin(key: str, in_file: LoadedConfig) -> str:
    """Where the number comes from, and what saving it means, for people."""
    camera, calibration = in_file.config.camera, camera_calibration(in_file)
    set_here = getattr(camera, key) is not None
    if key not in ("radius_px", "cx", "cy"):
        return f"camera.{key}"
    what = "the focal length" if key == "radius_px" else "the optical centre"
    if set_here and calibration:
        return f"camera.{key}, which goes before {what} in {calibration}"
    if set_here:
        return f"camera.{key}"
    if calibration:
        return f"{calibration}; saving writes camera.{key}, which then goes before it"
    return f"the middle of the crop; saving writes camera.{key}"


def camera_calibration(in_file: LoadedConfig) -> str | None:
    """Name of the calibration file, where there is one."""
    path = in_file.config.camera.calibration
    return None if path is None else Path(path).name


def _range(key: str) -> tuple[float, float]:
    """The smallest and largest value that the configuration takes."""
    _, parts = msgspec.json.schema_components([CameraConfig], ref_template="{name}")
    item = parts["CameraConfig"]["properties"][key]
    choice = next((c for c in item.get("anyOf", ()) if "maximum" in c), item)
    low = choice.get("minimum", choice.get("exclusiveMinimum"))
    return float(low), float(choice["maximum"])


_RANGES = {key: _range(key) for key in PARAMETER_NAMES}
