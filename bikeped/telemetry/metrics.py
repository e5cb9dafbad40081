"""Prometheus metrics of the service, on a registry of their own.

An own registry keeps two services in one process (tests, a replay beside the service) apart.
Prometheus counts in seconds, so durations are converted from milliseconds here and nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, get_args

import numpy as np
from prometheus_client import CollectorRegistry, Counter, Enum, Gauge, Histogram

from bikeped.monitor.camera_drift import Drift
from bikeped.monitor.detector_check import DetectorNumbers
from bikeped.monitor.verdicts import Verdict
from bikeped.telemetry.latency import STAGES
from bikeped.telemetry.schema import Counters, ShownState
from bikeped.types import Detections, Kind, Tracks

#: Upper bounds in seconds: 0.5 ms (a pure stage) to 1 s (beyond any use); dense around a frame.
BUCKETS = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.033, 0.05, 0.066, 0.1, 0.2, 0.5, 1.0)

#: Label values of `frames_dropped`: a newer frame replaced it, a queue was full, it was too old.
DROP_REASONS = ("newer", "queue", "stale")

#: Field of `Counters` -> name and help of the counter that follows it.
_TOTALS = {
    "received": ("frames_received", "Frames received from the camera"),
    "undecodable": ("frames_undecodable", "Frames that could not be decoded"),
    "failed": ("frames_failed", "Frames for which the detector raised an error"),
    "out_of_order": ("frames_out_of_order", "Frames skipped: capture time not increasing"),
    "alerts": ("alerts", "Changes into ALERT"),
    "mqtt_dropped": ("mqtt_dropped", "MQTT messages dropped"),
    "audit_dropped": ("audit_dropped", "Audit log lines not written"),
    "log_dropped": ("log_dropped", "Log lines lost because standard error took none"),
    "capped": ("frames_capped", "Frames of which not all detections were tracked"),
}


class Metrics:
    """All metrics of one service, named `bikeped_...`; `http_server` serves `registry`."""

    def __init__(self, registry: CollectorRegistry | None = None) -> None:
        self.registry = registry or CollectorRegistry()
        new: dict[str, Any] = {"namespace": "bikeped", "registry": self.registry}
        self._frames = Counter("frames", "Frames processed through to a decision", **new)
        dropped = Counter("frames_dropped", "Frames not processed", ["reason"], **new)
        detections = Counter("detections", "Detections after filtering", ["kind"], **new)
        tracks = Gauge("tracks", "Current tracks", ["kind"], **new)
        self._state = Enum("state", "State shown by the light", states=get_args(ShownState), **new)
        latency = Histogram(
            "stage_latency_seconds", "Duration of a stage", ["stage"], buckets=BUCKETS, **new
        )
        self._capture_age = Gauge("capture_age_seconds", "Age of the newest frame", **new)
        self._fps = Gauge("fps", "Frames processed per second", **new)
        self._faults = Gauge("faults", "Active faults that the light shows", **new)
        self._fault = Gauge("fault", "1 while a fault of this code is present", ["code"], **new)
        check = {"labelnames": ["check"], **new}
        self._checks = {
            "value": Gauge("check_value", "Newest value of a check", **check),
            "threshold": Gauge("check_threshold", "The value that may not be reached", **check),
            "active": Gauge("check_active", "1 while the check stops or withholds", **check),
        }
        self._drift = Gauge("drift", "The camera against its reference", ["measure"], **new)
        watch = "Known answers and motion: the watch over the detector"
        self._watch = Gauge("detector_watch", watch, ["measure"], **new)
        self._mqtt_connected = Gauge("mqtt_connected", "1 while the broker is connected", **new)
        # Label lookups take a lock and a dictionary each; done once, and zeros are visible early.
        self._stage = {stage: latency.labels(stage) for stage in STAGES}
        self._kind_detections = {kind: detections.labels(kind.label) for kind in Kind}
        self._kind_tracks = {kind: tracks.labels(kind.label) for kind in Kind}
        by_reason = {reason: dropped.labels(reason) for reason in DROP_REASONS}
        self._counters: dict[str, Counter] = {
            "dropped": by_reason["newer"],
            "light_errors": Counter("light_faults", "Failures to drive the light", **new),
            **{key: Counter(name, text, **new) for key, (name, text) in _TOTALS.items()},
        }
        self._fault_codes: set[str] = set()  # seen so far: a gauge that was 1 goes back to 0
        self._totals = dict.fromkeys(self._counters, 0)

    def count_frame(
        self, *, detections: Detections, tracks: Tracks, latency_ms: Mapping[str, float]
    ) -> None:
        """Counts one processed frame; `latency_ms` by stage, stages that did not run left out."""
        self._frames.inc()
        detected = np.bincount(detections.kind, minlength=len(Kind))
        present = np.bincount(tracks.kind, minlength=len(Kind))
        for kind in Kind:
            self._kind_detections[kind].inc(int(detected[kind]))
            self._kind_tracks[kind].set(int(present[kind]))
        for stage, duration_ms in latency_ms.items():
            # NaN would make the histogram's sum NaN for ever.
            if math.isfinite(duration_ms):
                self._stage[stage].observe(duration_ms / 1000)

    def set_state(self, state: ShownState) -> None:
        """Sets the state that the light shows."""
        self._state.state(state)

    def update(
        self,
        *,
        fps: float,
        capture_age_s: float | None,
        faults: int,
        mqtt_connected: bool,
        light_errors: int,
        counters: Counters,
        fault_codes: Sequence[str] = (),
        verdicts: Sequence[Verdict] = (),
        drift: Drift | None = None,
        watch: DetectorNumbers | None = None,
    ) -> None:
        """Sets the gauges, and brings the counters up to totals counted elsewhere.

        A capture age of None (no frame yet) becomes NaN. A total that went back changes nothing.
        """
        self._fps.set(fps)
        self._capture_age.set(math.nan if capture_age_s is None else capture_age_s)
        self._faults.set(faults)
        self._mqtt_connected.set(mqtt_connected)
        for code in {*self._fault_codes, *fault_codes}:
            self._fault.labels(code).set(code in fault_codes)
        self._fault_codes.update(fault_codes)
        for verdict in verdicts:
            for field, gauge in self._checks.items():
                gauge.labels(verdict.code).set(getattr(verdict, field))
        for measure in ("pixels", "degrees", "metres_at_10m"):
            self._drift.labels(measure).set(getattr(drift, measure, math.nan))
        for measure, number in ({} if watch is None else vars(watch)).items():
            self._watch.labels(measure).set(math.nan if number is None else number)
        for key, counter in self._counters.items():
            total = light_errors if key == "light_errors" else getattr(counters, key)
            if total > self._totals[key]:
                counter.inc(total - self._totals[key])
                self._totals[key] = total
