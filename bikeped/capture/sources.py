"""Opens the source that `camera.source` names."""

from __future__ import annotations

import re
from pathlib import Path

from bikeped.capture.base import FrameSource
from bikeped.capture.images import IMAGE_SUFFIXES, ImageSource
from bikeped.capture.network import NetworkSource
from bikeped.capture.v4l2 import V4l2Source
from bikeped.capture.video import VideoSource
from bikeped.errors import CaptureError

NETWORK_SCHEMES = ("rtsp", "rtsps", "http", "https")


def open_source(
    config_source: str, *, width: int, height: int, fps: float, fourcc: str
) -> FrameSource:
    """Opens what `config_source` names.

    A path below /dev or a number is a V4L2 camera, set to `width` x `height` pixels, `fps` and
    `fourcc`; an rtsp, rtsps, http or https address is a live stream; a folder of images, or one
    image, is played at `fps`; any other file is a video with its own size and rate. Raises
    CaptureError when it cannot be opened.
    """
    scheme = re.match(r"([A-Za-z][A-Za-z0-9+.-]*)://", config_source)
    if scheme is not None:
        if scheme[1].lower() not in NETWORK_SCHEMES:
            raise CaptureError(
                f"camera.source: {scheme[1]}:// is not known; use one of "
                + ", ".join(f"{known}://" for known in NETWORK_SCHEMES)
            )
        return NetworkSource(config_source, fps=fps)
    if config_source.isdecimal() or config_source.startswith("/dev/"):
        return V4l2Source(config_source, width=width, height=height, fps=fps, fourcc=fourcc)
    path = Path(config_source).expanduser()
    if not path.exists():
        raise CaptureError(
            f"{config_source}: no such file or folder; set camera.source to a camera "
            "(/dev/video0), a video, a folder of images or an rtsp:// or http:// address"
        )
    if path.is_dir() or path.suffix.lower() in IMAGE_SUFFIXES:
        return ImageSource(path, fps=fps)
    return VideoSource(path)
