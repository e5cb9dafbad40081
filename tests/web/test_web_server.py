"""The application around the pages: frame, navigation, static files, JSON in and out, errors."""

from __future__ import annotations

import asyncio
import contextlib
import re
import socket
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import aiohttp
import msgspec
import pytest
from aiohttp import web
from hypothesis import given, settings
from hypothesis import strategies as st
from web_fakes import OPEN

from bikeped.config.output_sections import WebConfig
from bikeped.errors import BikepedError, ConfigError
from bikeped.telemetry.http_server import HttpServer
from bikeped.web.server import Page, add_page, json_answer, json_body, make_application, serve_pages

WEB = Path(__file__).parents[2] / "bikeped" / "web"
STATIC, TEMPLATES = WEB / "static", WEB / "templates"


class Asked(msgspec.Struct):
    height_m: float
    name: str = ""


def add_parts(app: web.Application) -> None:
    add_page(app, Page("/testbench", "Test bench", "<Bench>", "login.html"))
    add_page(app, Page("/align", "Align", "Align", "login.html", ("login.js",), ("app.css",)))

    async def post(request: web.Request) -> web.Response:
        return json_answer(await json_body(request, Asked))

    async def refuse(_request: web.Request) -> web.Response:
        raise BikepedError("scenario.yaml: agents: missing;\n add one")

    async def fail(_request: web.Request) -> web.Response:
        raise RuntimeError("a bug with /etc/secret in it")

    app.router.add_post("/align/post", post)
    app.router.add_get("/align/refuse", refuse)
    app.router.add_get("/align/fail", fail)


@pytest.fixture
async def base() -> AsyncIterator[str]:
    server = HttpServer(make_application(OPEN, add_parts), WebConfig(port=0))
    assert await server.start()
    yield f"http://127.0.0.1:{server.port}"
    await server.stop()


async def get(url: str, **options: Any) -> tuple[int, Any, str]:
    async with (
        aiohttp.ClientSession() as session,
        session.get(url, allow_redirects=False, **options) as answer,
    ):
        return answer.status, answer.headers, await answer.text()


async def test_pages_share_a_frame_with_one_navigation_in_a_fixed_order(base):
    status, headers, text = await get(f"{base}/testbench")
    assert status == 200
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert headers["Cache-Control"] == "no-store"
    nav = re.findall(r'<a href="(/\w*)"( aria-current="page")?>([^<]+)</a>', text)
    assert nav == [("/align", "", "Align"), ("/testbench", ' aria-current="page"', "Test bench")]
    assert "<title>&lt;Bench&gt; · bikeped</title>" in text
    assert "{{" not in text
    _, _, text = await get(f"{base}/align")
    assert '<script type="module" src="/static/login.js"></script>' in text
    assert '<link rel="stylesheet" href="/static/app.css">' in text


async def test_without_a_live_page_the_first_one_is_the_start(base):
    status, headers, _ = await get(f"{base}/")
    assert (status, headers["Location"]) == (302, "/align")


async def test_nothing_inline_in_any_page():
    """What the content security policy would refuse in a browser."""
    pages = sorted(TEMPLATES.rglob("*.html"))
    assert pages
    for path in pages:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"<style|\sstyle=|\son\w+=|javascript:", text), path
        assert all('src="' in tag for tag in re.findall(r"<script[^>]*>", text)), path


async def test_nothing_is_loaded_from_elsewhere():
    for path in sorted(WEB.rglob("*")):
        if path.suffix in (".html", ".css", ".js", ".svg"):
            text = path.read_text(encoding="utf-8").replace("http://www.w3.org/", "")
            text = re.sub(r"https?://(127\.0\.0\.1|localhost)\b", "", text)
            assert not re.search(r"(?:https?:)?//[a-z0-9-]+\.[a-z]{2,}/", text), path


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("ui.js", "text/javascript; charset=utf-8"),
        ("app.css", "text/css; charset=utf-8"),
        ("icon.svg", "image/svg+xml"),
    ],
)
async def test_static_files_have_their_type_and_are_asked_for_anew(base, name, kind):
    status, headers, text = await get(f"{base}/static/{name}")
    assert status == 200
    assert headers["Content-Type"] == kind
    assert headers["Cache-Control"] == "no-cache"
    assert text == (STATIC / name).read_text(encoding="utf-8")
    status, _, text = await get(f"{base}/static/{name}", headers={"If-None-Match": headers["ETag"]})
    assert (status, text) == (304, "")
    assert (await get(f"{base}/favicon.ico"))[0] == 200


async def raw(base: str, path: bytes) -> bytes:
    """The status line for a path that no client would send as it is."""
    reader, writer = await asyncio.open_connection("127.0.0.1", int(base.rpartition(":")[2]))
    writer.write(b"GET " + path + b" HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    answer = await asyncio.wait_for(reader.read(), 20)
    writer.close()
    await writer.wait_closed()
    return answer


@pytest.mark.parametrize(
    "path",
    [
        b"/static/../server.py",
        b"/static/%2e%2e/server.py",
        b"/static/..%2fserver.py",
        b"/static/....//server.py",
        b"/static/..\\server.py",
        b"/static//etc/passwd",
        b"/static/%2fetc%2fpasswd",
        b"/static/./../../../../../../etc/passwd",
        b"/static/ui.js%00.css",
        b"/static/",
        b"/static/frame.html",
        b"/../../etc/passwd",
        b"/static/../../../config.yaml",
    ],
)
async def test_no_path_leads_out_of_the_static_files(base, path):
    answer = await raw(base, path)
    assert re.match(rb"HTTP/1\.1 40[04] ", answer), answer[:80]
    assert b"root:" not in answer
    assert b"import" not in answer


async def test_json_in_and_out(base):
    async with aiohttp.ClientSession() as session:
        url = f"{base}/align/post"
        async with session.post(url, json={"height_m": 3.66, "name": "<b>"}) as answer:
            assert answer.status == 200
            assert answer.headers["Cache-Control"] == "no-store"
            assert await answer.json() == {"height_m": 3.66, "name": "<b>"}
        for body, said in (
            (b'{"height_m": "high"}', "height_m"),
            (b"{}", "height_m"),
            (b"not json", "malformed"),
            (b"\xff\xfe", ""),
            (b"[" * 100_000, ""),
        ):
            headers = {"Content-Type": "application/json"}
            async with session.post(url, data=body, headers=headers) as answer:
                assert answer.status == 400, body[:20]
                assert said in (await answer.json())["error"]
        # a form of another site's page can send no other types than these unasked
        for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data"):
            headers = {"Content-Type": kind}
            async with session.post(url, data=b'{"height_m": 1}', headers=headers) as answer:
                assert answer.status == 415


async def test_errors_are_one_line_of_json_and_bugs_tell_nothing(base, caplog):
    status, headers, text = await get(f"{base}/align/refuse")
    assert status == 400
    assert headers["Content-Type"].startswith("application/json")
    assert msgspec.json.decode(text) == {"error": "scenario.yaml: agents: missing; add one"}
    status, _, text = await get(f"{base}/align/fail")
    assert status == 500
    assert "secret" not in text
    assert "a bug with /etc/secret" in caplog.text


@settings(max_examples=60)
@given(st.binary(max_size=200))
def test_any_bytes_for_a_body_are_an_answer_and_no_bug(body: bytes):
    class Request:
        content_type = "application/json"

        async def read(self) -> bytes:
            return body

    with contextlib.suppress(BikepedError):
        asyncio.run(json_body(Request(), Asked))  # type: ignore[arg-type]


def test_serving_from_a_command_says_where_and_refuses_what_cannot_be():
    said: list[str] = []
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        config = WebConfig(port=taken.getsockname()[1])
        with pytest.raises(BikepedError, match=r"web\.port"):
            serve_pages(config, add_parts, announce=said.append)
    assert said == []
    with pytest.raises(ConfigError, match=r"web\.token_file"):
        serve_pages(WebConfig(host="0.0.0.0", port=0), add_parts, announce=said.append)
    assert threading.active_count() < 20
