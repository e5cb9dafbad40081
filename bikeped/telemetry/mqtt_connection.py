"""One connection to the broker, with every wait bounded; its credentials and TLS.

paho's own thread and reconnect are not used: paho sends unacknowledged messages again after newer
ones, so that an old retained value would stay, and takes no renewed certificate. A connection here
is used once, and works only while it is called.
"""

from __future__ import annotations

import contextlib
import math
import ssl
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from paho.mqtt.client import Client, MQTTMessage, error_string
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode
from paho.mqtt.reasoncodes import ReasonCode

from bikeped.config.output_sections import MqttConfig
from bikeped.errors import TelemetryError

_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_TURN_S = 0.05  #: between two looks at `cancelled` during a wait
#: Of `mqtt.keepalive_s`, what the broker is asked to watch.
KEEPALIVE_SHARE = 0.6


class MqttMessage(NamedTuple):
    """A message with its full topic."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class BrokerRefusedError(OSError):
    """The broker answered, and does not accept this client; the message says why."""


class BrokerConnection:
    """A connection to the broker of `config`, for one thread.

    Every exchange may take `timeout_s`, and ends early once `cancelled` returns True. What ends a
    connection is raised as an OSError. The broker publishes `will` unless `goodbye` comes first.
    """

    def __init__(
        self,
        config: MqttConfig,
        credentials: Credentials,
        *,
        client_id: str,
        timeout_s: float,
        will: MqttMessage | None = None,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> None:
        self._config, self._timeout_s, self._cancelled = config, timeout_s, cancelled
        self._answers: list[ReasonCode] = []
        self._echoes: list[str] = []
        answers = self._answers  # without `self`: paho's sockets close without the collector
        self._client = client = Client(
            CallbackAPIVersion.VERSION2, client_id, reconnect_on_failure=False
        )
        client.connect_timeout = timeout_s
        client.on_connect = lambda _client, _data, _flags, reason, _: answers.append(reason)
        if credentials.username is not None:
            client.username_pw_set(credentials.username, credentials.password)
        if credentials.tls is not None:
            client.tls_set_context(credentials.tls)
        if will is not None:
            client.will_set(*will)

    def open(self) -> None:
        """Connects and waits until the broker has accepted the client."""
        # The broker gives a silent client up after 1.5 times this, and looks only now and then:
        # less on the wire, so that the will comes within 1.5 times the configured time.
        keepalive_s = max(1, math.floor(self._config.keepalive_s * KEEPALIVE_SHARE))
        self._client.connect(self._config.host, self._config.port, keepalive_s)
        self._wait(lambda: bool(self._answers), "CONNACK")

    def publish(self, message: MqttMessage) -> None:
        """Sends a message and waits: QoS 0 until it is written to the socket, QoS 1 until the
        broker has acknowledged it."""
        sent = self._client.publish(*message)
        _raise_for(sent.rc)
        self._wait(sent.is_published, "PUBACK" if message.qos else "to take data")

    def keep(self, message: MqttMessage) -> None:
        """Publishes a message, and again whenever another client publishes under its topic.

        `confirmed` once the broker has passed it on to us.
        """
        echoes = self._echoes

        def restore(client: Client, _data: Any, received: MQTTMessage) -> None:
            if received.payload == message.payload:
                echoes.append(received.topic)
            else:
                client.publish(*message)

        self.publish(message)
        self._client.message_callback_add(message.topic, restore)
        self._client.subscribe(message.topic, 1)

    @property
    def confirmed(self) -> bool:
        """Whether the broker has passed on a message of ours: it acknowledges those that its access
        rules forbid, too, and drops them."""
        return bool(self._echoes)

    def watch(self, topic: str, received: Callable[[bytes], None]) -> None:
        """Calls `received` with what is published under `topic` from now on."""

        def take(_client: Client, _data: Any, message: MQTTMessage) -> None:
            if not message.retain:
                received(bytes(message.payload))

        self._client.message_callback_add(topic, take)
        self._client.subscribe(topic, 0)

    def turn(self, wait_s: float = 0.0) -> None:
        """Receives and sends what is due; waits for it at most `wait_s`."""
        result = self._client.loop(wait_s)
        if self._answers and self._answers[0].is_failure:
            raise BrokerRefusedError(str(self._answers[0]))
        _raise_for(result)

    def goodbye(self, message: MqttMessage) -> None:
        """Publishes a last message and disconnects; the broker then keeps the will to itself."""
        self._client.message_callback_remove(message.topic)
        self.publish(message)
        self._client.disconnect()

    def close(self) -> None:
        """Closes the socket, whatever the broker does."""
        if (sock := self._client.socket()) is not None:
            sock.close()

    def _wait(self, done: Callable[[], bool], what: str) -> None:
        latest_s = time.monotonic() + self._timeout_s
        while not done():
            if self._cancelled():
                raise ConnectionAbortedError("the connection was given up")
            if time.monotonic() > latest_s:
                raise TimeoutError(f"timed out waiting for the broker ({what})")
            self.turn(_TURN_S)


def _raise_for(result: MQTTErrorCode) -> None:
    if result > 0:  # negative: to be tried again
        raise ConnectionResetError(error_string(result).rstrip("."))


@dataclass(frozen=True)
class Credentials:
    """User name, password and TLS context; None: without."""

    username: str | None
    password: str | None = field(repr=False)
    tls: ssl.SSLContext | None = None


def load_credentials(config: MqttConfig, base_dir: Path = Path()) -> Credentials:
    """Reads the files that `config` names; relative ones are relative to `base_dir`.

    Raises TelemetryError, naming file, key and remedy, when a file cannot be used or keys
    contradict one another: a certificate without `tls` would mean an unencrypted connection that
    its owner believes encrypted.
    """
    if config.password_file is not None and config.username is None:
        raise TelemetryError(
            "mqtt.password_file is set without mqtt.username: set mqtt.username, or remove it"
        )
    for key in ("ca_file", "cert_file", "key_file"):
        if getattr(config, key) is not None and not config.tls:
            raise TelemetryError(
                f"mqtt.{key} is set but mqtt.tls is false, so nothing would be encrypted: "
                f"set mqtt.tls: true, or remove mqtt.{key}"
            )
    if config.key_file is not None and config.cert_file is None:
        raise TelemetryError(
            "mqtt.key_file is set without mqtt.cert_file: set both, or remove mqtt.key_file"
        )
    password = tls = None
    if config.password_file is not None:
        path = base_dir / config.password_file
        remedy = "write the password as its first line, in UTF-8, and let the service read it"
        with _usable(path, "mqtt.password_file", remedy):
            password = path.read_text(encoding="utf-8").partition("\n")[0].rstrip("\r")
            if not password:
                raise ValueError("its first line is empty")
    if config.tls:
        ca_file = None if config.ca_file is None else base_dir / config.ca_file
        remedy = "give the PEM file of the authority that signed the broker's certificate"
        with _usable(ca_file, "mqtt.ca_file", remedy):
            tls = ssl.create_default_context(cafile=ca_file)
    if tls and config.cert_file is not None:
        cert_file = base_dir / config.cert_file
        key_file = None if config.key_file is None else base_dir / config.key_file
        files = f"{cert_file}, {key_file}" if key_file else cert_file
        remedy = "give PEM files of a client certificate and its unencrypted key"
        with _usable(files, "mqtt.cert_file and mqtt.key_file", remedy):
            # An encrypted key would otherwise make OpenSSL prompt on the terminal.
            tls.load_cert_chain(cert_file, key_file, password=lambda: "")
    return Credentials(config.username, password, tls)


@contextlib.contextmanager
def _usable(files: object, keys: str, remedy: str) -> Iterator[None]:
    """Turns the error of a file that cannot be used into a TelemetryError."""
    try:
        yield
    except (OSError, ValueError) as exc:  # an SSLError may have no strerror; some texts span lines
        reason = " ".join((getattr(exc, "strerror", None) or str(exc) or "unknown").split())
        raise TelemetryError(f"{files}: {keys} cannot be used ({reason}): {remedy}") from exc


def sends_password_in_clear(config: MqttConfig) -> bool:
    """Whether the password leaves this machine unencrypted."""
    return config.password_file is not None and not config.tls and config.host not in _LOOPBACK
