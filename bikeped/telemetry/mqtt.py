"""Publishes to the broker without ever making the caller wait for it.

`publish` only puts a message into a queue; a thread connects, sends, and connects again. Of what is
retained the newest value of each topic is kept, and sent again after every connection; the rest
waits in a bounded queue that drops its oldest. A broker that is absent, slow or hangs costs
messages, never time.
"""

from __future__ import annotations

import contextlib
import logging
import math
import random
import secrets
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from bikeped import __version__
from bikeped.config.output_sections import MqttConfig
from bikeped.errors import TelemetryError
from bikeped.faults import Fault
from bikeped.telemetry.homeassistant import discovery_messages
from bikeped.telemetry.mqtt_connection import (
    BrokerConnection,
    BrokerRefusedError,
    MqttMessage,
    load_credentials,
    sends_password_in_clear,
)

log = logging.getLogger(__name__)

OTHER_SITE_S = 60.0  #: so long after its last health another service of one name is named
TURN_S = 0.1  #: longest time between two looks at what the broker sends


class _Instance(msgspec.Struct):
    """What of a health message tells who wrote it."""

    instance: str


_decode_instance = msgspec.json.Decoder(_Instance).decode


@dataclass
class MqttStatus:
    """State of the publisher; the counts are totals since it was made."""

    connected: bool = False
    error: str | None = None  #: why it is not connected; None while it is, or before it tried
    connects: int = 0
    published: int = 0
    dropped: int = 0  #: messages that never reached the broker, queue overflow included
    superseded: int = 0  #: retained values replaced by a newer one before they could be sent
    queued: int = 0


class MqttPublisher:
    """Publishes `bikeped/<site>/...` from a daemon thread; `publish` and `status` never block.

    `queue_size` bounds the messages that wait (not retained ones); `backoff_s` are the first and
    the longest pause between two attempts, shortened by a jitter from `rng`; `io_timeout_s` is how
    long one exchange with the broker may take before the connection is given up, so a broker that
    returns gets its first message within 10 s;
    `stop_timeout_s` bounds `stop`. Files in `config` are relative to `base_dir`.

    Raises TelemetryError when a file that `config` names cannot be used.
    """

    def __init__(
        self,
        config: MqttConfig,
        *,
        base_dir: Path = Path(),
        version: str = __version__,
        queue_size: int = 64,
        backoff_s: tuple[float, float] = (1.0, 4.0),
        io_timeout_s: float = 5.0,
        stop_timeout_s: float = 2.0,
        rng: random.Random | None = None,
    ) -> None:
        self.config = config
        self._base_dir = base_dir
        self._credentials = load_credentials(config, base_dir)
        if sends_password_in_clear(config):
            log.warning("mqtt: the password goes to %s unencrypted: set mqtt.tls", config.host)
        self._topic = f"bikeped/{config.site}/"
        #: In the client's name and in health: tells two services of one site's name apart.
        self.instance = secrets.token_hex(4)
        self._discovery = discovery_messages(config, version) if config.home_assistant else {}
        self._backoff_s = backoff_s
        self._io_timeout_s = io_timeout_s
        self._stop_timeout_s = stop_timeout_s
        self._rng = rng or random.Random()
        self._thread: threading.Thread | None = None

        self._changed = threading.Condition()  # guards all below
        self._queue: deque[MqttMessage] = deque()
        self._queue_size = queue_size
        self._retained: dict[str, MqttMessage] = {}  #: newest value by topic
        self._unsent: dict[str, None] = {}  #: topics of `_retained` to send, in order
        self._status = MqttStatus()
        self._stopping = False
        self._open = False  #: a connection stands, whether or not messages are confirmed
        self._other_s = -math.inf  #: when another service of this site's name was last heard
        self._stop_by_s = math.inf  #: when a wait for the broker ends that `stop` interrupts

    @property
    def status(self) -> MqttStatus:
        """The publisher's present state."""
        with self._changed:
            return replace(self._status, queued=len(self._queue))

    def publish(
        self, topic_suffix: str, payload: bytes, *, retain: bool = False, qos: int | None = None
    ) -> None:
        """Queues a message for `bikeped/<site>/<topic_suffix>`; returns at once.

        Retained messages replace the waiting one of their topic; others join the queue, whose
        oldest is dropped and counted when it is full. `qos` None: the configuration's for what is
        retained, 0 for the rest.
        """
        if qos is None:
            qos = self.config.qos if retain else 0
        message = MqttMessage(self._topic + topic_suffix, payload, qos, retain)
        with self._changed:
            if retain:
                if message.topic in self._unsent:
                    self._status.superseded += 1
                self._retained[message.topic] = message
                self._unsent[message.topic] = None
            else:
                if len(self._queue) >= self._queue_size:
                    self._queue.popleft()
                    self._status.dropped += 1
                self._queue.append(message)
            self._changed.notify_all()

    def start(self) -> None:
        """Starts the thread; returns before anything is connected."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="mqtt", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Sends the retained values and `offline`, and disconnects; at most `stop_timeout_s`."""
        if self._thread is None:
            return
        with self._changed:
            self._stopping = True
            wait_s = self._stop_timeout_s if self._open else 0.0
            self._stop_by_s = time.monotonic() + wait_s
            self._changed.notify_all()
        self._thread.join(wait_s)
        with self._changed:
            self._status.connected = False

    def _run(self) -> None:
        """Connects for ever, until stopped. Its errors are in `status`, never raised."""
        attempt = 0
        while not self._stopping:
            began_s = time.monotonic()
            try:
                self._session()
            except OSError as exc:
                self._set_failure(self._explain(exc))
            except Exception as exc:  # noqa: BLE001
                # A bug in a library that one odd broker provokes must not end telemetry for months.
                self._set_failure(f"unexpected {type(exc).__name__}: {exc}")
            # A connection that is lost at once (two poles with one site's name, a broker that
            # rejects a topic) is a failure too: only one that lasts resets the pause.
            attempt = 0 if time.monotonic() - began_s >= self._backoff_s[1] else attempt
            pause_s = self._pause_s(attempt)
            attempt += 1
            with self._changed:
                self._changed.wait_for(lambda: self._stopping, pause_s)

    def _pause_s(self, attempt: int) -> float:
        """Doubles from the first pause to the longest; jitter keeps poles from acting as one."""
        first_s, longest_s = self._backoff_s
        return min(longest_s, first_s * 2.0 ** min(attempt, 30)) * self._rng.uniform(0.5, 1.0)

    def _session(self) -> None:
        """One connection, from its attempt until it is lost (raises) or the publisher stops."""
        with contextlib.suppress(TelemetryError):  # an unusable file leaves the old credentials
            self._credentials = load_credentials(self.config, self._base_dir)
        connection = BrokerConnection(
            self.config,
            self._credentials,
            # One name a process makes the broker end its half-open older connection (and publish
            # the will) before it accepts this one. Another service of this site's name has another:
            # two that throw each other off would both be lost.
            client_id=f"bikeped-{self.config.site}-{self.instance}",
            timeout_s=self._io_timeout_s,
            will=self._availability(b"offline"),
            cancelled=lambda: time.monotonic() >= self._stop_by_s,
        )
        try:
            with contextlib.closing(connection):
                connection.open()
                self._send(connection)
        finally:
            self._open = False

    def _send(self, connection: BrokerConnection) -> None:
        """Sends what waits, as it comes, until stopped; then says goodbye."""
        for topic, payload in self._discovery.items():
            connection.publish(MqttMessage(topic, payload, 1, True))
        with self._changed:
            self._unsent = dict.fromkeys(self._retained)
        self._send_retained(connection)
        # Only now: who reads `online` finds values of this connection, not of an earlier one.
        connection.keep(self._availability(b"online"))
        connection.watch(self._topic + "health", self._on_health)
        self._open, confirm_by_s = True, time.monotonic() + self._io_timeout_s
        while not self._stopping:
            connection.turn()
            if not self._status.connected:
                self._confirm(connection, confirm_by_s)
            self._send_retained(connection)  # a change of state never waits behind tracks
            with self._changed:
                self._changed.wait_for(self._has_work, TURN_S)
                message = self._queue.popleft() if self._queue and not self._unsent else None
            if message is not None:
                self._send_one(connection, message)
        self._send_retained(connection)
        connection.goodbye(self._availability(b"offline"))

    def _confirm(self, connection: BrokerConnection, latest_s: float) -> None:
        """Connected is what the broker passes on to us: access rules drop messages in silence."""
        if connection.confirmed:
            with self._changed:
                self._status.connects += 1
                self._status.error = None
                self._status.connected = not self._stopping
            log.info("mqtt: connected to %s:%d", self.config.host, self.config.port)
        elif time.monotonic() > latest_s:
            self._set_failure(
                f"{self.config.host}:{self.config.port} passes nothing on under {self._topic}: "
                "check the broker's access rules (read and write)"
            )

    def _on_health(self, payload: bytes) -> None:
        """Health under our topic; another process's has another instance."""
        with contextlib.suppress(msgspec.MsgspecError):
            if _decode_instance(payload).instance != self.instance:
                self._other_s = time.monotonic()

    @property
    def fault(self) -> Fault | None:
        """Another service publishes under this site's name, heard within the last minute."""
        if time.monotonic() - self._other_s > OTHER_SITE_S:
            return None
        detail = f"another service publishes as {self._topic}: give each its own mqtt.site"
        return Fault("mqtt", "service.same_site", detail)

    def _has_work(self) -> bool:
        return bool(self._unsent or self._queue or self._stopping)

    def _send_retained(self, connection: BrokerConnection) -> None:
        while True:
            with self._changed:
                if not self._unsent:
                    return
                topic = next(iter(self._unsent))
                del self._unsent[topic]
                message = self._retained[topic]
            self._send_one(connection, message)

    def _send_one(self, connection: BrokerConnection, message: MqttMessage) -> None:
        try:
            connection.publish(message)
        except OSError:
            with self._changed:
                self._status.dropped += not message.retain  # a retained value is sent again
            raise
        with self._changed:
            self._status.published += 1

    def _availability(self, payload: bytes) -> MqttMessage:
        return MqttMessage(self._topic + "availability", payload, 1, True)

    def _set_failure(self, text: str) -> None:
        """Logs a failure once, until it changes or a connection comes between."""
        with self._changed:
            self._status.connected = False
            if self._stopping or text == self._status.error:
                return
            self._status.error = text
        log.warning("mqtt: %s; trying again, messages are dropped meanwhile", text)

    def _explain(self, exc: OSError) -> str:
        where = f"{self.config.host}:{self.config.port}"
        cause = " ".join(str(exc).split())
        if isinstance(exc, BrokerRefusedError):
            return f"{where} refuses ({cause}): check mqtt.username and mqtt.password_file"
        if "certificate" in cause.lower():
            return f"{where}: {cause}: check mqtt.ca_file, mqtt.host and the clock"
        return f"{where}: {cause}: check mqtt.host, mqtt.port, mqtt.tls, and that the broker runs"
