"""JPEG decoding into reused buffers, at a reduced scale, with libjpeg-turbo.

Strict: images that libjpeg finds truncated or damaged are refused, never returned half grey.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import simplejpeg

from bikeped.errors import CaptureError
from bikeped.types import ImageArray

SOI = b"\xff\xd8"
EOI = b"\xff\xd9"
# A damaged header can claim 65535 x 65535 pixels, 12 GB; no supported camera has more than this.
MAX_PIXELS = 1 << 27
# libjpeg scales by eighths, but 5/8 to 7/8 take longer than the full size (measured). Images are
# therefore decoded at the full size or at 4/8, 3/8, 2/8 or 1/8 of it.
SMALLEST_REDUCTION = 2

JpegBytes = bytes | bytearray | memoryview


def read_size(data: JpegBytes, min_width: int = 0, min_height: int = 0) -> tuple[int, int]:
    """(width, height) in pixels of the image as decoded; CaptureError when it has no header.

    `min_width` and `min_height`: as for `JpegDecoder.decode`, but both or none.
    """
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(
            data,
            min_width=min_width,
            min_height=min_height,
            min_factor=SMALLEST_REDUCTION,
            strict=True,
        )
    except (ValueError, RuntimeError) as error:
        raise CaptureError(f"JPEG: no image header ({error})") from error
    return int(width), int(height)


class JpegDecoder:
    """Decodes into `buffers` buffers in turn, which grow when needed.

    The image that `decode` returns is a view into one of them, valid until the `buffers`-th later
    call: another thread may hold the newest `buffers` - 1 while one is decoded. One decoder serves
    one thread. `max_pixels` limits the memory that a damaged header can claim.
    """

    def __init__(self, buffers: int = 3, *, max_pixels: int = MAX_PIXELS) -> None:
        if buffers < 1:
            raise ValueError(f"buffers: at least 1, not {buffers}")
        self._buffers: list[npt.NDArray[np.uint8]] = [np.empty(0, np.uint8)] * buffers
        self._turn = 0
        self._max_pixels = max_pixels

    def decode(self, data: JpegBytes, min_width: int = 0, min_height: int = 0) -> ImageArray:
        """RGB [height, width, 3] uint8 at the smallest scale of at least the given size.

        A size of 0 is not constrained; both 0, or larger than the image: the full size. Raises
        CaptureError for anything but a complete JPEG.
        """
        if min_width > 0 or min_height > 0:
            # libjpeg scales only when both are given.
            min_width, min_height = max(min_width, 1), max(min_height, 1)
        width, height = read_size(data, min_width, min_height)
        if width * height > self._max_pixels:
            raise CaptureError(f"JPEG: {width}x{height} pixels are too many; is it damaged?")
        try:
            return np.asarray(
                simplejpeg.decode_jpeg(
                    data,
                    "RGB",
                    min_width=min_width,
                    min_height=min_height,
                    min_factor=SMALLEST_REDUCTION,
                    buffer=self._next_buffer(width * height * 3),
                    strict=True,
                ),
                np.uint8,
            )
        except (ValueError, RuntimeError, MemoryError) as error:
            # This buffer is free again: a series of damaged images must not reach those in use.
            self._turn -= 1
            raise CaptureError(f"JPEG: damaged or truncated ({error})") from error

    def _next_buffer(self, size: int) -> npt.NDArray[np.uint8]:
        self._turn = (self._turn + 1) % len(self._buffers)
        if self._buffers[self._turn].size < size:
            self._buffers[self._turn] = np.empty(size, np.uint8)
        return self._buffers[self._turn][:size]
