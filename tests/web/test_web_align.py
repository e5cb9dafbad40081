"""The align page's answers, without a browser."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from aiohttp.test_utils import TestClient, TestServer
from web_fakes import LOCKED, OPEN, Scene, web_context

from bikeped.config.build import framing, ground_camera
from bikeped.config.load import load_config
from bikeped.geometry.alignment import Alignment
from bikeped.types import Frame
from bikeped.web.align import add_align
from bikeped.web.align_grid import ground_grid
from bikeped.web.server import make_application
from bikeped.web.service_pages import ServicePages

ROOT = Path(__file__).parents[2]
#: The camera that the fakes' frames are of.
SMALL = (
    "camera.width=960",
    "camera.height=640",
    "camera.projection=perspective",
    "camera.calibration=null",
    "camera.pad_size=null",
    "camera.crop_size=null",
    "camera.radius_px=580",
    "camera.fov_deg=73",
)
FRAME = {"width": 3840, "height": 2160}


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for name in ("config.yaml", "camera_calibration.json"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    return tmp_path / "config.yaml"


@pytest.fixture
def place_without_radius(place: Path) -> Path:
    file = place.with_name("other.yaml")
    file.write_text(place.read_text().replace("radius_px: 1750", ""))
    return file


def content(file: Path) -> bytes:
    return file.read_bytes()


class Site:
    """The page of a configuration, and the newest frame that it is given."""

    def __init__(
        self, config: Path, *overrides: str, access: Any = OPEN, live: bool = True
    ) -> None:
        self.loaded = load_config(config, overrides)
        self.newest: Frame | bytes | None = None
        self.app = make_application(
            access, lambda app: add_align(app, self.loaded, lambda: self.newest, live=live)
        )


@pytest.fixture
async def start() -> AsyncIterator[Any]:
    clients: list[TestClient] = []

    async def begin(site: Site) -> TestClient:
        client = TestClient(TestServer(site.app))
        await client.start_server()
        clients.append(client)
        return client

    yield begin
    for client in clients:
        await client.close()


def values(site: Site, **changes: float) -> dict[str, float]:
    return {**asdict(Alignment.of(ground_camera(site.loaded))), **changes}


async def test_the_grid_is_the_deployed_geometry_s(place: Path, start) -> None:
    site = Site(place)
    client = await start(site)
    mark = {"name": "1", "u": 1900, "v": 1500, "distance_m": 9.0}
    answer = await client.post(
        "/align/grid",
        json={"values": values(site, height_m=4.02336), "frame": FRAME, "marks": [mark]},
    )
    assert answer.status == 200
    data = await answer.json()
    camera = ground_camera(site.loaded)
    frame = framing(site.loaded).for_frame(3840, 2160)
    taller = msgspec.json.decode(
        msgspec.json.encode(
            ground_grid(type(camera)(camera.lens, camera.cx, camera.cy, 4.02336), frame)
        )
    )
    assert data["grid"] == taller
    assert data["at_10m"]["reads_m"] == pytest.approx(11.0)
    assert data["at_10m"]["steps"]["height_m"] == pytest.approx(10 * 0.1 / 4.02336)
    [reading] = data["marks"]
    xy, _ = camera.ground(frame.frame_to_crop([(1900, 1500)]))
    assert reading["distance_m"] == pytest.approx(1.1 * float(np.hypot(*xy[0])))
    # The grid's own lines go through what they say: every point of the 10 m ring reads 10 m.
    ring = np.array(data["grid"]["lines"]["ring"][1]).reshape(-1, 2)
    seen = type(camera)(camera.lens, camera.cx, camera.cy, 4.02336)
    on_ground, _ = seen.ground(frame.frame_to_crop(ring))
    assert np.hypot(*on_ground.T) == pytest.approx(10, abs=0.05)


async def test_a_scaled_picture_has_the_same_grid_smaller(place: Path) -> None:
    loaded = load_config(place)
    whole, half = (framing(loaded).for_frame(w, w * 9 // 16) for w in (3840, 1920))
    camera = ground_camera(loaded)
    for kind, lines in ground_grid(camera, whole).lines.items():
        for a, b in zip(lines, ground_grid(camera, half).lines[kind], strict=True):
            assert np.abs(np.array(a) / 2 - np.array(b)).max() < 0.11


async def test_state_says_where_numbers_come_from(
    place: Path, place_without_radius: Path, start
) -> None:
    client = await start(Site(place, "camera.height_m=5"))
    state = await (await client.get("/align/state")).json()
    origin = {field["key"]: field["origin"] for field in state["fields"]}
    assert origin["radius_px"] == (
        "camera.radius_px, which overrides the focal length in camera_calibration.json"
    )
    assert "saving writes camera.cx, which then overrides it" in origin["cx"]
    assert (state["running"]["height_m"], state["filed"]["height_m"]) == (5, 3.6576)
    assert state["start"]["height_m"] == 3.6576  # the service's file, not what it was started with
    client = await start(Site(place, "camera.height_m=5", live=False))
    assert (await (await client.get("/align/state")).json())["start"]["height_m"] == 5
    client = await start(Site(place_without_radius))
    state = await (await client.get("/align/state")).json()
    origin = {field["key"]: field["origin"] for field in state["fields"]}
    assert origin["radius_px"].startswith("camera_calibration.json; saving writes")
    assert state["running"]["radius_px"] == pytest.approx(1750, abs=0.01)


async def test_pictures_come_as_they_are_or_are_encoded(place: Path, start) -> None:
    site = Site(place)
    client = await start(site)
    answer = await client.get("/align/frame.jpg")
    assert answer.status == 503
    assert "no picture yet" in (await answer.json())["error"]
    site.newest = b"\xff\xd8 whatever"
    answer = await client.get("/align/frame.jpg")
    assert (answer.content_type, await answer.read()) == ("image/jpeg", b"\xff\xd8 whatever")
    assert answer.headers["Cache-Control"] == "no-store"
    site.newest = Frame(0, 0.0, 16, 8, jpeg=memoryview(b"\xff\xd8 view"))
    assert await (await client.get("/align/frame.jpg")).read() == b"\xff\xd8 view"
    site.newest = Frame(0, 0.0, 16, 8, rgb=np.zeros((8, 16, 3), np.uint8))
    assert (await (await client.get("/align/frame.jpg")).read())[:2] == b"\xff\xd8"


async def test_a_save_is_told_and_a_stale_one_refused(place: Path, start) -> None:
    (place.parent / "config.provenance.json").write_text("{}")
    client = await start(Site(place))
    state = await (await client.get("/align/state")).json()
    ask = {"values": {"pitch_deg": -5.0}, "sha256": state["sha256"]}
    saved = await (await client.post("/align/save", json=ask)).json()
    assert saved["keys"] == {"pitch_deg": -5.0}
    assert saved["restart"]
    assert saved["promoted"]
    assert load_config(place).config.camera.pitch_deg == -5
    again = await client.post("/align/save", json=ask)
    assert again.status == 409
    assert "changed after this page" in (await again.json())["error"]
    state = await (await client.get("/align/state")).json()
    assert state["filed"]["pitch_deg"] == -5
    assert state["running"]["pitch_deg"] == 0


@pytest.mark.parametrize("key", ["d_max_m", "camera.height_m", "source", "../x"])
async def test_no_page_writes_another_key(place: Path, start, key: str) -> None:
    client = await start(Site(place))
    before = content(place)
    state = await (await client.get("/align/state")).json()
    ask = {"values": {key: 1.0}, "sha256": state["sha256"]}
    answer = await client.post("/align/save", json=ask)
    assert answer.status == 400
    assert "is not for a page to write" in (await answer.json())["error"]
    assert content(place) == before


async def test_questions_that_cannot_be(place: Path, start) -> None:
    site = Site(place)
    client = await start(site)
    grid = {"values": values(site), "frame": FRAME}
    for path, ask, says in (
        ("grid", {**grid, "values": values(site, height_m=0)}, "height_m"),
        ("grid", {**grid, "values": values(site, pitch_deg=91)}, "pitch_deg"),
        ("grid", {**grid, "values": values(site, radius_px=-1)}, "radius_px"),
        ("grid", {**grid, "frame": {"width": 100, "height": 100}}, "camera.width"),
        ("grid", {**grid, "frame": {"width": 0, "height": 1}}, "frame.width"),
        ("grid", {**grid, "decision": {}}, "decision"),
        ("grid", {**grid, "marks": [{"name": "1", "u": 1, "v": 1}] * 41}, "marks"),
        ("fit", {"frame": FRAME, "marks": "no"}, "marks"),
        ("save", {"values": {"pitch_deg": 91}, "sha256": "?"}, "changed after this page"),
    ):
        answer = await client.post(f"/align/{path}", json=ask)
        assert answer.status in (400, 409), (path, ask)
        assert says in (await answer.json())["error"]
    answer = await client.post("/align/grid", data=json.dumps(grid))
    assert answer.status == 415
    refused = await (await client.post("/align/fit", json={"frame": FRAME, "marks": []})).json()
    assert "0 measurements cannot determine 2 parameters" in refused["refused"]


@pytest.mark.parametrize("path", ["", "/state", "/frame.jpg"])
async def test_nothing_without_the_token(place: Path, start, path: str) -> None:
    client = await start(Site(place, access=LOCKED))
    answer = await client.get(f"/align{path}")
    assert answer.status == 401
    for name in ("grid", "fit", "save"):
        assert (await client.post(f"/align/{name}", json={})).status == 401


async def test_another_site_can_neither_ask_nor_save(place: Path, start) -> None:
    client = await start(Site(place))
    before = content(place)
    state = await (await client.get("/align/state")).json()
    answer = await client.post(
        "/align/save",
        json={"values": {"pitch_deg": -5.0}, "sha256": state["sha256"]},
        headers={"Origin": "http://evil.example"},
    )
    assert answer.status == 403
    assert content(place) == before


async def test_the_service_s_newest_frame_is_the_picture(place: Path, start) -> None:
    loaded = load_config(place, SMALL)
    pages, within = ServicePages(loaded), web_context(loaded)

    class Served:
        app = pages.application(within)

    client = await start(Served)
    assert (await client.get("/align/frame.jpg")).status == 503
    result = Scene(within.track_and_decide).next()
    await pages.on_frame_result(result)
    answer = await client.get("/align/frame.jpg")
    assert await answer.read() == bytes(result.decoded.frame.jpeg or b"")
    state = await (await client.get("/align/state")).json()
    assert state["live"]
    ask = {"values": state["running"], "frame": {"width": 960, "height": 640}}
    assert (await client.post("/align/grid", json=ask)).status == 200
