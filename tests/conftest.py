"""What tests of several packages share: a real mosquitto with a proxy that can misbehave before it
and a subscriber; a small camera with its clip, model and configuration."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion
from small_crossing import (
    DEADLINE_S,
    MOSQUITTO,
    Broker,
    small_pictures,
    write_clip,
    write_config,
    write_model,
)

#: `serve`, `open_page` and a headless Chromium, for the pages of device and lab.
pytest_plugins = ["browser_fixtures"]

# No test judges time: a busy machine is slow.
settings.register_profile("bikeped", deadline=None)
settings.load_profile("bikeped")


@pytest.fixture(scope="session")
def need_mosquitto() -> None:
    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed: apt-get install mosquitto")


@pytest.fixture
def make_broker(need_mosquitto: None, tmp_path: Path) -> Iterator[Callable[..., Broker]]:
    """Starts brokers of the test's own, for tests that kill or configure them."""
    brokers: list[Broker] = []

    def make(*lines: str) -> Broker:
        directory = tmp_path / f"broker{len(brokers)}"
        directory.mkdir()
        brokers.append(Broker(directory, lines or ("allow_anonymous true",)))
        brokers[-1].start()
        return brokers[-1]

    yield make
    for broker in brokers:
        broker.kill()


@pytest.fixture(scope="session")
def broker(need_mosquitto: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Broker]:
    """One broker for all tests that only talk to it; each test uses a site of its own."""
    shared = Broker(tmp_path_factory.mktemp("broker"))
    shared.start()
    yield shared
    shared.kill()


class Proxy:
    """Passes bytes between clients and a broker until told to hang or to abort."""

    def __init__(self, target_port: int) -> None:
        self.target_port = target_port
        self.port = 0
        self.flowing = asyncio.Event()
        self.flowing.set()
        self.accepted = asyncio.Event()
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._accepting: set[asyncio.Task[None]] = set()
        self._client_sides: list[asyncio.StreamWriter] = []
        self._broker_sides: list[asyncio.StreamWriter] = []

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._client_sides.append(writer)
        task = asyncio.current_task()
        assert task is not None
        self._accepting.add(task)
        task.add_done_callback(self._accepting.discard)
        up_reader, up_writer = await asyncio.open_connection("127.0.0.1", self.target_port)
        self._broker_sides.append(up_writer)
        for source, sink in ((reader, up_writer), (up_reader, writer)):
            task = asyncio.create_task(self._pump(source, sink))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        self.accepted.set()

    async def _pump(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(4096):
                await self.flowing.wait()
                sink.write(data)
                await sink.drain()

    def abort_clients(self) -> None:
        """Clients are cut off; their connections to the broker stay half open."""
        for writer in self._client_sides:
            writer.transport.abort()
        self._client_sides.clear()

    def abort_broker_side(self) -> None:
        """What the broker sees when a client is killed: a reset (linger 0), no DISCONNECT."""
        for writer in self._broker_sides:
            sock = writer.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            writer.transport.abort()
        self._broker_sides.clear()

    async def close(self) -> None:
        assert self._server is not None
        self._server.close()
        # Who comes as the door closes is let in some turns of the loop later; then all are known.
        for _ in range(5):
            await asyncio.sleep(0)
        await asyncio.gather(*self._accepting, return_exceptions=True)
        self.abort_clients()
        self.abort_broker_side()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._server.wait_closed()


@pytest.fixture
async def make_proxy() -> AsyncIterator[Callable[[int], Proxy]]:
    proxies: list[Proxy] = []

    def make(target_port: int) -> Proxy:
        proxies.append(Proxy(target_port))
        return proxies[-1]

    yield make
    for proxy in proxies:
        await proxy.close()


Received = tuple[str, bytes, bool]  # topic, payload, retained


class Listener:
    """A subscriber that remembers all it received, and can wait for more."""

    def __init__(self) -> None:
        self.received: list[Received] = []
        self.queue: asyncio.Queue[Received] = asyncio.Queue()

    async def until(self, done: Callable[[list[Received]], bool]) -> None:
        async def receive() -> None:
            while not done(self.received):
                self.received.append(await self.queue.get())

        await asyncio.wait_for(receive(), DEADLINE_S)

    def payloads(self, suffix: str) -> list[bytes]:
        return [payload for topic, payload, _ in self.received if topic.endswith(f"/{suffix}")]


@pytest.fixture
def listen() -> Callable[..., contextlib.AbstractAsyncContextManager[Listener]]:
    @contextlib.asynccontextmanager
    async def subscribe(
        port: int, topic: str, username: str | None = None, password: str | None = None
    ) -> AsyncIterator[Listener]:
        loop, listener, subscribed = asyncio.get_running_loop(), Listener(), asyncio.Event()
        client = Client(CallbackAPIVersion.VERSION2)
        client.username_pw_set(username, password)

        def on_message(_client: Client, _data: object, message: MQTTMessage) -> None:
            received = (message.topic, message.payload, message.retain)
            loop.call_soon_threadsafe(listener.queue.put_nowait, received)

        client.on_message = on_message
        client.on_connect = lambda *_: client.subscribe(topic, qos=1)
        client.on_subscribe = lambda *_: loop.call_soon_threadsafe(subscribed.set)
        client.connect("127.0.0.1", port)
        client.loop_start()
        try:
            await asyncio.wait_for(subscribed.wait(), DEADLINE_S)
            yield listener
        finally:
            client.disconnect()
            await asyncio.to_thread(client.loop_stop)

    return subscribe


# --- a small crossing: camera, clip and model that every service and command-line test can afford


@pytest.fixture(scope="session")
def small_jpegs() -> list[bytes]:
    """Eight pictures of 96 x 64 that differ."""
    return small_pictures()


@pytest.fixture
def make_clip(tmp_path: Path, small_jpegs: list[bytes]) -> Callable[..., Path]:
    """Writes a Motion JPEG AVI; `pictures` are used in turn."""

    def make(name: str, frames: int, pictures: list[bytes] | None = None, fps: int = 30) -> Path:
        return write_clip(tmp_path / name, frames, pictures or small_jpegs, fps)

    return make


@pytest.fixture(scope="session")
def small_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real ONNX model that sees one pedestrian, 7 m ahead, in every picture."""
    return write_model(tmp_path_factory.mktemp("model") / "pedestrian.onnx")


@pytest.fixture
def small_config(tmp_path: Path, small_model: Path) -> Callable[..., Path]:
    """Writes a configuration for the small camera; keywords are more lines of YAML."""

    def make(source: Path | str = "/dev/video-none", more: str = "", model: object = None) -> Path:
        return write_config(tmp_path / "small.yaml", source, str(model or small_model), more)

    return make
