"""The loopback camera: Motion JPEG over HTTP on 127.0.0.1, which does what a row asks for."""

from __future__ import annotations

import contextlib
import itertools
import socket
import threading
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import simplejpeg

from bikeped.types import ImageArray

SIZE = (96, 64)


class LoopbackCamera:
    """Sends `pictures` at `fps` to every client.

    `unplug` closes port and connections, `plug` opens the same port again; while `stalled` is set
    connections stay open and nothing comes; `spoil` changes the bytes of a JPEG before it is sent.
    """

    def __init__(self, fps: float = 30.0) -> None:
        self.fps = fps
        self.pictures: Iterator[bytes] = street()
        self.spoil: Callable[[bytes], bytes] = lambda jpeg: jpeg
        self.stalled = False
        self.sent = 0
        self.port = 0
        self._clients: list[socket.socket] = []
        self._listener: socket.socket | None = None
        self._lock = threading.Lock()
        self.plug()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}/camera.mjpg"

    def plug(self) -> None:
        """Listens; returns at once."""
        listener = socket.create_server(("127.0.0.1", self.port), reuse_port=False)
        self.port, self._listener = listener.getsockname()[1], listener
        threading.Thread(target=self._accept, args=(listener,), daemon=True).start()

    def unplug(self) -> None:
        """Closes the port and cuts off every client."""
        if self._listener is not None:
            # A thread that waits in accept() would otherwise keep the port open.
            with contextlib.suppress(OSError):
                self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()
            self._listener = None
        with self._lock:
            for client in self._clients:
                with contextlib.suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)
                client.close()
            self._clients.clear()

    close = unplug

    def _accept(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                client.settimeout(20)
                with self._lock:
                    self._clients.append(client)
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError, ValueError):
            client.recv(4096)
            client.sendall(
                b"HTTP/1.0 200 OK\r\n"
                b"Content-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"
            )
            due_s = time.monotonic()
            while True:
                due_s = max(due_s + 1 / self.fps, time.monotonic() - 0.2)
                time.sleep(max(0.0, due_s - time.monotonic()))
                if self.stalled:
                    continue
                with self._lock:
                    jpeg = self.spoil(next(self.pictures))
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                client.sendall(head.encode() + jpeg + b"\r\n")
                self.sent += 1


def encode(rgb: ImageArray, quality: int = 90) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality, colorspace="RGB"))


def street_picture(number: int, size: tuple[int, int] = SIZE) -> ImageArray:
    """Ground with texture and edges, fresh noise, something that moves; RGB [height, width, 3]."""
    width, height = size
    fixed, fresh = np.random.default_rng(7), np.random.default_rng(number)
    coarse = fixed.uniform(70, 170, (8, 12, 3)).astype(np.float32)
    rgb = cv2.resize(coarse, size, interpolation=cv2.INTER_NEAREST)
    rgb += cv2.resize(fixed.normal(0, 12, (height // 2, width // 2, 3)).astype(np.float32), size)
    left = int((number * 1.5) % width)
    rgb[height // 3 : height // 2, left : left + max(2, width // 16)] = (40, 40, 60)
    rgb += fresh.normal(0, 2.0, rgb.shape)
    return np.clip(rgb, 0, 255).astype(np.uint8)


def street(size: tuple[int, int] = SIZE) -> Iterator[bytes]:
    """Pictures of a street that never repeat."""
    return (encode(street_picture(number, size)) for number in itertools.count())


def still(rgb: ImageArray) -> Iterator[bytes]:
    """One picture for ever."""
    return itertools.repeat(encode(rgb))
