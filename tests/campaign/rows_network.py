"""Faults of the broker, its network and what comes from it: rows 32 to 36."""

from __future__ import annotations

import json
import socket
import subprocess
import threading
import time
from pathlib import Path

from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion
from small_crossing import Broker, free_port

from campaign.registry import Skip, row
from campaign.rig import WEB, Rig


class Listener:
    """Remembers what a broker sends, with times."""

    def __init__(self, rig: Rig, port: int, topic: str = "bikeped/#") -> None:
        self.received: list[tuple[float, str, bytes]] = []
        self.client = Client(CallbackAPIVersion.VERSION2)
        self.client.on_connect = lambda *_: self.client.subscribe(topic, qos=1)
        self.client.on_message = self._on_message
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()
        rig.callback(self.client.loop_stop)

    def _on_message(self, _client: Client, _data: object, message: MQTTMessage) -> None:
        self.received.append((time.monotonic(), message.topic, message.payload))

    def until(self, topic: str, payload: bytes | None, since_s: float, wait_s: float) -> float:
        """Seconds from `since_s` until a message of the topic's end comes; infinite if none."""
        while time.monotonic() - since_s < wait_s:
            for at_s, at_topic, at_payload in list(self.received):
                wanted = payload is None or payload == at_payload
                if wanted and at_s >= since_s and at_topic.endswith(topic):
                    return at_s - since_s
            time.sleep(0.02)
        return float("inf")


def mqtt_config(rig: Rig, port: int, more: str = "", name: str = "pole.yaml") -> Path:
    """A configuration that publishes to the broker at `port`; `more` are further lines of mqtt."""
    mqtt = f"  enabled: true\n  host: 127.0.0.1\n  port: {port}\n{more}"
    return rig.config(mqtt + WEB, name=name)


@row(
    32,
    "broker absent at the start, comes back after 20 s",
    "retried",
    "published <= 10 s",
    repeat=2,
)
def broker_absent(rig: Rig) -> None:
    for _ in rig.repetitions:
        broker = rig.broker()
        broker.kill()
        service = rig.start(mqtt_config(rig, broker.port))
        service.settle()
        time.sleep(20)
        broker.start()
        back_s = time.monotonic()
        listener = Listener(rig, broker.port)
        rig.measure("published", listener.until("/health", None, back_s, 60))
        rig.expect(rig.light.colour() in ("green", "blue"), "the light was affected")
        service.close()
        broker.kill()


@row(
    33,
    "the broker hangs: takes connections and answers nothing",
    "a bounded queue",
    "memory growth <= 10 MB; green or blue lost = 0 times",
)
def broker_hangs(rig: Rig) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        service = rig.start(mqtt_config(rig, server.getsockname()[1]))
        service.settle()
        time.sleep(5)
        before, began_s = _rss_mb(service.process.pid), time.monotonic()
        time.sleep(60)
        rig.measure("memory growth", _rss_mb(service.process.pid) - before)
        lost = rig.light.count(("orange", "off"), began_s, time.monotonic())
        rig.measure("green or blue lost", lost)
        rig.saw("for one minute; the queue is full after seconds")


def _rss_mb(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    return float("nan")


@row(
    34,
    "unclean disconnect: the service is killed, the connection stays open",
    "a retained `offline` by the will",
    "offline <= 22.5 s",
)
def unclean_disconnect(rig: Rig) -> None:
    keepalive_s = 15
    broker = rig.broker()
    proxy = HalfOpen(broker.port)
    rig.callback(proxy.close)
    listener = Listener(rig, broker.port)
    service = rig.start(mqtt_config(rig, proxy.port, f"  keepalive_s: {keepalive_s}\n"))
    service.settle()
    listener.until("/availability", b"online", 0.0, 10)
    proxy.hold()
    cut_s = time.monotonic()
    waited_s = listener.until("/availability", b"offline", cut_s, 60)
    rig.measure("offline", waited_s)


class HalfOpen:
    """Passes bytes to a broker until `hold`; then the connections stay open and nothing passes."""

    def __init__(self, target: int) -> None:
        self._target, self._held = target, threading.Event()
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self._open: list[socket.socket] = [self._server]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        try:
            while True:
                client, _ = self._server.accept()
                upstream = socket.create_connection(("127.0.0.1", self._target))
                self._open += [client, upstream]
                for pair in ((client, upstream), (upstream, client)):
                    threading.Thread(target=self._pump, args=pair, daemon=True).start()
        except OSError:
            return

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(4096):
                if not self._held.is_set():
                    sink.sendall(data)
        except OSError:
            return

    def hold(self) -> None:
        self._held.set()

    def close(self) -> None:
        for sock in self._open:
            sock.close()


@row(
    35,
    "another CA, an expired certificate, plaintext at a TLS port, access rules that forbid",
    "refused, no plaintext fallback",
    "bytes published = 0; reported = 4 cases",
)
def wrong_certificates(rig: Rig) -> None:
    folder, reported, published = rig.folder, 0, 0
    for name, days in (("good", "30"), ("other", "30")):
        _openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", days,
                 "-subj", "/CN=127.0.0.1", "-addext", "subjectAltName=IP:127.0.0.1",
                 "-keyout", folder / f"{name}.key", "-out", folder / f"{name}.pem")  # fmt: skip
    _openssl("req", "-new", "-key", folder / "good.key", "-subj", "/CN=127.0.0.1",
             "-out", folder / "late.csr")  # fmt: skip
    _openssl("x509", "-req", "-in", folder / "late.csr", "-signkey", folder / "good.key",
             "-days", "-1", "-out", folder / "late.pem")  # fmt: skip
    for ca, shown in (("other", "good"), ("late", "late"), ("good", "")):
        port = free_port()
        lines = (
            (f"certfile {folder}/{shown}.pem", f"keyfile {folder}/good.key", "allow_anonymous true")
            if shown
            else ("allow_anonymous true",)
        )
        broker: Broker = rig.broker(*lines)
        port = broker.port
        service = rig.start(mqtt_config(rig, port, f"  tls: true\n  ca_file: {folder}/{ca}.pem\n"))
        service.settle()
        time.sleep(4)
        said = [line for line in service.lines if "mqtt" in line]
        problem = any("trying again" in line for line in said)
        reported += problem
        rig.expect(problem, f"CA {ca}, server {shown or 'plain'}: not named in the log")
        log = (broker.directory / "mosquitto.log").read_text(errors="replace")
        published += log.count("Received PUBLISH") + log.count(" as bikeped")
        service.close()
        broker.kill()
    rules = folder / "rules.acl"
    rules.write_text("topic read #\ntopic write elsewhere/#\n")
    broker = rig.broker("allow_anonymous true", f"acl_file {rules}")
    listener = Listener(rig, broker.port)
    service = rig.start(mqtt_config(rig, broker.port, ""))
    service.settle()
    time.sleep(7)
    said = any("access rules" in line for line in service.lines)
    rig.expect(said, "access rules that forbid: not named in the log")
    reported += said
    published += len(listener.received)
    rig.measure("bytes published", published)
    rig.measure("reported", reported)


def _openssl(*arguments: object) -> None:
    try:
        subprocess.run(["openssl", *map(str, arguments)], check=True, capture_output=True)
    except FileNotFoundError as error:
        raise Skip("openssl is not installed") from error


@row(
    36,
    "1,000 forged and retained messages under the site's own topics",
    "ignored; a forged `offline` is corrected",
    "state changes = 0; corrected <= 5 s",
)
def forged(rig: Rig) -> None:
    broker = rig.broker()
    service = rig.start(mqtt_config(rig, broker.port, "  site: pole\n"))
    service.settle()
    listener = Listener(rig, broker.port)
    listener.until("/availability", b"online", 0.0, 10)
    began_s, sent = time.monotonic(), []
    for number in range(1000):
        topic = ("state", "command", "health", "set", "availability")[number % 5]
        payload = b"offline" if topic == "availability" else json.dumps({"state": "SAFE"}).encode()
        name = f"bikeped/pole/{topic}"
        sent.append(listener.client.publish(name, payload, 1, retain=number % 2 == 0))
    for info in sent:
        info.wait_for_publish(20)
    sent_s = time.monotonic()
    corrected_s = listener.until("/availability", b"online", sent_s, 10)
    fresh = Listener(rig, broker.port)  # gets what is retained
    retained_s = fresh.until("/availability", b"online", sent_s, 10)
    rig.measure("corrected", min(corrected_s, max(retained_s, 0.0)))
    changes = rig.light.count(("red", "orange", "off"), began_s, time.monotonic())
    rig.measure("state changes", changes)
