"""Writes Motion-JPEG AVI files, byte for byte the same for the same pictures.

OpenCV's writers pick codec library, quality and metadata by build; here the JPEG files go into the
file as they are, and readers that pass JPEG undecoded get them back as they were.
"""

from __future__ import annotations

import struct
from pathlib import Path
from types import TracebackType

from bikeped.errors import CaptureError
from bikeped.files import WholeFile

#: AVI's 32-bit sizes end at 4 GB; some readers fail beyond 2.
_MAX_BYTES = 2_000_000_000
_KEYFRAME = 0x10
_HAS_INDEX = 0x10


class AviWriter:
    """An MJPEG AVI at `path`; written under a temporary name, renamed at `close`."""

    def __init__(self, path: Path, fps: int, size: tuple[int, int]) -> None:
        """`fps`: whole frames per second; `size`: width, height."""
        self.path, self.fps, self.size = path, fps, size
        self._index: list[tuple[int, int]] = []
        self._largest = 0
        try:
            self._whole = WholeFile(path)
            self._file = self._whole.partial.open("wb")
        except OSError as error:
            raise CaptureError(
                f"{path}: cannot be written ({error.strerror}); choose another folder"
            ) from error
        self._file.write(self._header(0))
        self._movi = self._file.tell() - 4  # the index counts from the word "movi"

    def write(self, jpeg: bytes) -> None:
        """Appends one JPEG file as a frame."""
        offset = self._file.tell()
        if offset + len(jpeg) > _MAX_BYTES:
            raise CaptureError(f"{self.path}: more than 2 GB; make the clip shorter or smaller")
        self._file.write(b"00dc" + struct.pack("<I", len(jpeg)) + jpeg + b"\0" * (len(jpeg) % 2))
        self._index.append((offset - self._movi, len(jpeg)))
        self._largest = max(self._largest, len(jpeg))

    def close(self) -> None:
        """Writes the index and the sizes, and gives the file its name."""
        end = self._file.tell()
        entries = b"".join(
            b"00dc" + struct.pack("<III", _KEYFRAME, offset, size) for offset, size in self._index
        )
        self._file.write(b"idx1" + struct.pack("<I", len(entries)) + entries)
        total = self._file.tell()
        self._file.seek(0)
        self._file.write(self._header(end, total))
        self._file.close()
        self._whole.commit()

    def discard(self) -> None:
        """Stops and removes what was written so far."""
        self._file.close()
        self._whole.discard()

    def _header(self, movi_end: int, total: int = 8) -> bytes:
        width, height = self.size
        frames = len(self._index)
        main = struct.pack(
            "<10I16x",
            *(round(1e6 / self.fps), self._largest * self.fps, 0, _HAS_INDEX, frames, 0, 1),
            *(self._largest, width, height),
        )
        stream = b"vidsMJPG" + struct.pack(
            "<IHHIIIIIIII4H",
            0, 0, 0, 0, 1, self.fps, 0, frames, self._largest, 0xFFFFFFFF, 0, 0, 0, width, height,
        )  # fmt: skip
        bitmap = struct.pack(
            "<IiiHH4sIiiII", 40, width, height, 1, 24, b"MJPG", width * height * 3, 0, 0, 0, 0
        )
        strl = b"strl" + _chunk(b"strh", stream) + _chunk(b"strf", bitmap)
        hdrl = b"hdrl" + _chunk(b"avih", main) + _chunk(b"LIST", strl)
        head = b"AVI " + _chunk(b"LIST", hdrl)
        movi_start = 8 + len(head) + 8
        movi_size = max(movi_end - movi_start, 4)
        riff = b"RIFF" + struct.pack("<I", total - 8) + head
        return riff + b"LIST" + struct.pack("<I", movi_size) + b"movi"

    def __enter__(self) -> AviWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()


def _chunk(name: bytes, data: bytes) -> bytes:
    return name + struct.pack("<I", len(data)) + data
