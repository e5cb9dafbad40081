"""Faults that come over HTTP: rows 41 to 43."""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
import time
from urllib.parse import urlsplit

from campaign.registry import row
from campaign.rig import Rig, Running

MINUTE_S = 20.0


def _ask(
    service: Running, path: str, method: str = "GET", body: object = None, **headers: str
) -> tuple[int, bytes]:
    place = urlsplit(service.address)
    connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=20)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    with contextlib.closing(connection):
        connection.request(method, path, body=body, headers=named)  # type: ignore[arg-type]
        answer = connection.getresponse()
        return answer.status, answer.read(100_000)


@row(41, "a foreign Host, Origin or rebinding, for every page and WebSocket", "403", "let in = 0")
def foreign(rig: Rig) -> None:
    service = rig.start()
    service.until_said("serving http")
    port, let_in = urlsplit(service.address).port, 0
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec_WebSocket_Version": "13",
               "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ=="}  # fmt: skip
    for path in ("/", "/healthz", "/metrics", "/align", "/live", "/api/live", "/ws"):
        for headers in (
            {"Host": "evil.example"},
            {"Host": f"evil.example:{port}"},
            {"Host": f"127.0.0.1.evil.example:{port}"},
            {"Origin": "http://evil.example"},
            {"Origin": "null"},
            {"Origin": f"http://127.0.0.1:{(port or 0) + 1}"},
            {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors"},
        ):
            for more in ({}, upgrade):
                status, _ = _ask(service, path, **headers, **more)
                if status != 403:
                    let_in += 1
                    rig.expect(False, f"{path} with {headers}{' upgrade' * bool(more)}: {status}")
    rig.measure("let in", let_in)


@row(
    42,
    "path traversal, a script as a name, bodies of 100 MB with and without a length",
    "refused, escaped; 413",
    "leaks = 0; not 413 = 0; decision p99 later by <= 1 ms",
)
def hostile_requests(rig: Rig) -> None:
    secret = rig.folder / "secret.txt"
    secret.write_text("do-not-show")
    service = rig.start()
    service.settle()
    time.sleep(30)  # of which the service's percentiles are
    before_ms = _decision_p99_ms(service)
    leaks = 0
    for path in ("/../secret.txt", "/static/../secret.txt", "/static/%2e%2e/secret.txt",
                 "/static/..%2f..%2fsecret.txt", f"/static/{secret}", "/static//etc/passwd",
                 "/%2e%2e/%2e%2e/etc/passwd", "/<script>alert(1)</script>",
                 "/login?next=<script>alert(1)</script>"):  # fmt: skip
        status, body = _ask(service, path)
        bad = any(text in body for text in (b"do-not-show", b"root:", b"<script>alert"))
        leaks += bad
        rig.expect(not bad, f"{path}: {status} leaks")
    rig.measure("leaks", leaks)
    wrong, began_s = 0, time.monotonic()
    while time.monotonic() - began_s < 30:
        for path in ("/login", "/nope", "/", "/session"):
            for chunked in (False, True):
                status = _large(service, path, chunked)
                wrong += status != 413
                rig.expect(status == 413, f"{path}, {'chunked' if chunked else 'length'}: {status}")
    rig.measure("not 413", wrong)
    rig.measure("decision p99 later by", _decision_p99_ms(service) - before_ms)
    rig.expect(rig.light.colour() in ("green", "blue"), "the light was affected")


def _decision_p99_ms(service: Running) -> float:
    """Tracking, decision and light of the last 900 frames."""
    latency = service.health()[1]["latency_ms"]
    return float(sum(latency[stage]["p99"] for stage in ("track", "decide", "feedback")))


def _large(service: Running, path: str, chunked: bool) -> int:
    """Status of a POST of 100 MB; 0 where the connection ended without one."""
    place = urlsplit(service.address)
    with socket.create_connection((str(place.hostname), place.port), 20) as sock:
        head = f"POST {path} HTTP/1.1\r\nHost: {place.netloc}\r\n"
        length = "Transfer-Encoding: chunked" if chunked else f"Content-Length: {100 << 20}"
        sock.sendall(f"{head}{length}\r\n\r\n".encode())
        block = bytes(65536)
        part = b"10000\r\n" + block + b"\r\n" if chunked else block
        with contextlib.suppress(OSError):
            sock.settimeout(5)
            for _ in range(1600):
                sock.sendall(part)
                sock.setblocking(False)
                with contextlib.suppress(BlockingIOError):
                    if answer := sock.recv(64):
                        return int(answer.split()[1])
                sock.settimeout(5)
        with contextlib.suppress(OSError, IndexError, ValueError):
            return int(sock.recv(64).split()[1])
    return 0


@row(
    43,
    "200 idle sockets, clients that read slowly, one that asks for /metrics all the time",
    "capped; no frame is missed",
    "green or blue lost = 0 times",
)
def slow_clients(rig: Rig) -> None:
    service = rig.start()
    service.settle()
    place = urlsplit(service.address)
    began_s, ends = time.monotonic(), threading.Event()
    with contextlib.ExitStack() as stack:
        for number in range(200):
            with contextlib.suppress(OSError):
                sock = socket.create_connection((str(place.hostname), place.port), 5)
                stack.enter_context(sock)
                if number % 4 == 0:
                    sock.sendall(f"GET /metrics HTTP/1.1\r\nHost: {place.netloc}\r\n".encode())

        def scrape() -> None:
            while not ends.is_set():
                with contextlib.suppress(OSError, http.client.HTTPException):
                    _ask(service, "/metrics")

        threads = [threading.Thread(target=scrape, daemon=True) for _ in range(2)]
        for thread in threads:
            thread.start()
        time.sleep(MINUTE_S / 2)
    time.sleep(MINUTE_S)  # without the idle ones, which take every place
    ends.set()
    lost = rig.light.count(("orange", "off"), began_s, time.monotonic())
    rig.measure("green or blue lost", lost)
    if lost:
        rig.saw(next((line for line in service.lines if "no frame" in line), ""))
