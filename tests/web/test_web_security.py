"""Who is let in: hosts, origins, tokens, bodies, headers; over a real socket."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from hypothesis import given
from hypothesis import strategies as st
from web_fakes import LOCKED, OPEN, TOKEN

from bikeped.config.load import parse_config
from bikeped.config.output_sections import WebConfig
from bikeped.errors import ConfigError
from bikeped.telemetry.http_server import HttpServer
from bikeped.web import security
from bikeped.web.security import (
    COOKIE,
    MAX_BODY,
    SESSION_S,
    AccessPolicy,
    FailedLogins,
    load_access_policy,
)
from bikeped.web.server import Page, add_page, make_application

HTML = {"Accept": "text/html"}


def add_probe(app: web.Application) -> None:
    """A page, something to read, something that changes, and something that reads a body."""
    add_page(app, Page("/", "Live", "Live", "login.html"))

    async def read(_request: web.Request) -> web.Response:
        return web.Response(text="secret")

    async def change(request: web.Request) -> web.Response:
        return web.Response(text=f"changed {len(await request.read())}")

    async def socket(request: web.Request) -> web.StreamResponse:
        answer = web.WebSocketResponse()
        await answer.prepare(request)
        await answer.close()
        return answer

    app.router.add_get("/read", read)
    app.router.add_post("/change", change)
    app.router.add_get("/socket", socket)


Start = Callable[..., Any]


@pytest.fixture
async def start() -> AsyncIterator[Start]:
    servers: list[HttpServer] = []

    async def begin(access: AccessPolicy = OPEN) -> str:
        servers.append(HttpServer(make_application(access, add_probe), WebConfig(port=0)))
        assert await servers[-1].start()
        return f"http://127.0.0.1:{servers[-1].port}"

    yield begin
    for server in servers:
        await server.stop()


async def ask(method: str, url: str, **options: Any) -> tuple[int, Any, str]:
    async with (
        aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar()) as session,
        session.request(method, url, allow_redirects=False, **options) as answer,
    ):
        return answer.status, answer.headers, await answer.text()


# --- hosts


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost:8080", 200),
        ("LOCALHOST", 200),
        ("127.0.0.1", 200),
        ("[::1]:8080", 200),
        ("evil.example", 403),
        ("127.0.0.1.evil.example", 403),
        ("localhost.evil.example:8080", 403),
        ("192.168.1.7", 403),
        ("", 403),
    ],
)
async def test_a_server_of_this_machine_answers_to_its_own_names_only(start, host, status):
    base = await start()
    for path in ("/read", "/", "/static/ui.js", "/login"):
        assert (await ask("GET", base + path, headers={"Host": host}))[0] == status


def test_bound_for_others_plain_addresses_and_own_names_are_answered_to(tmp_path, monkeypatch):
    monkeypatch.setattr("socket.gethostname", lambda: "Pole7")
    (tmp_path / "token").write_text(TOKEN + "\n")
    config = WebConfig(host="0.0.0.0", token_file="token", allowed_hosts=("Crossing.example",))
    access = load_access_policy(config, tmp_path)
    for host in ("192.168.1.7:8080", "[fe80::1]:80", "pole7", "pole7.local:8080", "localhost"):
        assert access.knows_host(host), host
    assert access.knows_host("crossing.example:8080")
    for host in ("evil.example", "192.168.1.7.evil.example", "", "pole7.evil.example"):
        assert not access.knows_host(host), host


# --- origins


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),  # a program, not a browser
        ({"Origin": "{base}"}, 200),
        ({"Origin": "{base}", "Sec-Fetch-Site": "same-origin"}, 200),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "http://localhost:1"}, 403),  # another program's page on this machine
        ({"Origin": "null"}, 403),
        ({"Origin": ""}, 403),
        ({"Origin": "http://[::1"}, 403),
        ({"Origin": "{base}.evil.example"}, 403),
        ({"Sec-Fetch-Site": "cross-site"}, 403),
        ({"Sec-Fetch-Site": "same-site"}, 403),
        ({"Origin": "{base}", "Sec-Fetch-Site": "cross-site"}, 403),
        ({"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate"}, 403),
    ],
)
@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
async def test_only_our_own_pages_change_anything(start, headers, status, method):
    base = await start()
    sent = {name: value.format(base=base) for name, value in headers.items()}
    got = (await ask(method, f"{base}/change", headers=sent, data=b"x"))[0]
    assert got == (405 if status == 200 and method != "POST" else status)


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "cors"}, 200),
        ({"Sec-Fetch-Site": "none", "Sec-Fetch-Mode": "navigate"}, 200),  # typed in
        (
            {
                "Sec-Fetch-Site": "cross-site",
                "Sec-Fetch-Mode": "navigate",
                "Sec-Fetch-Dest": "document",
            },
            200,  # a link
        ),
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors"}, 403),  # <img>
        (
            {
                "Sec-Fetch-Site": "cross-site",
                "Sec-Fetch-Mode": "navigate",
                "Sec-Fetch-Dest": "iframe",
            },
            403,
        ),
        ({"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "cors"}, 403),
        ({"Origin": "{base}"}, 200),  # browsers without Fetch Metadata
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
    ],
)
async def test_other_sites_may_link_but_not_embed(start, headers, status):
    base = await start()
    sent = {name: value.format(base=base) for name, value in headers.items()}
    assert (await ask("GET", f"{base}/read", headers=sent))[0] == status


@pytest.mark.parametrize(
    ("origin", "fine"), [("{base}", True), (None, True), ("http://evil.example", False)]
)
async def test_websockets_are_for_our_own_pages(start, origin, fine):
    base = await start()
    async with aiohttp.ClientSession() as session:
        opening = session.ws_connect(
            f"{base}/socket", origin=None if origin is None else origin.format(base=base)
        )
        if fine:
            async with opening as socket:
                assert not socket.closed
        else:
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await opening
            assert refused.value.status == 403


# --- tokens


async def test_without_the_token_there_is_the_login_page_and_its_files_only(start):
    base = await start(LOCKED)
    for path in ("/read", "/", "/none", "/socket", "/sessionx/../read"):
        status, headers, text = await ask("GET", base + path)
        assert status == 401
        assert headers["WWW-Authenticate"] == "Bearer"
        assert "secret" not in text
        status, _, text = await ask("GET", base + path, headers=HTML)
        assert status == 401
        assert 'name="token"' in text
    assert (await ask("POST", f"{base}/change", data=b"x"))[0] == 401
    for path in ("/login", "/static/app.css", "/static/login.js"):
        assert (await ask("GET", base + path))[0] == 200


@pytest.mark.parametrize(
    ("given", "status"),
    [
        (f"Bearer {TOKEN}", 200),
        (f"bearer {TOKEN}", 200),
        ("Bearer wrong-wrong-wrong", 401),
        (f"Bearer {TOKEN}x", 401),
        (f"Bearer {TOKEN[:-1]}", 401),
        ("Bearer ", 401),
        (f"Basic {TOKEN}", 401),
        (TOKEN, 401),
    ],
)
async def test_programs_send_the_token_in_a_header(start, given, status):
    base = await start(LOCKED)
    assert (await ask("GET", f"{base}/read", headers={"Authorization": given}))[0] == status


def cookie_of(headers: Any) -> str:
    (line,) = headers.getall("Set-Cookie")
    attributes = {part.strip().lower() for part in line.split(";")[1:]}
    assert {"httponly", "samesite=strict", "path=/"} <= attributes
    found = re.match(rf"{COOKIE}=([^;]+)", line)
    assert found
    assert TOKEN not in line
    return found[1]


async def test_a_person_logs_in_once_and_keeps_a_cookie(start):
    base = await start(LOCKED)
    status, headers, text = await ask(
        "POST", f"{base}/login", data={"token": TOKEN, "next": "/read"}, headers={"Origin": base}
    )
    assert status == 200
    assert 'content="0;url=/read"' in text
    cookies = {"Cookie": f"{COOKIE}={cookie_of(headers)}"}
    assert (await ask("GET", f"{base}/read", headers=cookies))[2] == "secret"
    assert (await ask("GET", f"{base}/session", headers=cookies))[2] == '{"let_in":true}'
    assert (await ask("GET", f"{base}/session"))[2] == '{"let_in":false}'
    status, headers, _ = await ask("POST", f"{base}/logout", headers=cookies)
    assert status == 303
    assert f'{COOKIE}=""' in headers["Set-Cookie"]


async def test_a_link_with_the_token_sets_the_cookie_and_leaves_the_address(start):
    base = await start(LOCKED)
    status, headers, text = await ask("GET", f"{base}/?token={TOKEN}", headers=HTML)
    assert status == 200
    assert TOKEN not in text
    assert 'content="0;url=/"' in text
    cookie = {"Cookie": f"{COOKIE}={cookie_of(headers)}", **HTML}
    status, headers, _ = await ask("GET", f"{base}/?token={TOKEN}", headers=cookie)
    assert (status, headers["Location"]) == (302, "/")
    status, headers, text = await ask("GET", f"{base}/?token=not-the-token", headers=HTML)
    assert status == 401
    assert "Set-Cookie" not in headers
    assert "not-the-token" not in text


async def test_another_site_cannot_log_a_visitor_in(start):
    base = await start(LOCKED)
    status, headers, _ = await ask(
        "POST", f"{base}/login", data={"token": TOKEN}, headers={"Origin": "http://evil.example"}
    )
    assert status == 403
    assert "Set-Cookie" not in headers


@pytest.mark.parametrize(
    "path",
    [
        "//evil.example",
        "/\\evil.example",
        "https://evil.example",
        "/..//evil",
        '/"><script>',
        "",
        "x",
    ],
)
async def test_login_leads_nowhere_else(start, path):
    base = await start(LOCKED)
    _, _, text = await ask("POST", f"{base}/login", data={"token": TOKEN, "next": path})
    assert 'content="0;url=/"' in text


@pytest.mark.parametrize(
    "cookie",
    [
        "",
        "x",
        ".",
        "9999999999.",
        "9999999999.0000",
        "9999999999." + "0" * 64,
        "9" * 400 + "." + "0" * 64,
        "²." + "0" * 64,
        "nan." + "0" * 64,
    ],
)
def test_made_up_cookies_open_nothing(cookie):
    assert not LOCKED.is_cookie(cookie, 1.7e9)


def test_cookies_end_with_their_time_and_with_the_token():
    cookie = LOCKED.new_cookie(1.7e9)
    assert LOCKED.is_cookie(cookie, 1.7e9 + SESSION_S - 1)
    assert not LOCKED.is_cookie(cookie, 1.7e9 + SESSION_S)
    later = f"{int(cookie.split('.')[0]) + 1}.{cookie.split('.')[1]}"
    assert not LOCKED.is_cookie(later, 1.7e9)
    assert not AccessPolicy(LOCKED.names, token="another-long-token").is_cookie(cookie, 1.7e9)
    assert not OPEN.is_cookie(cookie, 1.7e9)
    assert AccessPolicy(frozenset(), token=TOKEN).is_cookie(cookie, 1.7e9)  # a restart keeps it


@given(st.text())
def test_no_text_but_the_token_is_the_token(text: str):
    assert LOCKED.is_token(text) is (text == TOKEN)
    assert not OPEN.is_token(text)


def test_the_token_is_in_no_printed_form():
    assert TOKEN not in repr(LOCKED)


async def test_guessing_is_slowed_down_and_the_right_token_waits_too(start):
    base = await start(LOCKED)
    for _ in range(6):
        assert (await ask("POST", f"{base}/login", data={"token": "guess"}))[0] == 401
    status, headers, text = await ask("POST", f"{base}/login", data={"token": TOKEN})
    assert status == 429
    assert int(headers["Retry-After"]) > 0
    assert "Wait a minute" in text
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    assert (await ask("GET", f"{base}/read", headers=bearer))[0] == 429
    assert (await ask("GET", f"{base}/?token={TOKEN}", headers=HTML))[0] == 429
    cookie = {"Cookie": f"{COOKIE}={LOCKED.new_cookie(4e9)}"}  # who is in stays in
    assert (await ask("GET", f"{base}/read", headers=cookie))[0] == 200


def test_failures_are_forgotten_and_bounded():
    now_s = [0.0]
    failures = FailedLogins(per_address=2, overall=5, window_s=60, clock=lambda: now_s[0])
    assert failures.wait_s("a") == 0
    failures.count("a")
    now_s[0] = 10.0
    failures.count("a")
    assert failures.wait_s("a") == 50.0
    assert failures.wait_s("b") == 0
    now_s[0] = 61.0
    assert failures.wait_s("a") == 0
    for address in "bcdef":
        failures.count(address)
    assert failures.wait_s("z") == 60.0  # five in a minute, from whomever
    for number in range(1000):
        failures.count(f"10.0.0.{number}")
    assert len(failures._by_address) <= 5


# --- bodies


async def test_a_hundred_megabytes_are_refused_unread(start):
    base = await start()
    port = int(base.rpartition(":")[2])
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(
        b"POST /change HTTP/1.1\r\nHost: localhost\r\nContent-Length: 104857600\r\n\r\n"
        + b"x" * 100
    )
    answer = await asyncio.wait_for(reader.read(), 20)  # to the end: the connection is closed
    assert answer.startswith(b"HTTP/1.1 413 ")
    writer.close()
    await writer.wait_closed()


async def test_a_body_without_a_length_is_cut_off(start):
    base = await start()

    async def endless():
        for _ in range(MAX_BODY // 65536 + 8):
            yield b"x" * 65536

    with_length = b"x" * MAX_BODY
    assert (await ask("POST", f"{base}/change", data=with_length))[2] == f"changed {MAX_BODY}"
    try:
        status, _, _ = await ask("POST", f"{base}/change", data=endless())
    except (aiohttp.ClientError, ConnectionError):
        return  # cut off before the answer could be read
    assert status == 413


@pytest.mark.parametrize("path", ["/login", "/nope", "/read", "/session"])
async def test_a_hundred_megabytes_in_chunks_are_refused_on_every_path(start, path):
    base = await start()
    reader, writer = await asyncio.open_connection("127.0.0.1", int(base.rpartition(":")[2]))
    writer.write(
        f"POST {path} HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
    )
    answer = asyncio.create_task(reader.readline())
    chunks = 0
    with contextlib.suppress(ConnectionError):
        while chunks < 1600 and not answer.done():
            writer.write(b"10000\r\n" + bytes(65536) + b"\r\n")
            chunks += 1
            await asyncio.wait_for(writer.drain(), 20)
    assert (await answer).startswith(b"HTTP/1.1 413 ")
    assert chunks < 1600
    writer.transport.abort()


async def test_a_body_that_does_not_arrive_is_not_waited_for(start, monkeypatch):
    monkeypatch.setattr(security, "BODY_S", 0.05)
    base = await start()
    reader, writer = await asyncio.open_connection("127.0.0.1", int(base.rpartition(":")[2]))
    writer.write(b"POST /nope HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10\r\n\r\nx")
    assert (await asyncio.wait_for(reader.readline(), 20)).startswith(b"HTTP/1.1 408 ")
    writer.transport.abort()


async def test_a_form_in_parts_is_no_login(start):
    base = await start(LOCKED)
    form = aiohttp.FormData({"token": TOKEN}, default_to_multipart=True)
    status, _, _ = await ask("POST", f"{base}/login", data=form, headers={"Origin": base})
    assert 400 <= status < 500


# --- headers


async def test_every_answer_carries_the_headers(start):
    base = await start()
    for path in ("/", "/read", "/static/ui.js", "/none", "/static/none.js", "/login"):
        _, headers, _ = await ask("GET", base + path)
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "same-origin"
        assert headers["X-Frame-Options"] == "DENY"
        assert "Cache-Control" in headers
        assert "aiohttp" not in headers.get("Server", "")
        assert "Access-Control-Allow-Origin" not in headers
    _, headers, _ = await ask("GET", f"{base}/", headers={"Host": "evil.example"})
    assert "Content-Security-Policy" in headers


# --- configuration


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "pole.lan"])
def test_pages_for_others_need_a_token(host):
    camera = "camera: {radius_px: 58, fov_deg: 73, projection: perspective}\n"
    text = camera + f"web: {{enabled: true, host: '{host}'}}\n"
    with pytest.raises(ConfigError, match=r"c\.yaml: web\.host: .*set web\.token_file too"):
        parse_config(text, "c.yaml", Path())
    with pytest.raises(ConfigError, match=r"web\.token_file"):
        load_access_policy(WebConfig(host=host))
    for fine in ("enabled: false", "enabled: true, token_file: t"):
        parse_config(f"{camera}web: {{host: '{host}', {fine}}}\n", "c.yaml", Path())


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "cannot be read"),
        (b"", "0 characters"),
        (b"\nsecond-line-is-no-token\n", "0 characters"),
        (b"short\n", "5 characters"),
        (b"\xff\xfe\x00\x01 not text at all", "not UTF-8"),
    ],
)
def test_a_token_file_that_cannot_be_used_is_said(tmp_path, content, said):
    if content is not None:
        (tmp_path / "token").write_bytes(content)
    with pytest.raises(ConfigError, match=rf"token: web\.token_file.*{said}"):
        load_access_policy(WebConfig(token_file="token"), tmp_path)


def test_the_first_line_of_the_file_is_the_token(tmp_path):
    (tmp_path / "token").write_text(f"{TOKEN}\r\nsomething else\n")
    access = load_access_policy(WebConfig(token_file=str(tmp_path / "token")))
    assert access.is_token(TOKEN)
