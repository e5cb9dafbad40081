"""/metrics and /healthz over a real socket."""

from __future__ import annotations

import socket
from collections.abc import AsyncIterator, Callable
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from prometheus_client.parser import text_string_to_metric_families

from bikeped.config import WebConfig
from bikeped.telemetry.http import HttpServer, host_name, is_loopback, make_app
from bikeped.telemetry.metrics import Metrics


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
    async with (
        aiohttp.ClientSession() as session,
        session.get(url, headers=headers) as response,
    ):
        return response.status, response.headers["Content-Type"], await response.text()


async def test_metrics_are_prometheus_text(serve):
    metrics = Metrics()
    metrics.undecodable(3)
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
    ("host", "status"),
    [
        ("localhost:8080", 200),
        ("LOCALHOST", 200),
        ("127.0.0.1", 200),
        ("[::1]:8080", 200),
        ("pole.example", 200),
        ("evil.example", 403),
        ("127.0.0.1.evil.example", 403),
        ("localhost.evil.example:8080", 403),
        ("", 403),
    ],
)
async def test_a_loopback_server_answers_only_to_its_own_names(serve, host, status):
    app = make_app(Metrics().registry, lambda: {"state": "SAFE"}, allowed_hosts=("Pole.example",))
    base = await serve(app)
    for path in ("/healthz", "/metrics"):
        assert (await get(base + path, Host=host))[0] == status


async def test_a_server_for_others_answers_to_any_name(serve):
    app = make_app(Metrics().registry, lambda: {"state": "SAFE"}, host="0.0.0.0")
    base = await serve(app)
    assert (await get(f"{base}/healthz", Host="pole.example"))[0] == 200


async def test_large_bodies_are_refused(serve):
    async def echo(request: web.Request) -> web.Response:
        return web.Response(body=await request.read())

    app = make_app(Metrics().registry, dict, client_max_size=100)
    app.router.add_post("/echo", echo)
    base = await serve(app)
    async with aiohttp.ClientSession() as session:
        async with session.post(f"{base}/echo", data=b"x" * 100) as response:
            assert response.status == 200
        async with session.post(f"{base}/echo", data=b"x" * 101) as response:
            assert response.status == 413


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
