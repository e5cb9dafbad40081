"""Prometheus metrics of the service, on a registry of their own.

An own registry keeps two services in one process (tests, a replay beside the service) apart.
Prometheus counts in seconds, so durations are turned from milliseconds here and nowhere else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np
from prometheus_client import CollectorRegistry, Counter, Enum, Gauge, Histogram

from bikeped.telemetry.builders import ShownState
from bikeped.telemetry.latency import STAGES
from bikeped.types import Detections, Kind, Tracks

#: Upper bounds in seconds: 0.5 ms (a pure stage) to 1 s (beyond any use); dense around a frame.
BUCKETS = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.033, 0.05, 0.066, 0.1, 0.2, 0.5, 1.0)

#: Why a frame was not judged: `newer` replaced it, `queue` was full, `stale` it was too old.
DROP_REASONS = ("newer", "queue", "stale")


class Metrics:
    """All metrics of one service, named `bikeped_...`; `http.add_monitoring` serves `registry`."""

    def __init__(self, registry: CollectorRegistry | None = None) -> None:
        self.registry = registry or CollectorRegistry()
        new: dict[str, Any] = {"namespace": "bikeped", "registry": self.registry}
        self._frames = Counter("frames", "Frames judged", **new)
        self._dropped = Counter("frames_dropped", "Frames not judged", ["reason"], **new)
        self._undecodable = Counter("frames_undecodable", "Frames that did not decode", **new)
        self._detections = Counter("detections", "Detections kept", ["kind"], **new)
        self._tracks = Gauge("tracks", "Objects believed present", ["kind"], **new)
        self._state = Enum("state", "What the light shows", states=get_args(ShownState), **new)
        self._alerts = Counter("alerts", "Changes into ALERT", **new)
        self._latency = Histogram(
            "stage_latency_seconds", "Duration of a stage", ["stage"], buckets=BUCKETS, **new
        )
        self._capture_age = Gauge("capture_age_seconds", "Age of the newest frame", **new)
        self._fps = Gauge("fps", "Frames judged per second", **new)
        self._light_faults = Counter("light_faults", "Failures to drive the light", **new)
        self._faults = Gauge("faults", "Faults present now", **new)
        self._mqtt_connected = Gauge("mqtt_connected", "1 while the broker is connected", **new)
        self._mqtt_dropped = Counter("mqtt_dropped", "MQTT messages dropped", **new)
        self._audit_dropped = Counter("audit_dropped", "Audit lines not written", **new)
        self._shown: str | None = None
        self._totals: dict[str, int] = {}
        # Label lookups take a lock and a dictionary each; done once, and zeros are visible early.
        self._stage = {stage: self._latency.labels(stage) for stage in STAGES}
        self._kind_detections = {kind: self._detections.labels(kind.label) for kind in Kind}
        self._kind_tracks = {kind: self._tracks.labels(kind.label) for kind in Kind}
        for reason in DROP_REASONS:
            self._dropped.labels(reason)

    def frame(
        self, *, detections: Detections, tracks: Tracks, latency_ms: Mapping[str, float]
    ) -> None:
        """Counts one judged frame; `latency_ms` by stage, stages that did not run left out."""
        self._frames.inc()
        detected = np.bincount(detections.kind, minlength=len(Kind))
        present = np.bincount(tracks.kind, minlength=len(Kind))
        for kind in Kind:
            if detected[kind]:
                self._kind_detections[kind].inc(int(detected[kind]))
            self._kind_tracks[kind].set(int(present[kind]))
        for stage, duration_ms in latency_ms.items():
            # NaN would make the histogram's sum NaN for ever.
            if math.isfinite(duration_ms):
                self._stage[stage].observe(duration_ms / 1000)

    def shown(self, state: ShownState) -> None:
        """What the light shows now; a change into ALERT counts one alert."""
        if state == self._shown:
            return
        self._state.state(state)
        if state == "ALERT":
            self._alerts.inc()
        self._shown = state

    def dropped(self, reason: str, count: int = 1) -> None:
        """Frames that were not judged, by reason, preferably one of `DROP_REASONS`."""
        self._dropped.labels(reason).inc(count)

    def undecodable(self, count: int = 1) -> None:
        """Frames whose picture could not be decoded."""
        self._undecodable.inc(count)

    def light_fault(self) -> None:
        """The light could not be driven."""
        self._light_faults.inc()

    def rates(self, *, fps: float, capture_age_s: float | None, faults: int) -> None:
        """What is measured now; a capture age of None (no frame yet) is shown as NaN."""
        self._fps.set(fps)
        self._capture_age.set(math.nan if capture_age_s is None else capture_age_s)
        self._faults.set(faults)

    def queues(self, *, mqtt_connected: bool, mqtt_dropped: int, audit_dropped: int) -> None:
        """What the publisher and the audit log report; the counts are totals since the start."""
        self._mqtt_connected.set(mqtt_connected)
        self._catch_up(self._mqtt_dropped, "mqtt", mqtt_dropped)
        self._catch_up(self._audit_dropped, "audit", audit_dropped)

    def _catch_up(self, counter: Counter, name: str, total: int) -> None:
        """Brings a counter, which can only be increased, to a total counted elsewhere."""
        counter.inc(max(0, total - self._totals.get(name, 0)))
        self._totals[name] = max(total, self._totals.get(name, 0))
