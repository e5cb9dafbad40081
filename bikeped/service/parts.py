"""The parts that `run` and `replay` make in the same way."""

from __future__ import annotations

import contextlib
import time

from bikeped import __version__
from bikeped.config import LoadedConfig, road_region
from bikeped.detection.base import load_detector
from bikeped.errors import DetectorError
from bikeped.service.vision import Eye, ModelEye
from bikeped.telemetry.messages import EventHeader, event_header
from bikeped.telemetry.mqtt import MqttPublisher


def load_eye(loaded: LoadedConfig) -> Eye:
    """The configured model; DetectorError names the key and the mend."""
    if loaded.config.detection.model is None:
        raise DetectorError(
            f"{loaded.source}: detection.model: no model is configured; name an .onnx or .engine "
            "file there, or with --set detection.model=FILE"
        )
    return ModelEye(load_detector(loaded.config.detection, loaded.base_dir, road_region(loaded)))


def header_of(loaded: LoadedConfig, eye: Eye) -> EventHeader:
    """The header of an event file or audit log that starts now."""
    return event_header(
        config_hash=loaded.hash,
        calibration_hash=loaded.calibration_hash,
        model_hash=eye.model_hash,
        version=__version__,
        started_unix_s=time.time(),
    )


async def start_publisher(loaded: LoadedConfig, stack: contextlib.AsyncExitStack) -> MqttPublisher:
    """A publisher that is stopped (and says `offline`) when `stack` unwinds."""
    publisher = MqttPublisher(loaded.config.mqtt, base_dir=loaded.base_dir)
    await publisher.start()
    stack.push_async_callback(publisher.stop)
    return publisher
