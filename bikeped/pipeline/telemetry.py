"""Publishes results and signals: MQTT, metrics, audit log, stage latencies, health."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from collections.abc import Callable
from typing import cast

from bikeped import __version__
from bikeped.config.load import LoadedConfig
from bikeped.decision.episodes import EpisodeTracker
from bikeped.faults import Component, Fault, fault_texts
from bikeped.feedback.light import LightOutput
from bikeped.log_queue import dropped_lines
from bikeped.pipeline.loop import FrameResult, Loop
from bikeped.pipeline.runtime import RateLimitedLogger
from bikeped.pipeline.track_and_decide import TrackAndDecide
from bikeped.telemetry.builders import (
    check_status,
    drift_status,
    encode,
    event_line,
    json_number,
    rfc3339,
    tracks_message,
    watch_status,
)
from bikeped.telemetry.event_files import AuditLog
from bikeped.telemetry.latency import StageTimes
from bikeped.telemetry.metrics import Metrics
from bikeped.telemetry.mqtt import MqttPublisher
from bikeped.telemetry.schema import (
    CameraHealth,
    ComponentStatus,
    Counters,
    EventLine,
    HealthMessage,
    ShownState,
    StageLatency,
    StateMessage,
)
from bikeped.types import Decision, Signal

log = logging.getLogger(__name__)

LOG_EVERY_S = 60.0  #: between two health lines in the log
MEASURE_EVERY_S = 1.0  #: between two updates of the metrics


class Telemetry:
    """Listener that feeds MQTT, metrics, audit log and stage latencies; it never blocks.

    `remember`: number of frames over which the percentiles are taken.
    """

    def __init__(
        self,
        loaded: LoadedConfig,
        track_and_decide: TrackAndDecide,
        *,
        publisher: MqttPublisher | None = None,
        audit: AuditLog | None = None,
        metrics: Metrics | None = None,
        remember: int = 900,
        wall_clock: Callable[[], float] = time.time,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.loaded, self._track_and_decide = loaded, track_and_decide
        self._mqtt, self._audit, self._metrics = publisher, audit, metrics
        self._wall, self._clock = wall_clock, clock
        self.times = StageTimes(remember)
        self._alerts = EpisodeTracker()
        self._shown: tuple[str, tuple[Fault, ...]] | None = None
        self._next_tracks_s = -math.inf
        self._started_s = clock()
        self._recent: deque[float] = deque(maxlen=240)  # when results came
        self._last: FrameResult | None = None
        self._signal: Signal | None = None

    async def on_frame_result(self, result: FrameResult) -> None:
        self._last = result
        now_s = self._clock()
        self._recent.append(now_s)
        self.times.add(result.latency_ms)
        if self._metrics is not None:
            self._metrics.count_frame(
                detections=result.detections,
                tracks=result.tracking.tracks,
                latency_ms=result.latency_ms,
            )
        if self._audit is not None:
            self._audit.write(event_line_for(result))
        if self._mqtt is not None and now_s >= self._next_tracks_s:
            self._next_tracks_s = self._due(now_s)
            message = tracks_message(
                unix_s=self._wall() - result.latency_ms["capture_age"] / 1e3,
                frame_number=result.decoded.frame.number,
                state=_shown(result.signal),
                tracks=result.tracking.tracks,
                history=self._track_and_decide.tracker.history(),
            )
            self._mqtt.publish("tracks", encode(message))

    def on_signal(self, signal: Signal, sentence: str, decision: Decision | None) -> None:
        self._signal = signal
        self._alerts.update(signal.name == "ALERT")
        if self._metrics is not None:
            self._metrics.set_state(_shown(signal))
        shown = (signal.name, signal.faults if signal.name == "FAULT" else ())
        before, self._shown = self._shown, shown
        if shown == before or self._mqtt is None:
            return
        # A pair belongs to a decision, so FAULT and OFF carry none.
        pair = decision.pair if decision and signal.name not in ("FAULT", "OFF") else None
        message = StateMessage(
            state=_shown(signal),
            since=rfc3339(self._wall()),
            pair=None if pair is None else (pair.cyclist_id, pair.pedestrian_id),
            distance_m=None if pair is None else json_number(pair.distance_m, 3),
            config_hash=self.loaded.hash,
            sentence=sentence,
        )
        self._mqtt.publish("state", encode(message), retain=True, qos=self.loaded.config.mqtt.qos)

    def fps(self) -> float:
        """Frames processed per second, over the last two seconds."""
        now_s = self._clock()
        return sum(now_s - at_s <= 2.0 for at_s in self._recent) / 2.0

    def health(self, loop: Loop, light: str) -> HealthMessage:
        """The health message now; `light` names the kind of light, as `feedback.light` does."""
        signal, faults = self._signal, self._faults(loop)
        age_s = loop.frame_age_s()
        age_ms = None if age_s is None else age_s * 1e3
        if age_ms is None and self._last is not None:
            age_ms = self._last.latency_ms["capture_age"]
        camera, picture = _status("camera", faults, "frames arrive"), loop.monitor.picture
        return HealthMessage(
            timestamp=rfc3339(self._wall()),
            state=_shown(signal) if signal else "FAULT",
            version=__version__,
            config_hash=self.loaded.hash,
            uptime_s=round(self._clock() - self._started_s, 1),
            fps=self.fps(),
            latency_ms={
                stage: StageLatency(
                    **{key: round(row[key], 2) for key in StageLatency.__struct_fields__}
                )
                for stage, row in self.times.percentiles().items()
            },
            camera=CameraHealth(
                ok=camera.ok,
                detail=camera.detail,
                capture_age_ms=None if age_ms is None else json_number(age_ms, 1),
            ),
            picture=_status("picture", faults, "good"),
            checks=[check_status(verdict) for verdict in loop.verdicts()],
            drift=None if picture.drift is None else drift_status(picture.drift),
            detector=_status("detector", faults, "answers"),
            detector_watch=None if loop.watch is None else watch_status(loop.watch.numbers),
            light=_status("light", faults, light),
            faults=list(fault_texts(faults)),
            fault_codes=[fault.code for fault in faults],
            counters=self._counters(loop),
            instance="" if self._mqtt is None else self._mqtt.instance,
        )

    def _faults(self, loop: Loop) -> tuple[Fault, ...]:
        """Those beside the signal, and the notices."""
        return (*(self._signal.faults if self._signal else ()), *loop.monitor.notices())

    def _counters(self, loop: Loop) -> Counters:
        counts = loop.counts
        return Counters(
            received=counts.received,
            frames=counts.frames,
            dropped=loop.feed.dropped,
            undecodable=counts.undecodable,
            failed=counts.failed,
            out_of_order=counts.out_of_order,
            alerts=self._alerts.count,
            mqtt_dropped=self._mqtt.status.dropped if self._mqtt else 0,
            audit_dropped=self._audit.dropped if self._audit else 0,
            log_dropped=dropped_lines(),
            capped=self._track_and_decide.capped_frames,
        )

    def publish_health(self, message: HealthMessage) -> None:
        """Sends a health message where there is a broker."""
        if self._mqtt is not None:
            qos = self.loaded.config.mqtt.qos
            self._mqtt.publish("health", encode(message), retain=True, qos=qos)

    def measure(self, loop: Loop, light_errors: int = 0) -> None:
        """Updates the metrics that do not come with a frame."""
        if self._metrics is not None:
            self._metrics.update(
                fps=self.fps(),
                capture_age_s=loop.frame_age_s(),
                faults=len(self._signal.faults) if self._signal else 0,
                mqtt_connected=self._mqtt is not None and self._mqtt.status.connected,
                light_errors=light_errors,
                counters=self._counters(loop),
                fault_codes=[fault.code for fault in self._faults(loop)],
                verdicts=loop.verdicts(),
                watch=None if loop.watch is None else loop.watch.numbers,
                drift=loop.monitor.picture.drift,
            )

    def _due(self, now_s: float) -> float:
        """The next due time on a fixed grid, so that 0.1 s means ten a second on average."""
        interval_s = self.loaded.config.mqtt.publish_interval_s
        # After a pause no messages are made up for.
        return max(self._next_tracks_s + interval_s, now_s + interval_s / 2)


def event_line_for(result: FrameResult) -> EventLine:
    """The event line of a result."""
    return event_line(
        t_s=result.t_s,
        frame=result.decoded.frame.number,
        decision=result.tracking.decision,
        tracks=result.tracking.tracks,
        detections=result.detections,
        latency_ms=result.latency_ms,
        light=_shown(result.signal),
        faults=result.signal.faults,
    )


def _status(name: Component, faults: tuple[Fault, ...], detail: str) -> ComponentStatus:
    """Status of one component: its faults, or `detail` where it has none."""
    texts = fault_texts(fault for fault in faults if fault.kind.component == name)
    return ComponentStatus(ok=not texts, detail="; ".join(texts) or detail)


def _shown(signal: Signal) -> ShownState:
    return cast(ShownState, signal.name)


async def report_health(telemetry: Telemetry, loop: Loop, light: LightOutput) -> None:
    """Reports health to broker, metrics and log until cancelled. An error costs one report."""
    limited_log = RateLimitedLogger(log)
    interval_s = telemetry.loaded.config.mqtt.health_interval_s
    next_health_s = next_log_s = -math.inf
    while True:
        try:
            now_s = time.monotonic()
            telemetry.measure(loop, light.errors)
            if now_s >= next_health_s:
                next_health_s = now_s + interval_s
                message = telemetry.health(loop, light.name)
                telemetry.publish_health(message)
                if now_s >= next_log_s and message.latency_ms:
                    next_log_s = now_s + LOG_EVERY_S
                    log.info("%s", health_line(message))
        except Exception as error:  # noqa: BLE001
            limited_log.failure("health", error)
        await asyncio.sleep(min(MEASURE_EVERY_S, interval_s))


def health_line(message: HealthMessage) -> str:
    """The health in one line of the log; of each stage p50, p95 and p99 in ms."""
    counters = message.counters
    latencies = ", ".join(
        f"{stage} {row.p50:.1f}/{row.p95:.1f}/{row.p99:.1f}"
        for stage, row in message.latency_ms.items()
    )
    line = (
        f"health: {message.state}, {message.fps:.1f} frames/s, {counters.frames} processed, "
        f"{counters.dropped} dropped, {counters.undecodable} undecodable, "
        f"{counters.failed} failed, {counters.out_of_order} out of order | "
        f"latency p50/p95/p99 ms: {latencies}"
    )
    return f"{line} | faults: {'; '.join(message.faults)}" if message.faults else line
