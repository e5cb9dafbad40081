"""Small pictures and recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

Array = npt.NDArray[np.uint8]
WIDTH, HEIGHT, FPS = 96, 64, 25.0


def picture(index: int, width: int = WIDTH, height: int = HEIGHT) -> Array:
    """A colourful gradient (BGR) with a bright bar whose place depends on `index`."""
    v, u = np.mgrid[0:height, 0:width]
    image = np.stack([u * 255 // width, v * 255 // height, (u + v) % 200], axis=2)
    image[:, (index * 8) % width : (index * 8) % width + 8] = (20, 240, 240)
    return image.astype(np.uint8)


def jpeg_of(image: Array, quality: int = 90) -> bytes:
    ok, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert ok
    return data.tobytes()


@pytest.fixture
def make_picture() -> Callable[..., Array]:
    return picture


@pytest.fixture
def make_jpeg() -> Callable[..., bytes]:
    return lambda index=0, **size: jpeg_of(picture(index, **size))


@pytest.fixture
def write_video(tmp_path: Path) -> Callable[..., Path]:
    def write(name: str, fourcc: str, frames: int = 6, fps: float = FPS) -> Path:
        path = tmp_path / name
        writer = cv2.VideoWriter(
            str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), fps, (WIDTH, HEIGHT)
        )
        assert writer.isOpened()
        for index in range(frames):
            writer.write(picture(index))
        writer.release()
        return path

    return write


@pytest.fixture
def without_tables() -> Callable[[bytes], bytes]:
    """Leaves the Huffman tables out of a JPEG, as AVI recorders may."""

    def strip(data: bytes) -> bytes:
        kept, at = bytearray(data[:2]), 2
        while data[at + 1] != 0xDA:
            length = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
            if data[at + 1] != 0xC4:
                kept += data[at : at + length]
            at += length
        return bytes(kept + data[at:])

    return strip
