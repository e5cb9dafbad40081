"""Where outcomes go: MQTT, metrics, audit log, event file, overlay video, a replay's tally."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import msgspec
import numpy as np

from bikeped import __version__
from bikeped.config import LoadedConfig
from bikeped.service.judge import Judge
from bikeped.service.loop import Loop, Outcome
from bikeped.telemetry.audit import AuditLog
from bikeped.telemetry.events import EventWriter
from bikeped.telemetry.latency import StageTimes
from bikeped.telemetry.messages import (
    Counters,
    EventLine,
    HealthMessage,
    Part,
    ShownState,
    encode,
    event_line,
    health_message,
    state_message,
    tracks_message,
)
from bikeped.telemetry.metrics import Metrics
from bikeped.telemetry.mqtt import MqttPublisher
from bikeped.types import Decision, Signal, State
from bikeped.view import Moment, VideoSink, compose, ground_projector


class Telemetry:
    """MQTT, metrics, audit log and latency figures. Nothing here waits for anybody."""

    def __init__(
        self,
        loaded: LoadedConfig,
        judge: Judge,
        publisher: MqttPublisher | None,
        audit: AuditLog | None,
        metrics: Metrics | None = None,
        *,
        wall_clock: Callable[[], float] = time.time,
        interval_clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._loaded, self._judge = loaded, judge
        self._mqtt, self._audit, self._metrics = publisher, audit, metrics
        self._wall, self._clock = wall_clock, interval_clock
        self.times = StageTimes()
        self.alerts = 0
        self._shown: tuple[str, str | tuple[int, int] | None] | None = None
        self._last_name: str | None = None
        self._next_tracks_s = self._next_health_s = -np.inf
        self._started_s = interval_clock()
        self._first_captured_s: float | None = None
        self._recent: list[float] = []
        self._last: Outcome | None = None
        self._signal: Signal | None = None

    async def frame(self, outcome: Outcome) -> None:
        self._last = outcome
        now_s = self._clock()
        self._recent.append(now_s)
        if len(self._recent) > 120:
            del self._recent[:60]
        self.times.add(outcome.latency_ms)
        if self._metrics is not None:
            self._metrics.frame(
                detections=outcome.detections,
                tracks=outcome.judgement.tracks,
                latency_ms=outcome.latency_ms,
            )
        if self._audit is not None:
            self._audit.write(self._line(outcome))
        if self._mqtt is not None and now_s >= self._next_tracks_s:
            self._next_tracks_s = self._due(self._next_tracks_s, now_s)
            age_s = outcome.latency_ms["capture_age"] / 1e3
            message = tracks_message(
                unix_s=self._wall() - age_s,
                frame_number=outcome.picture.frame.number,
                state=_shown(outcome.signal),
                tracks=outcome.judgement.tracks,
                history=self._judge.tracker.history(),
            )
            self._mqtt.publish("tracks", encode(message))

    def signal(self, signal: Signal, sentence: str) -> None:
        self._signal = signal
        if self._metrics is not None:
            self._metrics.shown(_shown(signal))
        key: str | tuple[int, int] | None = None
        if signal.name == "FAULT":
            key = "; ".join(signal.faults)
        if (signal.name, key) == self._shown:
            return
        self._shown = (signal.name, key)
        if signal.name == "ALERT" and self._last_name != "ALERT":
            self.alerts += 1
        self._last_name = signal.name
        if self._mqtt is None:
            return
        decision = (
            self._last.judgement.decision
            if self._last is not None
            else Decision(0.0, State.IDLE, sentence)
        )
        message = state_message(
            decision,
            since_unix_s=self._wall(),
            config_hash=self._loaded.hash,
            shown=_shown(signal),
            sentence=sentence,
        )
        self._mqtt.publish("state", encode(message), retain=True, qos=self._loaded.config.mqtt.qos)

    def fps(self) -> float:
        """Frames judged per second, over the last two seconds."""
        now_s = self._clock()
        recent = [t for t in self._recent if now_s - t <= 2.0]
        return len(recent) / 2.0 if recent else 0.0

    def health(self, loop: Loop, extra_faults: tuple[str, ...], light: Part) -> HealthMessage:
        """The health message now."""
        signal = self._signal
        now_s = self._clock()
        faults = (*(signal.faults if signal else ()), *extra_faults)
        camera = [f for f in faults if f.startswith(("camera", "geometry"))]
        detector = [f for f in faults if f.startswith("detector")]
        mqtt = self._mqtt.status if self._mqtt is not None else None
        return health_message(
            unix_s=self._wall(),
            state=_shown(signal) if signal else "FAULT",
            version=__version__,
            config_hash=self._loaded.hash,
            uptime_s=now_s - self._started_s,
            fps=self.fps(),
            latency_ms=self.times.percentiles(),
            camera=Part(ok=not camera, detail="; ".join(camera) or "frames arrive"),
            capture_age_ms=self._last.latency_ms["capture_age"] if self._last else None,
            detector=Part(ok=not detector, detail="; ".join(detector) or "answers"),
            light=light,
            faults=faults,
            counters=Counters(
                frames=loop.counts.frames,
                dropped=loop.dropped(),
                undecodable=loop.counts.undecodable,
                alerts=self.alerts,
                mqtt_dropped=mqtt.dropped if mqtt else 0,
                audit_dropped=self._audit.dropped if self._audit else 0,
            ),
        )

    def publish_health(self, make: Callable[[], HealthMessage]) -> HealthMessage | None:
        """At the health interval: the message, published where there is a broker."""
        now_s = self._clock()
        if now_s < self._next_health_s:
            return None
        self._next_health_s = now_s + self._loaded.config.mqtt.health_interval_s
        message = make()
        if self._mqtt is not None:
            qos = self._loaded.config.mqtt.qos
            self._mqtt.publish("health", encode(message), retain=True, qos=qos)
        if self._metrics is not None:
            status = self._mqtt.status if self._mqtt is not None else None
            self._metrics.rates(
                fps=message.fps,
                capture_age_s=(message.camera.capture_age_ms or np.nan) / 1e3,
                faults=len(message.faults),
            )
            self._metrics.queues(
                mqtt_connected=bool(status and status.connected),
                mqtt_dropped=status.dropped if status else 0,
                audit_dropped=self._audit.dropped if self._audit else 0,
            )
        return message

    def _due(self, due_s: float, now_s: float) -> float:
        """The next due time on a fixed grid, so that 0.1 s means ten a second on average."""
        interval_s = self._loaded.config.mqtt.publish_interval_s
        return (
            max(due_s + interval_s, now_s + interval_s / 2)
            if np.isfinite(due_s)
            else (now_s + interval_s)
        )

    def _line(self, outcome: Outcome) -> EventLine:
        if self._first_captured_s is None:
            self._first_captured_s = outcome.picture.frame.captured_s
        return line_of(outcome, self._first_captured_s)


def line_of(outcome: Outcome, first_captured_s: float) -> EventLine:
    """The event line of an outcome."""
    frame = outcome.picture.frame
    return event_line(
        t_s=frame.captured_s - first_captured_s,
        frame=frame.number,
        decision=outcome.judgement.decision,
        tracks=outcome.judgement.tracks,
        detections=outcome.detections,
        latency_ms=outcome.latency_ms,
        light=_shown(outcome.signal),
    )


@dataclass
class Tally:
    """What a replay adds up: states, kinds, alert episodes."""

    states: dict[str, int] = field(default_factory=dict)
    tracks: dict[str, set[int]] = field(default_factory=dict)
    alerts: list[dict[str, Any]] = field(default_factory=list)
    first_s: float | None = None
    last_s: float = 0.0
    _alerting: bool = False

    async def frame(self, outcome: Outcome) -> None:
        frame, judgement = outcome.picture.frame, outcome.judgement
        if self.first_s is None:
            self.first_s = frame.captured_s
        self.last_s = frame.captured_s
        decision = judgement.decision
        self.states[decision.state.name] = self.states.get(decision.state.name, 0) + 1
        for key, kind in zip(judgement.tracks.id.tolist(), judgement.tracks.kind, strict=True):
            self.tracks.setdefault(_KINDS[int(kind)], set()).add(key)
        alerting = decision.state is State.ALERT
        if alerting and not self._alerting:
            self.alerts.append(
                {
                    "t": round(frame.captured_s - self.first_s, 3),
                    "frame": frame.number,
                    "sentence": decision.sentence,
                    "frames": 0,
                }
            )
        if alerting:
            self.alerts[-1]["frames"] += 1
        self._alerting = alerting

    def signal(self, signal: Signal, sentence: str) -> None:
        """Nothing: the tally is of decisions."""


_KINDS = ("pedestrian", "cyclist", "vehicle")


class EventFile:
    """The event file of a replay."""

    def __init__(self, writer: EventWriter) -> None:
        self._writer = writer
        self._first_s: float | None = None

    async def frame(self, outcome: Outcome) -> None:
        if self._first_s is None:
            self._first_s = outcome.picture.frame.captured_s
        self._writer.write(line_of(outcome, self._first_s))

    def signal(self, signal: Signal, sentence: str) -> None:
        """Nothing: an event line carries its light."""


class OverlayVideo:
    """The overlay video of a replay: drawn in a thread, while the next frame is looked at."""

    def __init__(self, sink: VideoSink, judge: Judge, fov_deg: float) -> None:
        self._sink, self._judge, self._fov_deg = sink, judge, fov_deg
        self._drawing: asyncio.Task[None] | None = None
        self._first_s: float | None = None

    async def frame(self, outcome: Outcome) -> None:
        await self.wait()
        frame, judgement = outcome.picture.frame, outcome.judgement
        if self._first_s is None:
            self._first_s = frame.captured_s
        moment = Moment(
            detections=outcome.detections,
            tracks=judgement.tracks,
            decision=judgement.decision,
            frame_number=frame.number,
            time_s=frame.captured_s - self._first_s,
            latency_s=outcome.latency_ms["total"] / 1e3,
            history={k: np.asarray(v) for k, v in self._judge.tracker.history().items()},
        )
        framing = self._judge.framing_of(frame.width, frame.height)
        projector = ground_projector(self._judge.camera, framing)

        def draw() -> None:
            self._sink.write(
                compose(
                    outcome.picture.rgb,
                    moment,
                    self._sink.size,
                    frame_width=frame.width,
                    ground_to_frame=projector,
                    fov_deg=self._fov_deg,
                    heading_deg=self._judge.camera.heading_deg,
                )
            )

        self._drawing = asyncio.create_task(asyncio.to_thread(draw))

    def signal(self, signal: Signal, sentence: str) -> None:
        """Nothing: only frames are drawn."""

    async def wait(self) -> None:
        """Until the frame in hand is drawn; raises what went wrong."""
        task, self._drawing = self._drawing, None
        if task is not None:
            await task


def as_mapping(message: msgspec.Struct) -> Mapping[str, Any]:
    """A message as plain keys and values, for the HTTP server."""
    return cast(Mapping[str, Any], msgspec.to_builtins(message))


def _shown(signal: Signal) -> ShownState:
    return cast(ShownState, signal.name)
