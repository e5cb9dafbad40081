"""The parts that `run` and `replay` make in the same way."""

from __future__ import annotations

import asyncio
import contextlib
import time

import msgspec

from bikeped import __version__
from bikeped.config import DetectionConfig, LoadedConfig, road_region
from bikeped.cores import cores
from bikeped.detection.load import load_detector
from bikeped.errors import DetectorError
from bikeped.pipeline.detection_stage import MAX_INFLIGHT, DetectorPool, FrameDetector
from bikeped.telemetry.builders import EventHeader, event_header
from bikeped.telemetry.mqtt import MqttPublisher


def load_detector_pool(loaded: LoadedConfig, *, recorded: bool = False) -> DetectorPool:
    """The configured model; DetectorError names the key and the mend.

    `recorded`: it looks at a recording, where the rate counts and nothing waits for one frame. On a
    processor whose threads the configuration leaves open, two copies with half of the cores each
    look at two frames: threads of one inference wait for one another at every layer.
    """
    detection, base = loaded.config.detection, loaded.base_dir
    if detection.model is None:
        raise DetectorError(
            f"{loaded.source}: detection.model: no model is configured; name an .onnx or .engine "
            "file there, or with --set detection.model=FILE"
        )
    road = road_region(loaded)
    threads = cores() // MAX_INFLIGHT
    if not (recorded and threads and detection.threads == 0 and _on_cpu(detection)):
        return DetectorPool(load_detector(detection, base, road))
    shared = msgspec.structs.replace(detection, threads=threads)
    return DetectorPool(*(load_detector(shared, base, road) for _ in range(MAX_INFLIGHT)))


def _on_cpu(detection: DetectionConfig) -> bool:
    """Whether the processor runs the configured model."""
    if str(detection.model).lower().endswith(".engine"):
        return False
    from bikeped.detection.onnx_runtime import runs_on_cpu

    return runs_on_cpu(detection.providers)


def header_of(loaded: LoadedConfig, detector: FrameDetector) -> EventHeader:
    """The header of an event file or audit log that starts now."""
    return event_header(
        config_hash=loaded.hash,
        calibration_hash=loaded.calibration_hash,
        model_hash=detector.model_hash,
        version=__version__,
        started_unix_s=time.time(),
    )


def start_publisher(loaded: LoadedConfig, stack: contextlib.AsyncExitStack) -> MqttPublisher:
    """A publisher that is stopped (and says `offline`) when `stack` unwinds."""
    publisher = MqttPublisher(loaded.config.mqtt, base_dir=loaded.base_dir)
    publisher.start()
    stack.push_async_callback(asyncio.to_thread, publisher.stop)
    return publisher
