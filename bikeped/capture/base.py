"""The interface of a frame source."""

from __future__ import annotations

import abc
from typing import TypeVar

from bikeped.types import Frame, ImageArray

#: An image as a source has it: JPEG, or RGB [height, width, 3] uint8.
Image = bytes | ImageArray

_Source = TypeVar("_Source", bound="FrameSource")


class FrameSource(abc.ABC):
    """An open camera or recording; a context manager that closes it.

    Not thread-safe: open, read and close it in one thread. Constructors open the source and raise
    CaptureError when they cannot. Frames may hold incomplete JPEGs; the decoder reports them.
    """

    name: str  #: for messages: a path, or an address without its password
    width: int  #: of the frames, pixels
    height: int
    fps: float  #: nominal frames per second
    live: bool  #: True: `captured_s` is on the monotonic clock, and frames come in real time
    _number = 0  #: of the next frame

    @abc.abstractmethod
    def read(self) -> Frame | None:
        """The next frame; waits for it. None after the last one of a recording.

        Raises CaptureError when the source fails; it must then be closed and opened again.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Closes the device or file; may be called twice."""

    def __enter__(self: _Source) -> _Source:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _frame(self, captured_s: float, image: Image) -> Frame:
        """The next frame, of the source's size."""
        jpeg, rgb = (image, None) if isinstance(image, bytes) else (None, image)
        frame = Frame(self._number, captured_s, self.width, self.height, jpeg, rgb)
        self._number += 1
        return frame
