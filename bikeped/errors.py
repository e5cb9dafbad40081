"""Errors that a user can act on.

Every message names the file, the key and the remedy in one line; the command line prints it on
standard error and ends with status 2 (`BikepedError.exit_status`). Anything that is not a
`BikepedError` is a bug in bikeped.
"""

from __future__ import annotations

from importlib.util import find_spec

#: Packages that a base installation lacks, and the extra of bikeped that installs each.
EXTRAS = {
    "gpiod": "gpio",
    "libreyolo": "train-yolo",
    "matplotlib": "sim",
    "onnx": "train",
    "pycocotools": "evaluate",
    "scipy": "sim",
    "threadpoolctl": "calibrate",
    "torch": "train",
    "torchvision": "train-yolo",
    "usb": "usb",
}


class BikepedError(Exception):
    """Root of every error that bikeped raises on purpose."""

    exit_status = 2


class ConfigError(BikepedError):
    """The configuration, or a file that it names, is wrong."""


class CalibrationError(BikepedError):
    """A camera calibration is missing, malformed, or does not fit the camera."""


class GeometryError(BikepedError):
    """A lens, a framing or a table was asked for something that it cannot answer."""


class CaptureError(BikepedError):
    """A camera, a video or an image cannot be opened or read."""


class DetectorError(BikepedError):
    """A model file cannot be loaded, or its output has no layout known to bikeped."""


class FeedbackError(BikepedError):
    """The light or the speaker cannot be driven."""


class TelemetryError(BikepedError):
    """A broker, an event file or a message is unusable."""


class ScenarioError(BikepedError):
    """A scenario file is malformed."""


class DataSetError(BikepedError):
    """Pictures with boxes, for training or evaluation, are missing or malformed."""


class MissingPackageError(BikepedError):
    """A package of an extra is not installed. `extra`: the one to name, where several bring it."""

    def __init__(self, package: str, extra: str | None = None) -> None:
        extra = extra or EXTRAS[package]
        super().__init__(f"{package} is not installed; pip install 'bikeped[{extra}]'")


def require(*packages: str, extra: str | None = None) -> None:
    """Raises MissingPackageError where one of EXTRAS is absent: before long work that needs it."""
    for package in packages:
        if find_spec(package) is None:
            raise MissingPackageError(package, extra)
