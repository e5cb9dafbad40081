"""Metrics: what Prometheus would read after known frames."""

from __future__ import annotations

import math

import numpy as np
from prometheus_client import REGISTRY

from bikeped.telemetry.metrics import Metrics
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
    metrics.frame(detections=DETECTIONS, tracks=TRACKS, latency_ms=times)
    metrics.frame(detections=Detections.empty(), tracks=Tracks.empty(1.0), latency_ms={})
    metrics.frame(detections=DETECTIONS, tracks=TRACKS, latency_ms={"total": 5.0})
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


def test_every_change_into_alert_counts_once():
    metrics = Metrics()
    for state in ("SAFE", "ALERT", "ALERT", "WARNING", "ALERT", "FAULT"):
        metrics.shown(state)
    assert value(metrics, "alerts_total") == 2
    assert value(metrics, "state", bikeped_state="FAULT") == 1
    assert value(metrics, "state", bikeped_state="ALERT") == 0


def test_drops_faults_and_rates():
    metrics = Metrics()
    assert value(metrics, "frames_dropped_total", reason="newer") == 0  # visible before the first
    metrics.dropped("newer")
    metrics.dropped("newer", 2)
    metrics.undecodable()
    metrics.light_fault()
    metrics.rates(fps=29.5, capture_age_s=None, faults=2)
    assert value(metrics, "frames_dropped_total", reason="newer") == 3
    assert value(metrics, "frames_undecodable_total") == 1
    assert value(metrics, "light_faults_total") == 1
    assert value(metrics, "fps") == 29.5
    assert value(metrics, "faults") == 2
    assert math.isnan(value(metrics, "capture_age_seconds") or 0)
    metrics.rates(fps=29.5, capture_age_s=0.04, faults=0)
    assert value(metrics, "capture_age_seconds") == 0.04


def test_totals_counted_elsewhere_are_taken_over_and_never_go_back():
    metrics = Metrics()
    for total in (3, 3, 10, 4, 12):
        metrics.queues(mqtt_connected=True, mqtt_dropped=total, audit_dropped=0)
    assert value(metrics, "mqtt_dropped_total") == 12
    assert value(metrics, "audit_dropped_total") == 0
    assert value(metrics, "mqtt_connected") == 1
    metrics.queues(mqtt_connected=False, mqtt_dropped=12, audit_dropped=1)
    assert value(metrics, "mqtt_connected") == 0
    assert value(metrics, "audit_dropped_total") == 1


def test_two_services_in_one_process_do_not_meet():
    first, second = Metrics(), Metrics()
    first.undecodable()
    assert value(second, "frames_undecodable_total") == 0
    assert REGISTRY.get_sample_value("bikeped_frames_undecodable_total") is None
