"""Publishes to the broker without ever making the caller wait for it.

`publish` only puts a message aside; one background task connects, sends, and connects again. What
is retained is kept as its latest value and sent again after every connection; the rest waits in a
queue that drops its oldest. A broker that is absent, slow or hangs costs messages, never time.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import random
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import aiomqtt

from bikeped import __version__
from bikeped.config import MqttConfig
from bikeped.errors import TelemetryError
from bikeped.telemetry.homeassistant import discovery_messages
from bikeped.telemetry.mqtt_auth import load_credentials, sends_password_in_clear

log = logging.getLogger(__name__)

# What the libraries log of their own is a line an attempt; this module says it once a change.
_wire_log = logging.getLogger(f"{__name__}.wire")
_wire_log.setLevel(logging.CRITICAL + 1)

AVAILABILITY = "availability"


@dataclass(frozen=True)
class MqttStatus:
    """How the publisher stands; the counts are totals since it was made."""

    connected: bool
    error: str | None  #: why it is not connected, one line; None while it is, or before it tried
    connects: int
    published: int
    dropped: int  #: messages that never reached the broker, queue overflow included
    superseded: int  #: retained values replaced by a newer one before they could be sent
    queued: int


class _Message(NamedTuple):
    topic: str
    payload: bytes
    qos: int
    retain: bool


class MqttPublisher:
    """Publishes `bikeped/<site>/...`; for one event loop, whose thread alone may call it.

    `queue_size` bounds the messages that wait (not retained ones); `backoff_s` are the first and
    the longest pause between two attempts, stretched by a jitter from `rng`; `io_timeout_s` is
    how long one exchange with the broker may take before the connection is given up;
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
        backoff_s: tuple[float, float] = (1.0, 60.0),
        io_timeout_s: float = 10.0,
        stop_timeout_s: float = 2.0,
        rng: random.Random | None = None,
    ) -> None:
        self.config = config
        self._base_dir = base_dir
        self._credentials = load_credentials(config, base_dir)
        if sends_password_in_clear(config):
            log.warning("mqtt: the password goes to %s unencrypted: set mqtt.tls", config.host)
        self._topic = f"bikeped/{config.site}/"
        self._discovery = discovery_messages(config, version) if config.home_assistant else {}
        self._backoff_s = backoff_s
        self._io_timeout_s = io_timeout_s
        self._stop_timeout_s = stop_timeout_s
        self._rng = rng or random.Random()

        self._queue: deque[_Message] = deque()
        self._queue_size = queue_size
        self._retained: dict[str, _Message] = {}  #: newest value by topic
        self._unsent: dict[str, None] = {}  #: topics of `_retained` to send, in order
        self._wake = asyncio.Event()
        self._online = asyncio.Event()
        self._stop = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

        self._error: str | None = None
        self._connects = self._published = self._dropped = self._superseded = 0

    @property
    def status(self) -> MqttStatus:
        """How the publisher stands now."""
        return MqttStatus(
            connected=self._online.is_set(),
            error=self._error,
            connects=self._connects,
            published=self._published,
            dropped=self._dropped,
            superseded=self._superseded,
            queued=len(self._queue),
        )

    def publish(
        self, topic_suffix: str, payload: bytes, *, retain: bool = False, qos: int | None = None
    ) -> None:
        """Puts a message for `bikeped/<site>/<topic_suffix>` aside; returns at once.

        Retained messages replace the waiting one of their topic; others join the queue, whose
        oldest is dropped and counted when it is full. `qos` None: the configuration's for what is
        retained, 0 for the rest.
        """
        if qos is None:
            qos = self.config.qos if retain else 0
        message = _Message(self._topic + topic_suffix, payload, qos, retain)
        if retain:
            if message.topic in self._unsent:
                self._superseded += 1
            self._retained[message.topic] = message
            self._unsent[message.topic] = None
        else:
            if len(self._queue) >= self._queue_size:
                self._queue.popleft()
                self._dropped += 1
            self._queue.append(message)
        self._wake.set()

    async def start(self) -> None:
        """Starts the background task; returns before anything is connected."""
        if self._task is None:
            self._stop.clear()
            self._task = asyncio.create_task(self._run(), name="mqtt")

    async def stop(self) -> None:
        """Sends the retained values and `offline`, and disconnects; at most `stop_timeout_s`."""
        task, self._task = self._task, None
        if task is None:
            return
        self._stop.set()
        self._wake.set()
        if self._online.is_set():
            await asyncio.wait({task}, timeout=self._stop_timeout_s)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    async def wait_connected(self) -> None:
        """Returns once the broker has everything retained and the `online`."""
        await self._online.wait()

    async def _run(self) -> None:
        """Connects for ever, until stopped. Its errors are told in `status`, never raised."""
        loop = asyncio.get_running_loop()
        attempt = 0
        while not self._stop.is_set():
            began_s = loop.time()
            try:
                await self._session()
            except (aiomqtt.MqttError, OSError) as exc:
                self._failed(self._explain(exc))
            except Exception as exc:  # noqa: BLE001
                # The last resort of a service that nobody watches: a bug in a library that one
                # odd broker provokes must not end telemetry for months.
                self._failed(f"unexpected {type(exc).__name__}: {exc}")
            if self._stop.is_set():
                break
            # A connection that is lost at once (two poles with one site's name, a broker that
            # rejects a topic) is a failure too: only one that lasts resets the pause.
            if loop.time() - began_s >= self._backoff_s[1]:
                attempt = 0
            await asyncio.sleep(self._pause_s(attempt))
            attempt += 1

    def _pause_s(self, attempt: int) -> float:
        """Doubles from the first pause to the longest; jitter keeps poles from acting as one."""
        first_s, longest_s = self._backoff_s
        return min(longest_s, first_s * 2.0 ** min(attempt, 30)) * self._rng.uniform(0.5, 1.0)

    async def _session(self) -> None:
        """One connection, from its attempt to its end; raises what ended it."""
        await self._reload_credentials()
        client = aiomqtt.Client(
            self.config.host,
            self.config.port,
            username=self._credentials.username,
            password=self._credentials.password,
            tls_context=self._credentials.tls,
            logger=_wire_log,
            # One name a site makes the broker end a half-open older connection (and publish its
            # will) before it accepts this one; under another name that will would come later and
            # leave a living pole `offline`.
            identifier=f"bikeped-{self.config.site}",
            will=aiomqtt.Will(self._topic + AVAILABILITY, b"offline", qos=1, retain=True),
            timeout=self._io_timeout_s,
            keepalive=self.config.keepalive_s,
        )
        tasks: set[asyncio.Task[None]] = set()
        try:
            await client.__aenter__()
            tasks = {
                asyncio.create_task(self._watch(client), name="mqtt-watch"),
                asyncio.create_task(self._send(client), name="mqtt-send"),
            }
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            # The sender ends only by stopping; then the watcher's "disconnected" is no news.
            failures = [failure for task in done if (failure := task.exception()) is not None]
            if failures and not self._stop.is_set():
                raise failures[0]
        finally:
            self._online.clear()
            for task in tasks:
                task.cancel()
            _drop_connection(client)
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _watch(self, client: aiomqtt.Client) -> None:
        """Raises MqttError when the connection is lost, also while there is nothing to send."""
        async for _ in client.messages:
            pass  # nothing is subscribed to

    async def _send(self, client: aiomqtt.Client) -> None:
        """Sends what waits, as it comes, until stopped; then says goodbye."""
        for topic, payload in self._discovery.items():
            await client.publish(topic, payload, qos=1, retain=True)
        self._unsent = dict.fromkeys(self._retained)
        while self._unsent:
            await self._send_retained(client)
        # Only now: whoever reads `online` finds values of this connection, not of an earlier one.
        await client.publish(self._topic + AVAILABILITY, b"online", qos=1, retain=True)
        self._connected()
        while not self._stop.is_set():
            self._wake.clear()
            while (self._unsent or self._queue) and not self._stop.is_set():
                # A change of state never waits behind a backlog of tracks.
                if self._unsent:
                    await self._send_retained(client)
                else:
                    await self._send_queued(client)
            if not self._stop.is_set():
                await self._wake.wait()
        while self._unsent:
            await self._send_retained(client)
        await client.publish(self._topic + AVAILABILITY, b"offline", qos=1, retain=True)
        await client.__aexit__(None, None, None)

    async def _send_retained(self, client: aiomqtt.Client) -> None:
        topic = next(iter(self._unsent))
        del self._unsent[topic]
        await client.publish(*_arguments(self._retained[topic]))
        self._published += 1

    async def _send_queued(self, client: aiomqtt.Client) -> None:
        message = self._queue.popleft()
        self._dropped += 1  # taken back below: also a cancellation in between must count
        await client.publish(*_arguments(message))
        self._dropped -= 1
        self._published += 1

    async def _reload_credentials(self) -> None:
        """Takes up a renewed certificate or password; an unusable one changes nothing."""
        with contextlib.suppress(TelemetryError):
            self._credentials = await asyncio.to_thread(
                load_credentials, self.config, self._base_dir
            )

    def _connected(self) -> None:
        self._connects += 1
        self._error = None
        self._online.set()
        log.info("mqtt: connected to %s:%d", self.config.host, self.config.port)

    def _failed(self, text: str) -> None:
        """Says a failure once, until it changes or a connection comes between."""
        if text != self._error:
            log.warning("mqtt: %s; trying again, messages are dropped meanwhile", text)
        self._error = text

    def _explain(self, exc: Exception) -> str:
        where = f"{self.config.host}:{self.config.port}"
        cause = " ".join(f"{exc.__cause__ or exc}".split())
        if isinstance(exc, aiomqtt.exceptions.MqttConnectError):
            return f"{where} refuses ({cause}): check mqtt.username and mqtt.password_file"
        if "certificate" in cause.lower():
            return f"{where}: {cause}: check mqtt.ca_file, mqtt.host and the clock"
        return f"{where}: {cause}: check mqtt.host, mqtt.port, mqtt.tls, and that the broker runs"


def _arguments(message: _Message) -> tuple[str, bytes, int, bool]:
    return message.topic, message.payload, message.qos, message.retain


def _drop_connection(client: aiomqtt.Client) -> None:
    """Closes the socket now, whatever the broker does; harmless when it is closed already.

    aiomqtt can only ask the broker to disconnect, and wait; a client given up after a timeout would
    keep its socket, its reader in the loop and its task until the keep-alive runs out.
    """
    paho = client._client
    # A connect that still hangs in its thread must not touch the loop when it comes to an end.
    paho.on_socket_open = None
    paho._sock_close()
