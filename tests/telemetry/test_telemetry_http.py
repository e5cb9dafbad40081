"""/metrics and /healthz over a real socket."""

from __future__ import annotations

import asyncio
import logging
import re
import socket
from collections.abc import AsyncIterator, Callable
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families

from bikeped.config.output_sections import WebConfig, is_loopback
from bikeped.telemetry import http_server
from bikeped.telemetry.http_server import (
    REQUESTS_HZ,
    Health,
    HttpServer,
    add_monitoring,
    host_name,
    limit_rate,
    port_error,
)
from bikeped.telemetry.metrics import Metrics
from bikeped.telemetry.schema import Counters


def make_app(registry: CollectorRegistry, health: Health) -> web.Application:
    app = web.Application()
    add_monitoring(app, registry, health)
    return app


@pytest.fixture
async def serve() -> AsyncIterator[Callable[..., Any]]:
    servers: list[HttpServer] = []

    async def start(app: web.Application) -> str:
        servers.append(HttpServer(app, WebConfig(port=0)))
        assert await servers[-1].start()
        return f"http://127.0.0.1:{servers[-1].port}"

    yield start
    for server in servers:
        await server.stop()


async def get(url: str, **headers: str) -> tuple[int, str, str]:
    async with aiohttp.ClientSession() as session, session.get(url, headers=headers) as response:
        return response.status, response.headers["Content-Type"], await response.text()


async def test_metrics_are_prometheus_text(serve):
    metrics = Metrics()
    counters = Counters(**{**dict.fromkeys(Counters.__struct_fields__, 0), "undecodable": 3})
    metrics.update(
        fps=0.0,
        capture_age_s=None,
        faults=0,
        mqtt_connected=False,
        light_errors=0,
        counters=counters,
    )
    base = await serve(make_app(metrics.registry, dict))
    status, content_type, body = await get(f"{base}/metrics")
    assert status == 200
    assert content_type.startswith("text/plain")
    samples = {
        sample.name: sample.value
        for family in text_string_to_metric_families(body)
        for sample in family.samples
    }
    assert samples["bikeped_frames_undecodable_total"] == 3


async def test_openmetrics_is_spoken_when_asked(serve):
    base = await serve(make_app(Metrics().registry, dict))
    _, content_type, body = await get(
        f"{base}/metrics", Accept="application/openmetrics-text; version=1.0.0"
    )
    assert content_type.startswith("application/openmetrics-text")
    assert body.endswith("# EOF\n")


@pytest.mark.parametrize(
    ("report", "status"),
    [
        ({"state": "SAFE", "fps": 30.0}, 200),
        ({"state": "ALERT"}, 200),
        ({"state": "OFF"}, 200),
        ({"state": "FAULT", "faults": ["camera: no frame"]}, 503),
        ({}, 503),
        ({"state": "PANIC"}, 503),
    ],
)
async def test_healthz_is_well_only_on_positive_evidence(serve, report, status):
    base = await serve(make_app(Metrics().registry, lambda: report))
    async with aiohttp.ClientSession() as session, session.get(f"{base}/healthz") as response:
        assert response.status == status
        assert await response.json() == report


async def test_a_health_report_that_fails_is_a_fault(serve, caplog):
    def broken() -> dict[str, Any]:
        raise RuntimeError("a bug")

    base = await serve(make_app(Metrics().registry, broken))
    async with aiohttp.ClientSession() as session, session.get(f"{base}/healthz") as response:
        assert response.status == 503
        assert (await response.json())["state"] == "FAULT"
    assert "a bug" in caplog.text


@pytest.mark.parametrize(
    "rubbish",
    [
        b"GET /" + b"a" * 9000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n: no name\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n",
    ],
    ids=["long address", "header without a name", "TLS"],
)
async def test_what_is_no_request_is_refused_without_a_word_in_the_log(serve, caplog, rubbish):
    url = await serve(make_app(Metrics().registry, dict))
    reader, writer = await asyncio.open_connection("127.0.0.1", int(url.rpartition(":")[2]))
    writer.write(rubbish)
    assert b" 400 " in await reader.readline()
    writer.close()
    await writer.wait_closed()
    assert [r for r in caplog.records if r.levelno >= logging.WARNING] == []


async def test_a_fault_of_a_page_is_in_the_log(serve, caplog):
    async def faulty(_request: web.Request) -> web.Response:
        raise KeyError("a bug of ours")

    app = make_app(Metrics().registry, dict)
    app.router.add_get("/faulty", faulty)
    assert (await get(await serve(app) + "/faulty"))[0] == 500
    assert "a bug of ours" in caplog.text


async def test_more_connections_than_allowed_are_turned_away_and_room_is_used_again():
    server = HttpServer(make_app(Metrics().registry, dict), WebConfig(port=0, max_connections=4))
    assert await server.start()
    held = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(4)]
    for reader, writer in held:  # asked once, so that each is surely there
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert b"503" in await reader.readline()
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    answer = await reader.read()
    assert answer.startswith(b"HTTP/1.1 503 ")
    assert b"Too many connections" in answer
    writer.close()
    await writer.wait_closed()
    held[0][1].close()
    await held[0][1].wait_closed()
    while True:  # the server learns of it in its own time
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        headers = await reader.readuntil(b"\r\n\r\n")
        writer.close()
        if b"application/json" in headers:
            break
    for _, writer in held[1:]:
        writer.close()
    await server.stop()


async def test_a_taken_port_is_an_error_text_and_nothing_more():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        server = HttpServer(make_app(Metrics().registry, dict), WebConfig(port=port))
        assert not await server.start()
    assert server.port is None
    assert str(port) in (server.error or "")
    assert "web.port" in (server.error or "")
    await server.stop()


def test_whether_a_port_is_free_can_be_asked_before():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        refused = port_error(WebConfig(port=port))
    assert re.search(f"{port} .*set web.host and web.port", refused or "")
    assert port_error(WebConfig(port=port)) is None
    assert port_error(WebConfig(port=port, host="localhost")) is None
    assert "web.host" in (port_error(WebConfig(port=port, host="192.0.2.1")) or "")


@pytest.mark.parametrize(
    ("header", "name"),
    [("A:1", "a"), ("a", "a"), ("[::1]:80", "::1"), ("[::1]", "::1"), (" b ", "b"), ("", "")],
)
def test_host_names(header: str, name: str):
    assert host_name(header) == name


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.1.2.3", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("pole.example", False),
    ],
)
def test_loopback(host: str, loopback: bool):
    assert is_loopback(host) is loopback


async def test_metrics_are_rendered_once_for_all_that_ask_at_a_time(serve):
    class Counted(CollectorRegistry):
        collected = 0

        def collect(self) -> Any:
            self.collected += 1
            return super().collect()

    registry = Counted()
    base = await serve(make_app(Metrics(registry).registry, dict))
    answers = await asyncio.gather(*(get(f"{base}/metrics") for _ in range(20)))
    assert all(answer == answers[0] for answer in answers)
    assert registry.collected < 20


async def test_requests_of_a_service_wait_for_their_turn(serve, monkeypatch):
    now_s, slept = [100.0], []
    real_sleep = asyncio.sleep

    async def sleep(duration_s: float) -> None:
        slept.append(duration_s)
        await real_sleep(0)

    app = make_app(Metrics().registry, lambda: {"state": "SAFE"})
    limit_rate(app)
    base = await serve(app)
    at_once = round(REQUESTS_HZ)
    monkeypatch.setattr(http_server.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(http_server.asyncio, "sleep", sleep)
    async with aiohttp.ClientSession() as session:

        async def ask(times: int) -> list[float]:
            slept.clear()
            for _ in range(times):
                async with session.get(f"{base}/healthz") as response:
                    assert response.status == 200
            return [duration_s for duration_s in slept if duration_s > 1e-6]

        assert await ask(at_once) == []
        assert await ask(3) == pytest.approx([n / REQUESTS_HZ for n in (1, 2, 3)])
        now_s[0] += 60.0
        assert await ask(at_once) == []
        monkeypatch.undo()


async def test_a_client_that_takes_nothing_is_cut_off(monkeypatch):
    monkeypatch.setattr(http_server, "SEND_S", 0.5)
    ended = asyncio.Event()

    async def much(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse()
        await response.prepare(request)
        try:
            while True:
                await response.write(bytes(65536))
        finally:
            ended.set()

    app = web.Application()
    app.router.add_get("/much", much)
    server = HttpServer(app, WebConfig(port=0))
    assert await server.start()
    _, writer = await asyncio.open_connection("127.0.0.1", server.port, limit=1024)
    writer.write(b"GET /much HTTP/1.1\r\nHost: localhost\r\n\r\n")
    await asyncio.wait_for(ended.wait(), 60.0)
    writer.transport.abort()
    await server.stop()
