"""What every source of frames offers."""

from __future__ import annotations

import abc
from types import TracebackType
from typing import TypeVar

from bikeped.types import Frame

_Source = TypeVar("_Source", bound="FrameSource")


class FrameSource(abc.ABC):
    """An open camera or recording; a context manager that closes it.

    Not safe for threads: open, read and close it from one. Constructors open the source and raise
    CaptureError when it cannot be had. Frames may hold bytes that are no whole JPEG; whoever
    decodes them says so.
    """

    name: str  #: for people: a path or an address without its password
    width: int  #: of the pictures, pixels
    height: int
    fps: float  #: pictures a second, as the source promises
    live: bool  #: True: `captured_s` is on the monotonic clock, and pictures come at their own pace

    @abc.abstractmethod
    def read(self) -> Frame | None:
        """The next frame; waits for it. None after the last one of a recording.

        Raises CaptureError when the source is broken; it must then be closed and opened anew.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Gives the device or file back; may be called twice."""

    def __enter__(self: _Source) -> _Source:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
