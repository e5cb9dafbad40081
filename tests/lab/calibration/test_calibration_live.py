"""The guide before a camera: what it keeps, what it says, and how the page shows it."""

from __future__ import annotations

import asyncio
import json
import math
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from aiohttp.test_utils import TestClient, TestServer
from board_render import draw_picture
from synthetic_boards import BoardPose, DrawnCamera, draw_views, spread_poses

from bikeped.capture.base import FrameSource
from bikeped.config.output_sections import WebConfig
from bikeped.errors import CalibrationError, CaptureError
from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern, BoardView
from bikeped.lab.calibration.capture.coverage import (
    CircleSector,
    Coverage,
    circle_sectors,
    measure_coverage,
)
from bikeped.lab.calibration.capture.guide import CaptureGuide, FrameStatus
from bikeped.lab.calibration.capture.live_session import (
    LiveSession,
    add_live_page,
    capture_boards,
    live_page,
)
from bikeped.lab.calibration.corners.candidates import assumed_lens
from bikeped.types import Frame, ImageArray
from bikeped.web.security import load_access_policy
from bikeped.web.server import make_application

PATTERN = BoardPattern(7, 6, 0.04)
SIDE = 480
CAMERA = DrawnCamera(Lens.from_circle("equidistant", 236, 190), 241.0, 238.0, SIDE, SIDE)


def guide() -> CaptureGuide:
    lens, centre = assumed_lens(SIDE, SIDE)
    return CaptureGuide(PATTERN, SIDE, SIDE, lens, centre)


def board(x_m: float = 0.0, y_m: float = 0.0, seed: int = 0) -> ImageArray:
    pose = BoardPose(np.eye(3), np.array([x_m, y_m, 0.25]))
    return draw_picture(CAMERA, PATTERN, pose, seed=seed)


class Recording(FrameSource):
    """Frames from memory; `live` ones block for ever after the last."""

    def __init__(self, pictures: list[ImageArray | None], *, live: bool = False) -> None:
        self.name, self.width, self.height, self.fps, self.live = "drawn", SIDE, SIDE, 10.0, live
        self._pictures = pictures
        self._number = 0
        self.closed = threading.Event()

    def read(self) -> Frame | None:
        if self._number == len(self._pictures):
            return None
        picture = self._pictures[self._number]
        if picture is None:
            raise CaptureError("drawn: unplugged")
        self._number += 1
        rgb = np.repeat(picture[..., None], 3, axis=2)
        return Frame(self._number, self._number / 10, picture.shape[1], picture.shape[0], None, rgb)

    def close(self) -> None:
        self.closed.set()


def test_a_board_is_kept_once_it_is_still_and_only_once() -> None:
    guided = guide()
    answers = [
        guided.check_frame(np.full((SIDE, SIDE), 90, np.uint8), 0.0),
        guided.check_frame(board(seed=1), 0.2),
        guided.check_frame(board(0.08, seed=2), 0.4),
        guided.check_frame(board(0.08, seed=3), 0.6),
        guided.check_frame(board(0.08, seed=4), 0.8),
        guided.check_frame(board(-0.1, seed=5), 5.0),
        guided.check_frame(board(-0.1, seed=6), 9.0),  # too long after the last look
        guided.check_frame(board(-0.1, seed=7), 9.2),
    ]
    assert [one.status for one in answers] == [
        FrameStatus.NO_BOARD,
        FrameStatus.MOVING,
        FrameStatus.MOVING,
        FrameStatus.KEPT,
        FrameStatus.SEEN,
        FrameStatus.MOVING,
        FrameStatus.MOVING,
        FrameStatus.KEPT,
    ]
    assert len(guided.kept) == 2
    assert answers[3].uv_px.shape == (42, 2)
    assert len(answers[0].uv_px) == 0


def test_a_blurred_board_is_not_kept() -> None:
    guided = guide()
    sharp = board(0.08)
    guided.check_frame(sharp, 0.0)
    blurred = np.asarray(cv2.GaussianBlur(board(-0.1), (0, 0), 2.2), np.uint8)
    assert guided.check_frame(blurred, 0.2).status is FrameStatus.BLURRED
    assert guided.check_frame(blurred, 0.4).status is FrameStatus.BLURRED
    assert not guided.kept


def test_it_says_when_there_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    guided = guide()
    views = draw_views(CAMERA, PATTERN, spread_poses(CAMERA, PATTERN, 60, span_deg=(40, 70)))
    guided.kept = views[:5]
    guided.coverage = guided._measure()
    assert not guided.enough
    assert "hold the board there" in guided.advice
    guided.kept = views
    guided.coverage = guided._measure()
    assert guided.coverage.share > 0.85
    assert guided.enough
    assert guided.advice.startswith("enough: 60 boards")


def test_an_empty_circle_is_all_gaps_and_words_point_the_right_way() -> None:
    lens = Lens.from_circle("equidistant", 500, 190)
    window = (0.0, 0.0, 1001.0, 1001.0)
    assert measure_coverage([], lens, (500, 500), window).share == 0
    ids = np.arange(16, dtype=np.int64)
    spots = {"upper left": (-1, -1), "right": (1, 0), "bottom": (0, 1)}
    for way, (x, y) in spots.items():
        unit = np.array([x, y]) / math.hypot(x, y)
        uv = 500 + 440 * unit + np.random.default_rng(0).uniform(-20, 20, (16, 2))
        view = BoardView("a", ids, uv, 1001, 1001)
        covered = measure_coverage([view, view], lens, (500, 500), window)
        hit = [part.where for part in covered.sectors if part.covered]
        assert hit == [f"{way}, at the rim"]
        assert not any(line.startswith(f"{way}, at the rim") for line in covered.advice(40))


def test_parts_tile_the_circle_and_stay_on_the_picture() -> None:
    lens = Lens.from_circle("equisolid", 500, 190)
    parts = circle_sectors(lens, (500, 500), (0, 0, 1001, 1001))
    solid = sum(
        (math.cos(p.from_rad) - math.cos(p.to_rad)) * (p.stop_rad - p.start_rad) for p in parts
    )
    assert solid == pytest.approx(2 * math.pi * (1 - math.cos(math.radians(95))), rel=1e-9)
    low = circle_sectors(lens, (500, 500), (0, 200, 1001, 801))
    assert len(low) < len(parts)
    assert not any(part.where == "top, at the rim" for part in low)


def test_the_emptiest_part_comes_first() -> None:
    def sector(corners: int, to_rad: float, where: str) -> CircleSector:
        return CircleSector(0.0, to_rad, 0.0, 1.0, where, corners, 2)

    coverage = Coverage(
        [sector(11, 1.0, "a"), sector(0, 1.0, "b"), sector(0, 1.5, "c"), sector(20, 1, "d")]
    )
    assert [one.where for one in coverage.gaps] == ["c", "b", "a"]
    assert coverage.share == 0.25
    advice = coverage.advice(1)
    assert len(advice) == 1
    assert advice[0].startswith("c (0 to 86 degrees from the axis): no corner yet; hold the board")


def test_a_capture_saves_what_it_keeps_beside_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "board-001.png").write_bytes(b"mine")
    frames = [board(0.08, seed=1), board(0.08, seed=2), board(-0.1, seed=3), board(-0.1, seed=4)]
    guided = guide()
    session = LiveSession(guided)
    lines: list[str] = []
    saved = capture_boards(Recording([*frames]), guided, tmp_path, session, say=lines.append)
    assert [path.name for path in saved] == ["board-002.png", "board-003.png"]
    assert (tmp_path / "board-001.png").read_bytes() == b"mine"
    np.testing.assert_array_equal(cv2.imread(str(saved[0]), cv2.IMREAD_GRAYSCALE), frames[1])
    assert any(line.startswith("kept as board 2: board-003.png") for line in lines)
    assert session.stopped
    assert session.status()["kept"] == 2
    shown = cv2.imdecode(np.frombuffer(session.picture()[1], np.uint8), cv2.IMREAD_COLOR)
    assert shown is not None
    assert shown.shape == (SIDE, SIDE, 3)


def test_a_live_source_that_breaks_or_has_another_size_ends_the_capture(tmp_path: Path) -> None:
    guided = guide()
    with pytest.raises(CaptureError, match="unplugged"):
        capture_boards(Recording([board(), None], live=True), guided, tmp_path, LiveSession(guided))
    small = np.zeros((100, 100), np.uint8)
    with pytest.raises(CalibrationError, match="100x100 pixels instead of 480x480"):
        capture_boards(Recording([small]), guided, tmp_path, LiveSession(guided))


async def test_the_page_tells_and_streams() -> None:
    guided = guide()
    session = LiveSession(guided)
    picture = board()
    session.publish(picture, guided.check_frame(picture, 0.0))
    policy = load_access_policy(WebConfig())
    app = make_application(policy, lambda app: add_live_page(app, session))
    async with TestClient(TestServer(app)) as client:
        page = await (await client.get("/calibrate")).text()
        assert 'src="calibrate/stream"' in page
        status = await (await client.get("/calibrate/status")).json()
        assert status["says"] == "a board: hold it still"
        assert status["kept"] == 0
        assert status["next"] == guided.advice
        assert len(status["parts"]) == len(guided.coverage.sectors)
        stream = await client.get("/calibrate/stream")
        start = await stream.content.readuntil(b"\r\n\r\n")
        assert b"image/jpeg" in start
        assert await stream.content.readexactly(2) == b"\xff\xd8"
        session.stop()
        await stream.release()


async def test_the_page_of_its_own_serves_this_machine_only() -> None:
    session = LiveSession(guide())
    with live_page(session, port=0) as (url, _):
        assert url is not None
        port = int(url.split(":")[2].split("/")[0])
        for host, expected in (("localhost", b"200"), ("evil.example", b"403")):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            head = f"Host: {host}:{port}\r\nConnection: close\r\n\r\n"
            writer.write(f"GET /calibrate/status HTTP/1.1\r\n{head}".encode())
            answer = await reader.read()
            writer.close()
            await writer.wait_closed()
            assert answer.split(b" ", 2)[1] == expected
            if expected == b"200":
                assert (
                    json.loads(answer.split(b"\r\n\r\n", 1)[1])["says"] == "waiting for the camera"
                )
        with live_page(LiveSession(guide()), port=port) as (url, error):
            assert url is None
            assert "web.port to a free one" in str(error)
    assert session.stopped
