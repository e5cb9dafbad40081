"""The decision frame by frame, with its reasons in words."""

from __future__ import annotations

import math

import numpy as np

from bikeped.decision.rows import CYCLIST, PEDESTRIAN, IndexArray, TrackRows, pair_rows
from bikeped.decision.rules import PairVerdicts, RuleSettings, judge
from bikeped.decision.stages import remembered, resolve
from bikeped.types import (
    Decision,
    FloatArray,
    IntArray,
    KindArray,
    PairNumbers,
    State,
)


class Decider:
    """Holds the last fraction of a second of positions and the cyclist memory.

    `step` once a frame, with the reported tracks in ascending id and times that increase.
    """

    def __init__(self, settings: RuleSettings) -> None:
        self.settings = settings
        self._rows = _NO_ROWS
        self._starts: list[tuple[float, int]] = []  #: time and first row of each frame held
        self._last_cyclist_s = -math.inf
        self._span_s = max(settings.lookback_s, settings.speed_window_s)

    def step(self, time_s: float, ids: IntArray, kind: KindArray, xy_m: FloatArray) -> Decision:
        """The decision at `time_s`; `ids` [n] ascending, `kind` [n], `xy_m` [n, 2]."""
        self._append(time_s, ids, kind, xy_m)
        verdicts, pair_ids = _judge_newest(self._rows, len(self._starts), self.settings)
        if (kind == CYCLIST).any():
            self._last_cyclist_s = time_s
        pedestrians = int((kind == PEDESTRIAN).sum())
        state = State(
            int(
                resolve(
                    np.asarray([pedestrians > 0]),
                    remembered(
                        np.asarray([time_s]),
                        np.asarray([self._last_cyclist_s]),
                        self.settings.memory_s,
                    ),
                    np.asarray([bool(verdicts.fires.any())]),
                )[0]
            )
        )
        pair = _chosen(state, verdicts, pair_ids, self.settings)
        since = time_s - self._last_cyclist_s
        return Decision(
            time_s, state, explain(state, pair, pedestrians, since, self.settings), pair
        )

    def _append(self, time_s: float, ids: IntArray, kind: KindArray, xy_m: FloatArray) -> None:
        """Adds the newest frame's rows and drops frames older than the rules look back."""
        starts, rows = self._starts, self._rows
        if starts and time_s <= starts[-1][0]:
            raise ValueError(f"time_s: {time_s} is not after the last frame's {starts[-1][0]}")
        # One frame beyond the span is kept: the older neighbour of an interpolation.
        drop = 0
        while drop + 2 < len(starts) and starts[drop + 1][0] < time_s - self._span_s - 1e-6:
            drop += 1
        cut = starts[drop][1] if drop else 0
        held, last = len(rows) - cut, (starts[-1][1] if starts else 0)
        previous: IndexArray = np.full(len(ids), -1, np.intp)
        before = rows.id[last:]
        if len(ids) and len(before):
            place = np.minimum(np.searchsorted(before, ids), len(before) - 1)
            previous = np.where(before[place] == ids, place + (last - cut), -1)
        self._starts = [(t, row - cut) for t, row in starts[drop:]] + [(time_s, held)]
        self._rows = TrackRows(
            frame=np.concatenate(
                [rows.frame[cut:] - drop, np.full(len(ids), len(self._starts) - 1, np.intp)]
            ),
            time_s=np.concatenate([rows.time_s[cut:], np.full(len(ids), time_s)]),
            id=np.concatenate([rows.id[cut:], ids]),
            kind=np.concatenate([rows.kind[cut:], kind]),
            xy_m=np.concatenate([rows.xy_m[cut:], xy_m]),
            previous=np.concatenate([np.maximum(rows.previous[cut:] - cut, -1), previous]),
        )


_NO_ROWS = TrackRows(
    frame=np.zeros(0, np.intp),
    time_s=np.zeros(0),
    id=np.zeros(0, np.int64),
    kind=np.zeros(0, np.int8),
    xy_m=np.zeros((0, 2)),
    previous=np.zeros(0, np.intp),
)


def _judge_newest(
    rows: TrackRows, frames: int, settings: RuleSettings
) -> tuple[PairVerdicts, IntArray]:
    pairs = pair_rows(rows, frames, frames - 1)
    verdicts = judge(rows, pairs, settings)
    ids = np.stack([rows.id[pairs.cyclist_row[pairs.cyclist]], rows.id[pairs.pedestrian_row]], 1)
    return verdicts, ids


def _chosen(
    state: State,
    verdicts: PairVerdicts,
    ids: IntArray,
    settings: RuleSettings,
) -> PairNumbers | None:
    """The first pair in track order that fired (ALERT), or the nearest pair (WARNING)."""
    if state is State.ALERT:
        index = int(np.argmax(verdicts.fires))
    elif state is State.WARNING and len(verdicts.distance_m):
        index = int(np.argmin(verdicts.distance_m))
    else:
        return None
    return PairNumbers(
        cyclist_id=int(ids[index][0]),
        pedestrian_id=int(ids[index][1]),
        distance_m=float(verdicts.distance_m[index]),
        distance_then_m=float(verdicts.distance_then_m[index]),
        lookback_s=float(verdicts.lookback_s[index]),
        displacement_m=float(verdicts.displacement_m[index]),
        speed_mps=float(verdicts.speed_mps[index]),
        d_min_m=settings.d_min_m,
        d_max_m=float(verdicts.d_max_m[index]),
    )


def explain(
    state: State,
    pair: PairNumbers | None,
    pedestrians: int,
    since_cyclist_s: float,
    settings: RuleSettings,
) -> str:
    """One line that a resident can read, with the numbers that made the decision."""
    if state is State.IDLE:
        return "IDLE: no pedestrian is tracked."
    people = "1 pedestrian is" if pedestrians == 1 else f"{pedestrians} pedestrians are"
    if state is State.SAFE:
        return (
            f"SAFE: {people} tracked and no cyclist was within the last {settings.memory_s:.1f} s."
        )
    if pair is None:
        return (
            f"WARNING: {people} tracked and a cyclist was {since_cyclist_s:.1f} s ago; "
            "none is there now."
        )
    who = f"cyclist {pair.cyclist_id} and pedestrian {pair.pedestrian_id}"
    gap = f"{pair.distance_m:.2f} m apart"
    then = f"{pair.distance_then_m:.2f} m {pair.lookback_s:.2f} s ago"
    if state is State.ALERT:
        moved = f"the cyclist moved {pair.displacement_m:.2f} m at {pair.speed_mps:.1f} m/s"
        bounds = f"{pair.d_min_m:g} to {pair.d_max_m:.1f} m"
        if settings.rule == "distance":
            return f"ALERT: {who} are {gap}, within {bounds} (rule distance)."
        return (
            f"ALERT: {who} are {gap}, were {then}; {moved}; alerts within {bounds} "
            f"(rule {settings.rule})."
        )
    return f"WARNING: {who} are {gap}, {_why_not(pair, settings)}."


def _why_not(pair: PairNumbers, settings: RuleSettings) -> str:
    """Why the nearest pair does not alert."""
    if pair.distance_m < pair.d_min_m:
        return f"nearer than the {pair.d_min_m:g} m at which a warning still helps"
    if pair.distance_m > pair.d_max_m:
        return f"farther than {pair.d_max_m:.1f} m"
    if pair.lookback_s <= 0:
        return f"just appeared, or more than {settings.max_range_m:g} m from the camera"
    if settings.rule == "ttc":
        return f"were {pair.distance_then_m:.2f} m {pair.lookback_s:.2f} s ago: not soon together"
    if pair.distance_m >= pair.distance_then_m - 1e-9:
        return f"were {pair.distance_then_m:.2f} m {pair.lookback_s:.2f} s ago: not closing"
    return (
        f"closing, but the cyclist moved only {pair.displacement_m:.2f} m in "
        f"{pair.lookback_s:.2f} s"
    )
