"""One connection to the broker: paho's threaded client, with every wait bounded;
its credentials and TLS.

paho's own reconnect is off: it has no jitter, starts its pauses anew at every CONNACK, does not say
why a connection failed, and cannot take a renewed certificate. A connection here is used once.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from bikeped.config.output_sections import MqttConfig
from bikeped.errors import TelemetryError

_LOOPBACK = ("localhost", "127.0.0.1", "::1")


class MqttMessage(NamedTuple):
    """A message with its full topic."""

    topic: str
    payload: bytes
    qos: int
    retain: bool


class BrokerRefusedError(OSError):
    """The broker answered, and does not accept this client; the message says why."""


class BrokerConnection:
    """A connection to the broker of `config`, for one thread but for `abort`.

    Every exchange may take `timeout_s`. What ends a connection is raised as an OSError by the call
    under way or the next one. `will` is published by the broker when the connection is lost;
    `on_lost` is called from paho's thread.
    """

    def __init__(
        self,
        config: MqttConfig,
        credentials: Credentials,
        *,
        client_id: str,
        timeout_s: float,
        will: MqttMessage | None = None,
        on_lost: Callable[[], None] = lambda: None,
    ) -> None:
        self._config, self._timeout_s, self._on_lost = config, timeout_s, on_lost
        self._changed = threading.Condition()  # guards the four below
        self._accepted = False
        self._published: set[int] = set()
        self._error: OSError | None = None
        self.lost = False  #: whether the connection has ended
        self._client = client = Client(
            CallbackAPIVersion.VERSION2, client_id, reconnect_on_failure=False
        )
        client.connect_timeout = timeout_s
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_publish = self._on_publish
        if credentials.username is not None:
            client.username_pw_set(credentials.username, credentials.password)
        if credentials.tls is not None:
            client.tls_set_context(credentials.tls)
        if will is not None:
            client.will_set(*will)

    def open(self) -> None:
        """Connects and waits until the broker has accepted the client. Raises OSError."""
        self._client.connect(self._config.host, self._config.port, self._config.keepalive_s)
        self._client.loop_start()
        self._wait(lambda: self._accepted, "CONNACK")

    def publish(self, message: MqttMessage) -> None:
        """Sends a message and waits: QoS 0 until it is written to the socket, QoS 1 until the
        broker has acknowledged it. Raises OSError."""
        mid = self._client.publish(*message).mid
        self._wait(lambda: mid in self._published, "PUBACK" if message.qos else "to take data")
        with self._changed:
            self._published.discard(mid)

    def close(self) -> None:
        """Says goodbye, so that the broker does not publish the will, and ends paho's thread."""
        self._client.disconnect()
        self._client.loop_stop()

    def abort(self) -> None:
        """Ends the connection now, whatever the broker does; callable from any thread."""
        self._end(ConnectionAbortedError("the connection was given up"))
        sock: Any = self._client.socket()
        if sock is not None:
            # Wakes paho's thread, which then closes the socket itself.
            with contextlib.suppress(OSError):
                socket.socket.shutdown(sock, socket.SHUT_RDWR)

    def _wait(self, done: Callable[[], bool], what: str) -> None:
        with self._changed:
            self._changed.wait_for(lambda: done() or self.lost, self._timeout_s)
            if self.lost:
                raise self._error or ConnectionResetError("the connection was closed")
            if not done():
                raise TimeoutError(f"timed out waiting for the broker ({what})")

    def _end(self, error: OSError) -> None:
        with self._changed:
            self._error = self._error or error
            self.lost = True
            self._changed.notify_all()
        self._on_lost()

    def _on_connect(self, _client: Client, _data: Any, _flags: Any, reason: Any, _: Any) -> None:
        with self._changed:
            if reason.is_failure:
                self._error = BrokerRefusedError(str(reason))
            else:
                self._accepted = True
            self._changed.notify_all()

    def _on_disconnect(self, _client: Client, _data: Any, _flags: Any, reason: Any, _: Any) -> None:
        said = str(reason)
        known = "" if said in ("Unspecified error", "Normal disconnection") else f" ({said})"
        self._end(ConnectionResetError(f"the connection was lost{known}"))

    def _on_publish(self, _client: Client, _data: Any, mid: int, _reason: Any, _: Any) -> None:
        with self._changed:
            self._published.add(mid)
            self._changed.notify_all()


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
    _check_keys(config)
    password = None
    if config.password_file is not None:
        password = _first_line(base_dir / config.password_file)
    return Credentials(config.username, password, _tls(config, base_dir) if config.tls else None)


def sends_password_in_clear(config: MqttConfig) -> bool:
    """Whether the password leaves this machine unencrypted."""
    return config.password_file is not None and not config.tls and config.host not in _LOOPBACK


def _check_keys(config: MqttConfig) -> None:
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


def _first_line(path: Path) -> str:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as exc:
        raise TelemetryError(
            f"{path}: mqtt.password_file cannot be read ({exc.strerror}): "
            "give a file that the service may read"
        ) from exc
    except UnicodeDecodeError as exc:
        raise TelemetryError(
            f"{path}: mqtt.password_file is not UTF-8 text: write the password as its first line"
        ) from exc
    password = text.partition("\n")[0].rstrip("\r")
    if not password:
        raise TelemetryError(
            f"{path}: mqtt.password_file has an empty first line: write the password there"
        )
    return password


def _tls(config: MqttConfig, base_dir: Path) -> ssl.SSLContext:
    ca_file = None if config.ca_file is None else base_dir / config.ca_file
    try:
        context = ssl.create_default_context(cafile=ca_file)
    except (OSError, ssl.SSLError) as exc:
        raise TelemetryError(
            f"{ca_file}: mqtt.ca_file cannot be used ({_reason(exc)}): "
            "give the PEM file of the authority that signed the broker's certificate"
        ) from exc
    if config.cert_file is not None:
        cert_file = base_dir / config.cert_file
        key_file = None if config.key_file is None else base_dir / config.key_file
        try:
            # An encrypted key would otherwise make OpenSSL prompt on the terminal.
            context.load_cert_chain(cert_file, key_file, password=lambda: "")
        except (OSError, ssl.SSLError) as exc:
            files = f"{cert_file}" if key_file is None else f"{cert_file}, {key_file}"
            raise TelemetryError(
                f"{files}: mqtt.cert_file and mqtt.key_file cannot be used ({_reason(exc)}): "
                "give PEM files of a client certificate and its unencrypted key"
            ) from exc
    return context


def _reason(exc: OSError) -> str:
    # An SSLError's strerror may be missing; some texts span lines.
    return " ".join((exc.strerror or str(exc) or type(exc).__name__).split())
