"""Metrics: what Prometheus would read after known frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from prometheus_client import REGISTRY

from bikeped.monitor.camera_drift import Drift
from bikeped.monitor.detector_check import DetectorNumbers
from bikeped.monitor.verdicts import Verdict
from bikeped.telemetry.metrics import Metrics
from bikeped.telemetry.schema import Counters
from bikeped.types import Detections, Tracks

DETECTIONS = Detections(
    np.array([0, 1, 1], np.int8), np.full(3, 0.5, np.float32), np.zeros((3, 4), np.float32)
)
TRACKS = Tracks(
    0.0,
    np.array([1]),
    np.array([1], np.int8),
    np.zeros((1, 2)),
    np.zeros((1, 2)),
    np.zeros(1),
    np.zeros(1, np.int64),
)


def value(metrics: Metrics, name: str, **labels: str) -> float | None:
    return metrics.registry.get_sample_value(f"bikeped_{name}", labels)


def test_frames_detections_tracks_and_latency():
    metrics = Metrics()
    times = {"total": 25.0, "pre": math.nan}
    metrics.count_frame(detections=DETECTIONS, tracks=TRACKS, latency_ms=times)
    metrics.count_frame(detections=Detections.empty(), tracks=Tracks.empty(1.0), latency_ms={})
    metrics.count_frame(detections=DETECTIONS, tracks=TRACKS, latency_ms={"total": 5.0})
    assert value(metrics, "frames_total") == 3
    assert value(metrics, "detections_total", kind="cyclist") == 4
    assert value(metrics, "detections_total", kind="pedestrian") == 2
    assert value(metrics, "detections_total", kind="vehicle") == 0
    assert value(metrics, "tracks", kind="cyclist") == 1
    assert value(metrics, "tracks", kind="pedestrian") == 0
    assert value(metrics, "stage_latency_seconds_count", stage="total") == 2
    assert math.isclose(value(metrics, "stage_latency_seconds_sum", stage="total") or 0, 0.03)
    assert value(metrics, "stage_latency_seconds_bucket", stage="total", le="0.02") == 1
    assert value(metrics, "stage_latency_seconds_bucket", stage="total", le="0.033") == 2
    assert value(metrics, "stage_latency_seconds_count", stage="pre") == 0


def counters(**totals: int) -> Counters:
    return Counters(**{**dict.fromkeys(Counters.__struct_fields__, 0), **totals})


def update(metrics: Metrics, **changes: Any) -> None:
    values = {"fps": 0.0, "capture_age_s": None, "faults": 0, "mqtt_connected": False}
    metrics.update(**{**values, "light_errors": 0, "counters": counters(), **changes})


def test_the_state_is_the_newest_one():
    metrics = Metrics()
    for state in ("SAFE", "ALERT", "ALERT", "WARNING", "ALERT", "FAULT"):
        metrics.set_state(state)
    assert value(metrics, "state", bikeped_state="FAULT") == 1
    assert value(metrics, "state", bikeped_state="ALERT") == 0


def test_gauges():
    metrics = Metrics()
    update(metrics, fps=29.5, faults=2, mqtt_connected=True)
    assert value(metrics, "fps") == 29.5
    assert value(metrics, "faults") == 2
    assert value(metrics, "mqtt_connected") == 1
    assert math.isnan(value(metrics, "capture_age_seconds") or 0)
    update(metrics, fps=29.5, capture_age_s=0.04)
    assert value(metrics, "capture_age_seconds") == 0.04
    assert value(metrics, "faults") == 0
    assert value(metrics, "mqtt_connected") == 0


@pytest.mark.parametrize(
    ("field", "name"),
    [
        ("received", "frames_received_total"),
        ("dropped", "frames_dropped_total"),
        ("undecodable", "frames_undecodable_total"),
        ("failed", "frames_failed_total"),
        ("out_of_order", "frames_out_of_order_total"),
        ("alerts", "alerts_total"),
        ("mqtt_dropped", "mqtt_dropped_total"),
        ("audit_dropped", "audit_dropped_total"),
        ("log_dropped", "log_dropped_total"),
        ("capped", "frames_capped_total"),
        ("light_errors", "light_faults_total"),
    ],
)
def test_totals_counted_elsewhere_are_taken_over_and_never_go_back(field: str, name: str):
    metrics = Metrics()
    labels = {"reason": "newer"} if field == "dropped" else {}
    assert value(metrics, name, **labels) == 0  # visible before the first
    for total in (3, 3, 10, 4, 12):
        if field == "light_errors":
            update(metrics, light_errors=total)
        else:
            update(metrics, counters=counters(**{field: total}))
    assert value(metrics, name, **labels) == 12
    others = [s for m in metrics.registry.collect() for s in m.samples if s.name.endswith("_total")]
    assert sum(sample.value for sample in others) == 12  # no other counter has moved


def test_two_services_in_one_process_do_not_meet():
    first, second = Metrics(), Metrics()
    update(first, counters=counters(undecodable=1))
    assert value(first, "frames_undecodable_total") == 1
    assert value(second, "frames_undecodable_total") == 0
    assert REGISTRY.get_sample_value("bikeped_frames_undecodable_total") is None


def test_checks_drift_and_faults_by_code():
    metrics = Metrics()
    blurred = Verdict("picture.blurred", 1.5, 1.0, 2.5, True, "The picture is blurred.")
    drift = Drift(pixels=30.0, degrees=2.0, metres_at_10m=1.1)
    watch = DetectorNumbers(None, 3, 1, 4.5, 0.2)
    update(metrics, fault_codes=["camera.moved"], verdicts=[blurred], drift=drift, watch=watch)
    assert value(metrics, "detector_watch", measure="motion_s") == 4.5
    assert value(metrics, "detector_watch", measure="check_passes") == 3
    assert math.isnan(value(metrics, "detector_watch", measure="check_age_s") or 0)
    assert value(metrics, "fault", code="camera.moved") == 1
    assert value(metrics, "check_value", check="picture.blurred") == 1.5
    assert value(metrics, "check_threshold", check="picture.blurred") == 1
    assert value(metrics, "check_active", check="picture.blurred") == 1
    assert value(metrics, "drift", measure="metres_at_10m") == 1.1
    update(metrics)
    assert value(metrics, "fault", code="camera.moved") == 0
    assert math.isnan(value(metrics, "drift", measure="pixels") or 0)
