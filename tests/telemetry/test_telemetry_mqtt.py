"""The publisher against a real broker, which dies, hangs, refuses and comes back."""

from __future__ import annotations

import asyncio
import json
import logging
import random
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.publish import single

from bikeped.config.output_sections import MqttConfig
from bikeped.telemetry.mqtt import MqttPublisher

FAST = (0.01, 0.05)  # seconds between attempts, so that tests do not wait
DEADLINE_S = 30.0


def config(port: int, site: str, **keys: Any) -> MqttConfig:
    return MqttConfig(enabled=True, host="127.0.0.1", port=port, site=site, **keys)


def publisher(settings: MqttConfig, **options: Any) -> MqttPublisher:
    return MqttPublisher(settings, backoff_s=FAST, rng=random.Random(1), **options)


async def connected(mqtt: MqttPublisher) -> None:
    await until(lambda: mqtt.status.connected)


async def stop(mqtt: MqttPublisher) -> None:
    await asyncio.to_thread(mqtt.stop)


async def until(condition: Callable[[], bool]) -> None:
    """Polls what has no event to await; fails after the deadline."""

    async def poll() -> None:
        while not condition():  # noqa: ASYNC110  # the status is a value, not an event
            await asyncio.sleep(0.005)

    await asyncio.wait_for(poll(), DEADLINE_S)


async def test_every_topic_arrives_and_only_the_right_ones_are_retained(broker, listen):
    mqtt = publisher(config(broker.port, "topics"))
    mqtt.start()
    await connected(mqtt)
    async with listen(broker.port, "bikeped/topics/#") as live:
        await live.until(lambda got: len(got) == 1)  # the retained online
        mqtt.publish("state", b"S", retain=True, qos=1)
        mqtt.publish("health", b"H", retain=True, qos=1)
        mqtt.publish("tracks", b"T")
        await live.until(lambda got: len(got) == 4)
    assert {(topic.rpartition("/")[2], payload) for topic, payload, _ in live.received} == {
        ("availability", b"online"),
        ("state", b"S"),
        ("health", b"H"),
        ("tracks", b"T"),
    }
    async with listen(broker.port, "bikeped/topics/#") as late:
        await late.until(lambda got: len(got) == 3)
        # Whatever was retained comes with the subscription, so before this live one.
        mqtt.publish("tracks", b"T2")
        await late.until(lambda got: len(got) == 4)
    retained = {topic.rpartition("/")[2]: flag for topic, _, flag in late.received}
    assert retained == {"availability": True, "state": True, "health": True, "tracks": False}
    assert late.payloads("tracks") == [b"T2"]
    await stop(mqtt)
    assert mqtt.status.published == 4
    assert mqtt.status.dropped == 0


async def test_stop_leaves_offline_and_the_last_state(broker, listen):
    mqtt = publisher(config(broker.port, "goodbye"))
    mqtt.start()
    await connected(mqtt)
    mqtt.publish("state", b"OFF", retain=True, qos=1)
    await stop(mqtt)
    assert not mqtt.status.connected
    async with listen(broker.port, "bikeped/goodbye/#") as late:
        await late.until(lambda got: len(got) == 2)
    assert late.payloads("availability") == [b"offline"]
    assert late.payloads("state") == [b"OFF"]
    await stop(mqtt)  # again is harmless


async def test_the_will_says_offline_when_the_client_is_cut_off(broker, listen, make_proxy):
    proxy = make_proxy(broker.port)
    await proxy.start()
    mqtt = publisher(config(proxy.port, "cut"))
    async with listen(broker.port, "bikeped/cut/availability") as live:
        mqtt.start()
        await live.until(lambda got: len(got) == 1)
        proxy.abort_broker_side()
        await live.until(lambda got: len(got) >= 2)
        proxy.abort_clients()
        await live.until(lambda got: len(got) >= 3)
    assert live.payloads("availability") == [b"online", b"offline", b"online"]
    await stop(mqtt)


async def test_the_will_says_offline_when_the_process_is_killed(broker, listen):
    program = (
        "import sys, threading\n"
        "from bikeped.config.schema import MqttConfig\n"
        "from bikeped.telemetry.mqtt import MqttPublisher\n"
        "mqtt = MqttPublisher(MqttConfig(port=int(sys.argv[1]), site='killed'))\n"
        "mqtt.start()\n"
        "threading.Event().wait()\n"
    )
    async with listen(broker.port, "bikeped/killed/availability") as live:
        child = await asyncio.create_subprocess_exec(
            sys.executable, "-c", program, str(broker.port)
        )
        try:
            await live.until(lambda got: len(got) == 1)
        finally:
            child.kill()
            await child.wait()
        await live.until(lambda got: len(got) == 2)
    assert live.payloads("availability") == [b"online", b"offline"]


async def test_a_half_open_connection_of_before_does_not_say_offline_later(
    broker, listen, make_proxy
):
    proxy = make_proxy(broker.port)
    await proxy.start()
    mqtt = publisher(config(proxy.port, "halfopen"))
    async with listen(broker.port, "bikeped/halfopen/availability") as live:
        mqtt.start()
        await live.until(lambda got: len(got) == 1)
        proxy.abort_clients()  # the broker does not notice: its side stays open
        await live.until(lambda got: len(got) == 3)
    # The will came when the new connection was made, so it cannot come after it.
    assert live.payloads("availability") == [b"online", b"offline", b"online"]
    await stop(mqtt)


async def test_messages_arrive_again_after_the_broker_was_killed(make_broker, listen):
    broker = make_broker()
    mqtt = publisher(config(broker.port, "restart"))
    mqtt.start()
    mqtt.publish("state", b"SAFE", retain=True, qos=1)
    await connected(mqtt)
    broker.kill()
    await until(lambda: not mqtt.status.connected)
    for number in range(1000):  # nothing is awaited: nothing can be waited for
        mqtt.publish("tracks", b"%d" % number)
    assert mqtt.status.queued == 64
    assert mqtt.status.dropped >= 1000 - 64
    mqtt.publish("health", b"H", retain=True, qos=1)
    broker.start()
    async with listen(broker.port, "bikeped/restart/#") as live:
        await connected(mqtt)
        # The broker has forgotten everything, so what is retained must have been sent again.
        mqtt.publish("tracks", b"after")
        await live.until(
            lambda got: (
                {topic.rpartition("/")[2] for topic, _, _ in got} >= {"state", "health"}
                and (got[-1][1] == b"after")
            )
        )
    assert live.payloads("state")[-1] == b"SAFE"
    assert live.payloads("health")[-1] == b"H"
    assert mqtt.status.connects == 2
    assert mqtt.status.error is None
    await stop(mqtt)


async def test_a_broker_that_hangs_costs_messages_not_time(broker, listen, make_proxy):
    proxy = make_proxy(broker.port)
    await proxy.start()
    mqtt = publisher(config(proxy.port, "hang"), io_timeout_s=0.2, stop_timeout_s=0.2)
    mqtt.start()
    await connected(mqtt)
    proxy.flowing.clear()
    mqtt.publish("state", b"ALERT", retain=True, qos=1)  # is never acknowledged
    await until(lambda: not mqtt.status.connected)
    assert "timed out" in (mqtt.status.error or "")
    for number in range(1000):
        mqtt.publish("tracks", b"%d" % number)
    assert mqtt.status.queued <= 64
    proxy.flowing.set()
    async with listen(broker.port, "bikeped/hang/state") as live:
        await live.until(lambda got: len(got) >= 1)
    assert set(live.payloads("state")) == {b"ALERT"}
    await stop(mqtt)


async def test_a_server_that_never_answers_is_given_up_without_leaking_sockets():
    """Accepts connections and says nothing: as a firewall or a broker in trouble does."""
    taken: list[asyncio.StreamWriter] = []
    closed = 0

    async def swallow(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal closed
        taken.append(writer)
        await reader.read()  # until the client closes
        closed += 1
        writer.close()

    server = await asyncio.start_server(swallow, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    mqtt = publisher(config(port, "silent", keepalive_s=3600), io_timeout_s=0.05)
    mqtt.start()
    await until(lambda: closed >= 3)  # three attempts, all of them closed by us
    assert "timed out" in (mqtt.status.error or "")
    assert mqtt.status.connects == 0
    await stop(mqtt)
    await until(lambda: closed == len(taken))
    server.close()
    await server.wait_closed()


async def test_stop_is_bounded_when_the_broker_hangs(broker, make_proxy):
    proxy = make_proxy(broker.port)
    await proxy.start()
    mqtt = publisher(config(proxy.port, "stuck"), io_timeout_s=3600, stop_timeout_s=0.1)
    mqtt.start()
    await connected(mqtt)
    proxy.flowing.clear()
    await asyncio.wait_for(stop(mqtt), DEADLINE_S)
    assert not mqtt.status.connected
    proxy.flowing.set()


async def test_stop_ends_an_attempt_that_hangs_at_once_and_closes_its_socket():
    accepted, closed = asyncio.Event(), asyncio.Event()

    async def swallow(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        accepted.set()
        await reader.read()  # until the client closes
        closed.set()
        writer.close()

    server = await asyncio.start_server(swallow, "127.0.0.1", 0)
    mqtt = publisher(
        config(server.sockets[0].getsockname()[1], "hanging", keepalive_s=3600), io_timeout_s=3600
    )
    mqtt.start()
    await asyncio.wait_for(accepted.wait(), DEADLINE_S)
    await asyncio.wait_for(stop(mqtt), DEADLINE_S)
    await asyncio.wait_for(closed.wait(), DEADLINE_S)
    assert mqtt.status.connects == 0
    assert mqtt.status.error is None  # to be stopped is no failure
    server.close()
    await server.wait_closed()


async def test_a_clean_goodbye_publishes_offline_once(broker, listen):
    mqtt = publisher(config(broker.port, "once"))
    async with listen(broker.port, "bikeped/once/availability") as live:
        mqtt.start()
        await live.until(lambda got: len(got) == 1)
        await stop(mqtt)
        # A will would come when the broker sees the connection end; a later client shows that.
        later = publisher(config(broker.port, "once"))
        later.start()
        await live.until(lambda got: got[-1][1] == b"online" and len(got) > 2)
        await stop(later)
    assert live.payloads("availability")[:3] == [b"online", b"offline", b"online"]


async def test_a_forged_offline_is_corrected_but_our_own_stays(broker, listen):
    mqtt = publisher(config(broker.port, "forgery"))
    mqtt.start()
    await connected(mqtt)
    topic = "bikeped/forgery/availability"
    async with listen(broker.port, topic) as live:
        await live.until(lambda got: len(got) == 1)
        await asyncio.to_thread(
            single, topic, b"offline", 1, True, hostname="127.0.0.1", port=broker.port
        )
        await live.until(lambda got: len(got) == 3)
        assert live.payloads("availability") == [b"online", b"offline", b"online"]
        await stop(mqtt)
        await live.until(lambda got: len(got) == 4)
    async with listen(broker.port, topic) as late:
        await late.until(lambda got: len(got) == 1)
    assert late.received == [(topic, b"offline", True)]


def test_a_broker_that_returns_is_tried_within_ten_seconds():
    mqtt = MqttPublisher(config(1, "returns"))
    longest_s = max(mqtt._pause_s(attempt) for attempt in range(1000))
    assert mqtt._io_timeout_s + longest_s < 10.0  # an attempt that just fails, and its pause


async def test_an_absent_broker_is_logged_once_and_tried_again(caplog, make_broker):
    with socket.socket() as taken:  # bound, not listening: connections are refused
        taken.bind(("127.0.0.1", 0))
        attempts = 0

        class Counting(random.Random):
            def uniform(self, a: float, b: float) -> float:
                nonlocal attempts
                attempts += 1
                return super().uniform(a, b)

        mqtt = MqttPublisher(
            config(taken.getsockname()[1], "absent"), backoff_s=FAST, rng=Counting(1)
        )
        with caplog.at_level(logging.INFO):
            mqtt.start()
            await until(lambda: attempts >= 4)
        await stop(mqtt)
    warnings = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 1
    assert "mqtt.host" in warnings[0].getMessage()
    assert "refused" in (mqtt.status.error or "").lower()


async def test_publishing_before_start_and_without_a_loop_to_wait_on_drops_the_oldest():
    mqtt = publisher(config(1, "full"), queue_size=3)
    for number in range(5):
        mqtt.publish("tracks", b"%d" % number)
    mqtt.publish("state", b"SAFE", retain=True)
    mqtt.publish("state", b"ALERT", retain=True)
    status = mqtt.status
    assert (status.queued, status.dropped, status.superseded) == (3, 2, 1)
    assert not status.connected
    assert status.error is None


async def test_what_waited_is_sent_newest_values_first_then_the_queue_in_order(broker, listen):
    mqtt = publisher(config(broker.port, "waiting"), queue_size=3)
    for number in range(5):
        mqtt.publish("tracks", b"%d" % number)
    mqtt.publish("state", b"SAFE", retain=True)
    mqtt.publish("state", b"ALERT", retain=True)
    async with listen(broker.port, "bikeped/waiting/#") as live:
        mqtt.start()
        await live.until(lambda got: len(got) == 5)
    assert [payload for _, payload, _ in live.received] == [b"ALERT", b"online", b"2", b"3", b"4"]
    await stop(mqtt)


def test_the_pause_doubles_to_its_cap_with_jitter():
    mqtt = MqttPublisher(config(1, "pause"), backoff_s=(1.0, 60.0), rng=random.Random(7))
    pauses = [mqtt._pause_s(attempt) for attempt in range(2000)]
    for attempt, pause in enumerate(pauses):
        full = min(60.0, 2.0 ** min(attempt, 30))
        assert full / 2 <= pause <= full
    assert len(set(pauses[10:])) > 1000  # jitter at the cap, too
    again = MqttPublisher(config(1, "pause"), backoff_s=(1.0, 60.0), rng=random.Random(7))
    assert [again._pause_s(attempt) for attempt in range(2000)] == pauses


def make_account(directory: Path, name: str, password: str) -> Path:
    program = shutil.which("mosquitto_passwd")
    if program is None:
        pytest.skip("mosquitto_passwd is not installed")
    path = directory / "accounts"
    subprocess.run([program, "-c", "-b", path, name, password], check=True)
    return path


async def test_a_broker_that_wants_a_password(make_broker, listen, tmp_path):
    accounts = make_account(tmp_path, "pole", "right")
    broker = make_broker("allow_anonymous false", f"password_file {accounts}")
    secret = tmp_path / "secret"
    secret.write_text("wrong\n")
    mqtt = publisher(
        config(broker.port, "secret", username="pole", password_file="secret"), base_dir=tmp_path
    )
    mqtt.start()
    await until(lambda: mqtt.status.error is not None)
    assert "mqtt.password_file" in (mqtt.status.error or "")
    assert mqtt.status.connects == 0
    secret.write_text("right\n")  # corrected while running: taken up by the next attempt
    await connected(mqtt)
    async with listen(
        broker.port, "bikeped/secret/availability", username="pole", password="right"
    ) as live:
        await live.until(lambda got: len(got) == 1)
    assert live.payloads("availability") == [b"online"]
    await stop(mqtt)


def openssl(*arguments: str | Path) -> None:
    program = shutil.which("openssl")
    if program is None:
        pytest.skip("openssl is not installed")
    subprocess.run([program, *arguments], check=True, capture_output=True)


def make_certificates(directory: Path) -> None:
    """ca.crt, and server and client certificates signed by it."""
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"),
        *("-keyout", directory / "ca.key", "-out", directory / "ca.crt"),
        *("-days", "2", "-subj", "/CN=test authority"),
    )
    extensions = directory / "extensions"
    extensions.write_text("subjectAltName=IP:127.0.0.1\n")
    for name in ("server", "client"):
        openssl(
            *("req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"),
            *("-keyout", directory / f"{name}.key", "-out", directory / f"{name}.csr"),
            *("-subj", f"/CN={name}"),
        )
        openssl(
            *("x509", "-req", "-in", directory / f"{name}.csr", "-CA", directory / "ca.crt"),
            *("-CAkey", directory / "ca.key", "-CAcreateserial", "-days", "2"),
            *("-extfile", extensions, "-out", directory / f"{name}.crt"),
        )


async def test_tls_with_a_client_certificate(make_broker, listen, tmp_path):
    make_certificates(tmp_path)
    broker = make_broker(
        "allow_anonymous true",
        f"cafile {tmp_path}/ca.crt",
        f"certfile {tmp_path}/server.crt",
        f"keyfile {tmp_path}/server.key",
        "require_certificate true",
    )
    settings = config(
        broker.port,
        "tls",
        tls=True,
        ca_file="ca.crt",
        cert_file="client.crt",
        key_file="client.key",
    )
    mqtt = publisher(settings, base_dir=tmp_path)
    mqtt.start()
    await connected(mqtt)
    mqtt.publish("state", b"x" * 200_000, retain=True, qos=1)  # more than one TLS record
    await until(lambda: mqtt.status.published == 1)
    await stop(mqtt)


# paho leaves a socket whose handshake failed to the garbage collector, which closes it.
@pytest.mark.filterwarnings("ignore:unclosed <ssl.SSLSocket:ResourceWarning")
async def test_a_broker_that_an_unknown_authority_signed_is_refused(make_broker, tmp_path):
    make_certificates(tmp_path)
    broker = make_broker(
        "allow_anonymous true", f"certfile {tmp_path}/server.crt", f"keyfile {tmp_path}/server.key"
    )
    other = tmp_path / "other"
    other.mkdir()
    make_certificates(other)
    mqtt = publisher(config(broker.port, "forged", tls=True, ca_file="ca.crt"), base_dir=other)
    mqtt.start()
    await until(lambda: mqtt.status.error is not None)
    assert "certificate verify failed" in (mqtt.status.error or "")
    assert "mqtt.ca_file" in (mqtt.status.error or "")
    assert mqtt.status.connects == 0
    await stop(mqtt)


async def test_home_assistant_entities_are_announced_retained_only_when_asked(broker, listen):
    prefix = "ha-test"
    quiet = publisher(config(broker.port, "quiet", discovery_prefix=prefix))
    quiet.start()
    await connected(quiet)
    await stop(quiet)
    mqtt = publisher(
        config(broker.port, "north", home_assistant=True, discovery_prefix=prefix), version="9.9"
    )
    mqtt.start()
    await connected(mqtt)
    async with listen(broker.port, f"{prefix}/#") as late:
        await late.until(lambda got: len(got) == 5)
    await stop(mqtt)
    assert all(retained for _, _, retained in late.received)
    assert all("north" in topic for topic, _, _ in late.received)
    assert {json.loads(payload)["device"]["sw_version"] for _, payload, _ in late.received} == {
        "9.9"
    }


async def test_an_unforeseen_error_in_the_library_does_not_end_the_task(broker, monkeypatch):
    mqtt = publisher(config(broker.port, "bug"))
    session = mqtt._session
    calls = 0

    def broken() -> None:
        nonlocal calls
        calls += 1
        if calls < 3:
            raise RuntimeError("a bug")
        session()

    monkeypatch.setattr(mqtt, "_session", broken)
    mqtt.start()
    await connected(mqtt)
    assert calls == 3
    await stop(mqtt)
