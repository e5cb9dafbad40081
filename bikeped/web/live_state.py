"""State of the live page: newest frame and signal, last alerts, latencies of the last two minutes.

Updating it costs the loop microseconds and never waits.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable, Mapping

import msgspec
import numpy as np

from bikeped.decision.episodes import EpisodeTracker
from bikeped.faults import fault_texts
from bikeped.pipeline.loop import FrameResult
from bikeped.telemetry.builders import finite_tracks, track_records
from bikeped.telemetry.latency import STAGES
from bikeped.telemetry.schema import EventTrack
from bikeped.types import Decision, PairMetrics, Signal, State, Tracks

#: Number of alerts kept.
ALERTS = 20
#: Seconds of latency history.
TREND_S = 120


class LiveTrack(EventTrack, frozen=True, kw_only=True):
    """A track as event lines have it, and for how long it has not been detected."""

    unseen_s: float


class LiveSnapshot(msgspec.Struct, frozen=True):
    """State at one moment, as sent to the page. Ages in seconds; None: nothing received yet."""

    number: int
    signal: str
    colour: str
    blink_hz: float
    sentence: str
    detail: str
    decided: str | None
    faults: tuple[str, ...]
    signal_age_s: float | None  #: since the newest signal
    frame: int | None
    frame_age_s: float | None  #: since the newest result
    t_s: float | None
    pair: dict[str, float] | None
    tracks: list[LiveTrack]


class AlertRecord(msgspec.Struct):
    """One alert episode, with the pair's figures at its onset."""

    started_unix_s: float
    ended_unix_s: float | None  #: None: still active
    sentence: str
    pair: dict[str, float] | None
    nearest_m: float | None  #: of the pair, while the alert lasted
    frames: int


class TrendPoint(msgspec.Struct, frozen=True):
    """One second's latencies by stage, in the order of `telemetry.latency.STAGES`; milliseconds."""

    unix_s: float
    fps: int
    p50: tuple[float | None, ...]
    p95: tuple[float | None, ...]


class LiveState:
    """Listens to results and signals; `wait_changed` waits for either."""

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._clock, self._wall = clock, wall_clock
        self.result: FrameResult | None = None
        self.signal: Signal | None = None
        self.revision = 0  #: grows with every result and signal
        self.frame_count = 0  #: results received
        self.alerts: deque[AlertRecord] = deque(maxlen=ALERTS)
        self._episodes = EpisodeTracker()
        self.alerts_revision = 0  #: grows whenever `alerts` changes
        self.trend: deque[TrendPoint] = deque(maxlen=TREND_S)
        self.closed = False
        self._sentence = ""
        self._decision: Decision | None = None
        self._signal_s: float | None = None
        self._frame_s: float | None = None
        self._second: int | None = None
        self._collected: list[Mapping[str, float]] = []
        self._changed = asyncio.Event()

    async def on_frame_result(self, result: FrameResult) -> None:
        self.result = result
        self._frame_s = self._clock()
        self.frame_count += 1
        self._count_latency(result)
        self._follow_alert(result)
        self._notify()

    def on_signal(self, signal: Signal, sentence: str, decision: Decision | None) -> None:
        self.signal, self._sentence, self._decision = signal, sentence, decision
        self._signal_s = self._clock()
        self._notify()

    def close(self) -> None:
        """Ends all waiting."""
        self.closed = True
        self._notify()

    async def wait_changed(self, since: int, timeout_s: float) -> None:
        """Returns when `revision` is no longer `since`, or after `timeout_s`."""
        if self.revision != since or self.closed:
            return
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(self._changed.wait(), timeout_s)

    async def wait_frame(self, since: int) -> None:
        """Returns when `frame_count` is no longer `since`, or the state is closed."""
        while self.frame_count == since and not self.closed:
            await self._changed.wait()

    def snapshot(self) -> LiveSnapshot:
        """The present state for the page."""
        signal, result, now_s = self.signal, self.result, self._clock()
        decision = self._decision
        return LiveSnapshot(
            number=self.revision,
            signal="OFF" if signal is None else signal.name,
            colour="off" if signal is None else signal.colour.value,
            blink_hz=0.0 if signal is None else signal.blink_hz,
            sentence=self._sentence,
            detail="" if decision is None else decision.detail,
            decided=None if decision is None else decision.state.name,
            faults=() if signal is None else fault_texts(signal.faults),
            signal_age_s=None if self._signal_s is None else now_s - self._signal_s,
            frame=None if result is None else result.decoded.frame.number,
            frame_age_s=None if self._frame_s is None else now_s - self._frame_s,
            t_s=None if result is None else result.t_s,
            pair=None if result is None else _pair_record(result.tracking.decision.pair),
            tracks=[] if result is None else _track_records(result.tracking.tracks),
        )

    def _notify(self) -> None:
        self.revision += 1
        self._changed.set()
        self._changed = asyncio.Event()

    def _follow_alert(self, result: FrameResult) -> None:
        decision = result.tracking.decision
        pair = _pair_record(decision.pair)
        change = self._episodes.update(decision.state is State.ALERT)
        if change == "begins":
            self.alerts.append(
                AlertRecord(
                    started_unix_s=self._wall(),
                    ended_unix_s=None,
                    sentence=decision.sentence,
                    pair=pair,
                    nearest_m=None if pair is None else pair["distance_m"],
                    frames=1,
                )
            )
        elif change == "ends":
            self.alerts[-1].ended_unix_s = self._wall()
        elif change == "lasts":
            last = self.alerts[-1]
            last.frames += 1
            if pair is not None:
                nearest_m = math.inf if last.nearest_m is None else last.nearest_m
                last.nearest_m = min(nearest_m, pair["distance_m"])
        if change in ("begins", "ends"):
            self.alerts_revision += 1

    def _count_latency(self, result: FrameResult) -> None:
        wall_s = self._wall()
        second = int(wall_s)
        if self._second is not None and second != self._second and self._collected:
            self.trend.append(_trend_point(self._second, self._collected))
            self._collected = []
        self._second = second
        self._collected.append(result.latency_ms)


def _trend_point(second: int, rows: list[Mapping[str, float]]) -> TrendPoint:
    p50: list[float | None] = []
    p95: list[float | None] = []
    for stage in STAGES:
        values = [row[stage] for row in rows if stage in row]
        for column, percent in ((p50, 50), (p95, 95)):
            column.append(round(float(np.percentile(values, percent)), 2) if values else None)
    return TrendPoint(float(second), len(rows), tuple(p50), tuple(p95))


def _pair_record(pair: PairMetrics | None) -> dict[str, float] | None:
    """`PairMetrics` by field name, the ids as `cyclist` and `pedestrian`."""
    if pair is None:
        return None
    values = {k: v for k, v in dataclasses.asdict(pair).items() if math.isfinite(v)}
    return {name.removesuffix("_id"): round(value, 4) for name, value in values.items()}


def _track_records(tracks: Tracks) -> list[LiveTrack]:
    tracks = finite_tracks(tracks)
    rows = zip(track_records(tracks), tracks.unseen_s.round(2).tolist(), strict=True)
    return [LiveTrack(**msgspec.structs.asdict(track), unseen_s=unseen) for track, unseen in rows]
