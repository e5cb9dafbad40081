"""What the service does now, kept for whoever looks: the newest frame, the signal, the last alerts,
the latencies of the last minutes. Keeping costs the loop microseconds; nothing here waits."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Mapping

import msgspec
import numpy as np

from bikeped.decision.episodes import EpisodeTracker
from bikeped.faults import fault_texts
from bikeped.pipeline.frame_result import FrameResult
from bikeped.telemetry.latency import STAGES
from bikeped.types import Decision, Kind, PairMetrics, Signal, State

#: Alerts that are remembered.
ALERTS = 20
#: Seconds of latency history.
TREND_S = 120


class SeenTrack(msgspec.Struct, frozen=True):
    """A track as the radar draws it; metres and metres per second, x forward, y right."""

    id: int
    kind: str
    x: float
    y: float
    vx: float
    vy: float
    unseen_s: float


class SeenPair(msgspec.Struct, frozen=True):
    """The figures that a pair was judged by, as `types.PairMetrics` has them."""

    cyclist: int
    pedestrian: int
    distance_m: float
    distance_then_m: float
    lookback_s: float
    displacement_m: float
    speed_mps: float
    d_min_m: float
    d_max_m: float


class LiveSnapshot(msgspec.Struct, frozen=True):
    """What is known at this moment. Ages are seconds; None: nothing has come yet."""

    number: int
    signal: str
    colour: str
    blink_hz: float
    sentence: str
    decided: str | None
    faults: tuple[str, ...]
    signal_age_s: float | None  #: since the light was last told something
    frame: int | None
    frame_age_s: float | None  #: since the newest frame was judged
    t_s: float | None
    pair: SeenPair | None
    tracks: tuple[SeenTrack, ...]


class AlertRecord(msgspec.Struct):
    """One ALERT from its first frame to its last, with the figures that fired it."""

    started_unix_s: float
    ended_unix_s: float | None  #: None: it lasts
    sentence: str
    pair: SeenPair | None
    nearest_m: float | None  #: of the pair, while the alert lasted
    frames: int


class TrendPoint(msgspec.Struct, frozen=True):
    """One second's latencies by stage, in the order of `telemetry.latency.STAGES`; milliseconds."""

    unix_s: float
    fps: int
    p50: tuple[float | None, ...]
    p95: tuple[float | None, ...]


class LiveState:
    """An output and signal listener of the loop that remembers; `changed` waits for news."""

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._clock, self._wall = clock, wall_clock
        self.result: FrameResult | None = None
        self.signal_now: Signal | None = None
        self.number = 0  #: grows with every piece of news
        self.frames = 0  #: grows with every frame
        self.alerts: deque[AlertRecord] = deque(maxlen=ALERTS)
        self._episodes = EpisodeTracker()
        self.alerts_number = 0  #: grows whenever `alerts` changes
        self.trend: deque[TrendPoint] = deque(maxlen=TREND_S)
        self.closed = False
        self._sentence = ""
        self._decision: Decision | None = None
        self._signal_s: float | None = None
        self._frame_s: float | None = None
        self._second: int | None = None
        self._collected: list[Mapping[str, float]] = []
        self._news = asyncio.Event()

    async def on_frame_result(self, result: FrameResult) -> None:
        self.result = result
        self._frame_s = self._clock()
        self.frames += 1
        self._count_latency(result)
        self._follow_alert(result)
        self._tell()

    def on_signal(self, signal: Signal, sentence: str, decision: Decision | None) -> None:
        self.signal_now, self._sentence, self._decision = signal, sentence, decision
        self._signal_s = self._clock()
        self._tell()

    def close(self) -> None:
        """Ends all waiting: nothing more will come."""
        self.closed = True
        self._tell()

    async def changed(self, since: int, timeout_s: float) -> None:
        """Returns when there is news after number `since`, or after `timeout_s`."""
        if self.number != since or self.closed:
            return
        try:
            await asyncio.wait_for(self._news.wait(), timeout_s)
        except asyncio.TimeoutError:
            return

    async def next_frame(self, since: int) -> None:
        """Returns when there is a frame after frame number `since`, or closed."""
        while self.frames == since and not self.closed:
            await self._news.wait()

    def snapshot(self) -> LiveSnapshot:
        """Everything that a page shows of this moment."""
        signal, result, now_s = self.signal_now, self.result, self._clock()
        decision = self._decision
        return LiveSnapshot(
            number=self.number,
            signal="OFF" if signal is None else signal.name,
            colour="off" if signal is None else signal.colour.value,
            blink_hz=0.0 if signal is None else signal.blink_hz,
            sentence=self._sentence,
            decided=None if decision is None else decision.state.name,
            faults=() if signal is None else fault_texts(signal.faults),
            signal_age_s=None if self._signal_s is None else now_s - self._signal_s,
            frame=None if result is None else result.decoded.frame.number,
            frame_age_s=None if self._frame_s is None else now_s - self._frame_s,
            t_s=None if result is None else result.t_s,
            pair=None if result is None else _pair(result.tracking.decision.pair),
            tracks=() if result is None else _tracks(result),
        )

    def _tell(self) -> None:
        self.number += 1
        self._news.set()
        self._news = asyncio.Event()

    def _follow_alert(self, result: FrameResult) -> None:
        decision = result.tracking.decision
        pair = _pair(decision.pair)
        change = self._episodes.update(decision.state is State.ALERT)
        if change == "begins":
            self.alerts.append(
                AlertRecord(
                    started_unix_s=self._wall(),
                    ended_unix_s=None,
                    sentence=decision.sentence,
                    pair=pair,
                    nearest_m=None if pair is None else pair.distance_m,
                    frames=1,
                )
            )
        elif change == "ends":
            self.alerts[-1].ended_unix_s = self._wall()
        elif change == "lasts":
            last = self.alerts[-1]
            last.frames += 1
            if pair is not None and (last.nearest_m is None or pair.distance_m < last.nearest_m):
                last.nearest_m = pair.distance_m
        if change in ("begins", "ends"):
            self.alerts_number += 1

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
        if values:
            middle, high = np.percentile(values, (50, 95)).tolist()
            p50.append(round(middle, 2))
            p95.append(round(high, 2))
        else:
            p50.append(None)
            p95.append(None)
    return TrendPoint(float(second), len(rows), tuple(p50), tuple(p95))


def _pair(pair: PairMetrics | None) -> SeenPair | None:
    if pair is None:
        return None
    return SeenPair(
        cyclist=pair.cyclist_id,
        pedestrian=pair.pedestrian_id,
        distance_m=round(pair.distance_m, 3),
        distance_then_m=round(pair.distance_then_m, 3),
        lookback_s=round(pair.lookback_s, 4),
        displacement_m=round(pair.displacement_m, 3),
        speed_mps=round(pair.speed_mps, 3),
        d_min_m=round(pair.d_min_m, 3),
        d_max_m=round(pair.d_max_m, 3),
    )


def _tracks(result: FrameResult) -> tuple[SeenTrack, ...]:
    tracks = result.tracking.tracks
    rows = zip(
        tracks.id.tolist(),
        tracks.kind.tolist(),
        tracks.xy_m.round(3).tolist(),
        tracks.velocity_mps.round(3).tolist(),
        tracks.unseen_s.round(2).tolist(),
        strict=True,
    )
    return tuple(
        SeenTrack(number, Kind(kind).label, xy[0], xy[1], velocity[0], velocity[1], unseen)
        for number, kind, xy, velocity, unseen in rows
    )
