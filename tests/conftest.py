"""What tests of several packages share: a real mosquitto with a proxy that can misbehave before it
and a subscriber; a small camera with its clip, model and configuration."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import numpy as np
import onnx
import pytest
import simplejpeg
from hypothesis import settings
from onnx import TensorProto, helper, numpy_helper
from paho.mqtt.client import Client, MQTTMessage
from paho.mqtt.enums import CallbackAPIVersion

from bikeped.lab.rendering.clip import AviWriter

#: `serve`, `open_page` and a headless Chromium, for the pages of device and lab.
pytest_plugins = ["browser_fixtures"]

# No test judges time: a busy machine is slow.
settings.register_profile("bikeped", deadline=None)
settings.load_profile("bikeped")

MOSQUITTO = shutil.which("mosquitto", path="/usr/local/sbin:/usr/sbin:/usr/local/bin:/usr/bin")
DEADLINE_S = 30.0  # generous: reached only by a failure


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Broker:
    """One mosquitto process on one port; can be killed and started again."""

    def __init__(self, directory: Path, lines: tuple[str, ...] = ("allow_anonymous true",)) -> None:
        assert MOSQUITTO is not None
        self.directory = directory
        self.port = free_port()
        # Started as root it would otherwise become a user who cannot read the test's files.
        options = ("user root", "persistence false", f"listener {self.port} 127.0.0.1", *lines)
        self.config = directory / "mosquitto.conf"
        self.config.write_text("\n".join(options) + "\n")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with (self.directory / "mosquitto.log").open("ab") as output:
            self.process = subprocess.Popen(
                [str(MOSQUITTO), "-c", str(self.config)], stdout=output, stderr=output
            )
        deadline = time.monotonic() + DEADLINE_S
        while True:
            with contextlib.suppress(OSError):
                socket.create_connection(("127.0.0.1", self.port), 1).close()
                return
            if self.process.poll() is not None or time.monotonic() > deadline:
                pytest.fail((self.directory / "mosquitto.log").read_text())

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


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

SMALL_CONFIG = """
camera:
  source: {source}
  width: 96
  height: 64
  projection: perspective
  pad_size: null
  crop_size: null
  radius_px: 58
  fov_deg: 73
  height_m: 5.0
  pitch_deg: -35
monitor: {{picture: false}}
detection: {{model: {model}, providers: [cpu], threads: 1, rider_overlap: 1.0}}
mqtt:
  health_interval_s: 0.2
"""


@pytest.fixture(scope="session")
def small_jpegs() -> list[bytes]:
    """Eight pictures of 96 x 64 that differ."""
    v, u = np.mgrid[0:64, 0:96]
    pictures = []
    for n in range(8):
        rgb = np.stack([u * 2, v * 3, (u + v + 20 * n) % 200], axis=2).astype(np.uint8)
        pictures.append(simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), colorspace="RGB"))
    return pictures


@pytest.fixture
def make_clip(tmp_path: Path, small_jpegs: list[bytes]) -> Callable[..., Path]:
    """Writes a Motion JPEG AVI; `pictures` are used in turn."""

    def make(name: str, frames: int, pictures: list[bytes] | None = None, fps: int = 30) -> Path:
        turn = pictures or small_jpegs
        path = tmp_path / name
        with AviWriter(path, fps, (96, 64)) as clip:
            for number in range(frames):
                clip.write(turn[number % len(turn)])
        return path

    return make


@pytest.fixture(scope="session")
def small_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A real ONNX model that sees one pedestrian, 7 m ahead, in every picture."""
    anchors = 12 * 8 + 6 * 4 + 3 * 2  # of strides 8, 16 and 32 on 96 x 64
    answer = np.zeros((1, 4 + 2, anchors), np.float32)
    answer[0, :, 5] = (48, 22, 10, 26, 0.9, 0.0)  # cx cy w h, person, bicycle
    graph = helper.make_graph(
        [helper.make_node("Identity", ["answer"], ["output0"])],
        "one pedestrian",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 96))],
        [helper.make_tensor_value_info("output0", TensorProto.FLOAT, answer.shape)],
        [numpy_helper.from_array(answer, "answer")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    for key, value in {
        "names": "{0: 'person', 1: 'bicycle'}",
        "task": "detect",
        "imgsz": "[64, 96]",
    }.items():
        model.metadata_props.add(key=key, value=value)
    path = tmp_path_factory.mktemp("model") / "pedestrian.onnx"
    onnx.save(model, path)
    return path


@pytest.fixture
def small_config(tmp_path: Path, small_model: Path) -> Callable[..., Path]:
    """Writes a configuration for the small camera; keywords are more lines of YAML."""

    def make(source: Path | str = "/dev/video-none", more: str = "", model: object = None) -> Path:
        path = tmp_path / "small.yaml"
        text = SMALL_CONFIG.format(source=source, model=model or small_model)
        if "feedback:" not in more:
            more += "feedback: {light: simulated}\n"
        path.write_text(text + more, encoding="utf-8")
        return path

    return make
