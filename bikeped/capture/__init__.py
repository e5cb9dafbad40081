"""Frame sources: cameras, network streams, recordings and image folders.

`open_source` opens the one that `camera.source` names; `frame_grabber` keeps the newest frame of a
live one; `recordings.PacedSource` plays a recording in real time.
"""

from __future__ import annotations

import re
from pathlib import Path

from bikeped.capture.base import FrameSource
from bikeped.capture.cameras import NetworkSource, V4l2Source
from bikeped.capture.recordings import IMAGE_SUFFIXES, ImageSource, VideoSource
from bikeped.capture.source_names import address_with_login, shown_source
from bikeped.config.schema import CameraConfig
from bikeped.errors import CaptureError

NETWORK_SCHEMES = ("rtsp", "rtsps", "http", "https")


def open_source(
    camera: CameraConfig, source: str | None = None, base_dir: Path = Path()
) -> FrameSource:
    """Opens `camera.source`, or `source` with the other keys of the camera section.

    A path below /dev or a number is a V4L2 camera, set to `width` x `height` pixels, `fps` and
    `fourcc`; an rtsp, rtsps, http or https address is a live stream; a folder of images, or one
    image, is played at `fps`; any other file is a video with its own size and rate. A relative
    `password_file` starts at `base_dir`. Raises CaptureError when it cannot be opened.
    """
    source = camera.source if source is None else source
    scheme = re.match(r"([A-Za-z][A-Za-z0-9+.-]*)://", source)
    if scheme is not None:
        if scheme[1].lower() not in NETWORK_SCHEMES:
            raise CaptureError(
                f"camera.source: {scheme[1]}:// is not known; use one of "
                + ", ".join(f"{known}://" for known in NETWORK_SCHEMES)
            )
        return NetworkSource(address_with_login(camera, source, base_dir), fps=camera.fps)
    if source.isdecimal() or source.startswith("/dev/"):
        return V4l2Source(
            source, width=camera.width, height=camera.height, fps=camera.fps, fourcc=camera.fourcc
        )
    path = Path(source).expanduser()
    if not path.exists():
        raise CaptureError(
            f"{shown_source(source)}: no such file or folder; set camera.source to a camera "
            "(/dev/video0), a video, a folder of images or an rtsp:// or http:// address"
        )
    if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES:
        return ImageSource(path, fps=camera.fps)
    return VideoSource(path)
