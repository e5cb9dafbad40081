"""Frame sources: cameras, network streams, recordings and image folders.

`open_source` chooses the source by its text; `FrameGrabber` keeps the newest frame of a live one;
`PacedSource` plays a recording in real time; `JpegDecoder` decodes at a reduced scale.
"""

from bikeped.capture.base import FrameSource
from bikeped.capture.cameras import NetworkSource, V4l2Source
from bikeped.capture.frame_grabber import FrameGrabber
from bikeped.capture.jpeg import JpegDecoder, read_size
from bikeped.capture.recordings import ImageSource, PacedSource, VideoSource
from bikeped.capture.sources import open_source

__all__ = [
    "FrameGrabber",
    "FrameSource",
    "ImageSource",
    "JpegDecoder",
    "NetworkSource",
    "PacedSource",
    "V4l2Source",
    "VideoSource",
    "open_source",
    "read_size",
]
