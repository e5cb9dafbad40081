"""What the tests of the pages share: accesses, a small service's web_context, results to show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from prometheus_client import CollectorRegistry

from bikeped.config.load import LoadedConfig, parse_config
from bikeped.faults import Fault
from bikeped.monitor.camera_drift import Drift
from bikeped.monitor.verdicts import Verdict
from bikeped.pipeline.application import WebContext
from bikeped.pipeline.detection_scheduler import DecodedFrame
from bikeped.pipeline.loop import FrameResult
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.telemetry.builders import check_status, drift_status, rfc3339
from bikeped.telemetry.mqtt import MqttStatus
from bikeped.telemetry.schema import (
    CameraHealth,
    ComponentStatus,
    Counters,
    HealthMessage,
    StageLatency,
)
from bikeped.types import Colour, Detections, Frame, Kind, Signal
from bikeped.web.security import AccessPolicy

#: Sizes to look at: a phone held upright, a projector.
PHONE = {"width": 390, "height": 844}
DESKTOP = {"width": 1440, "height": 900}

TOKEN = "a-long-enough-token"
OPEN = AccessPolicy(frozenset({"localhost", "127.0.0.1", "::1"}))
LOCKED = AccessPolicy(frozenset({"localhost", "127.0.0.1", "::1"}), token=TOKEN)

CONFIG = """
camera: {width: 960, height: 640, projection: perspective, pad_size: null, crop_size: null,
         radius_px: 580, fov_deg: 73, height_m: 5.0, pitch_deg: -35}
web: {enabled: true, port: 0}
"""

NO_FRAME = Fault("camera", "camera.no_frame", "no frame for 2.0 s")
SIGNALS = {
    "IDLE": Signal("IDLE", Colour.BLUE),
    "SAFE": Signal("SAFE", Colour.GREEN),
    "WARNING": Signal("WARNING", Colour.ORANGE),
    "ALERT": Signal("ALERT", Colour.RED, blink_hz=2.0),
    "FAULT": Signal("FAULT", Colour.ORANGE, 0.5, faults=(NO_FRAME,)),
    "OFF": Signal("OFF", Colour.OFF),
}


def small(*overrides: str) -> LoadedConfig:
    return parse_config(CONFIG, "small.yaml", Path(), overrides)


def web_context(loaded: LoadedConfig | None = None, mqtt: MqttStatus | None = None) -> WebContext:
    """A service's inside without a service."""
    loaded = loaded or small()
    return WebContext(
        loaded=loaded,
        track_and_decide=TrackAndDecide(loaded),
        source="drawn.avi",
        detector="drawn",
        health=health,
        metrics=CollectorRegistry(),
        mqtt=None if mqtt is None else lambda: mqtt,
    )


def health(**changes: Any) -> HealthMessage:
    values: dict[str, Any] = {
        "timestamp": rfc3339(1.7e9),
        "state": "SAFE",
        "version": "0.1",
        "config_hash": "abc",
        "uptime_s": 3725.0,
        "fps": 29.9,
        "latency_ms": {"total": StageLatency(p50=12.0, p95=20.0, p99=30.0, max=44.0)},
        "camera": CameraHealth(ok=True, detail="frames arrive", capture_age_ms=23.0),
        "picture": ComponentStatus(ok=False, detail="picture: The picture is blurred."),
        "checks": [check_status(Verdict("picture.blurred", 1.5, 1.0, 2.5, True, "blurred"))],
        "detector_watch": None,
        "drift": drift_status(Drift(pixels=4.5, degrees=0.3, metres_at_10m=0.16, since_start=True)),
        "detector": ComponentStatus(ok=True, detail="answers"),
        "light": ComponentStatus(ok=True, detail="simulated"),
        "faults": [],
        "fault_codes": [],
        "counters": Counters(
            received=112,
            frames=100,
            dropped=2,
            undecodable=1,
            failed=4,
            out_of_order=3,
            alerts=1,
            mqtt_dropped=0,
            audit_dropped=0,
        ),
        "instance": "3f9a1c0b",
    }
    return HealthMessage(**{**values, **changes})


def picture(grey: int = 90, width: int = 960, height: int = 640) -> bytes:
    """A JPEG of one grey."""
    rgb = np.full((height, width, 3), grey, np.uint8)
    jpeg: bytes = simplejpeg.encode_jpeg(rgb, colorspace="RGB")
    return jpeg


class Scene:
    """Results of a pedestrian who stands and a cyclist who comes nearer, a frame at a time."""

    def __init__(self, track_and_decide: TrackAndDecide) -> None:
        self.track_and_decide = track_and_decide
        self.number = 0

    def next(self, signal: str = "SAFE", grey: int | None = None) -> FrameResult:
        n = self.number
        self.number += 1
        detections = Detections(
            np.array([Kind.PEDESTRIAN, Kind.CYCLIST], np.int8),
            np.full(2, 0.9, np.float32),
            np.array([[400, 250, 440, 330], [700 - 12 * n, 260, 780 - 12 * n, 340]], np.float32),
        )
        captured_s = 10.0 + n / 30
        frame = Frame(
            n, captured_s, 960, 640, jpeg=picture(60 + 7 * n % 120 if grey is None else grey)
        )
        tracking = self.track_and_decide.update(detections, 960, 640, captured_s, 0.0)
        latency = {"acquire": 1.0, "inference": 9.0 + n % 3, "total": 12.0, "capture_age": 13.0}
        seen = DecodedFrame(frame, np.zeros((1, 1, 3), np.uint8), 0.0, 1.0, 1.0)
        return FrameResult(seen, n / 30, detections, tracking, SIGNALS[signal], latency)
