"""The deployed tracker, predictor and rules over many scenes at once.

A lane is one scene: a scenario, or one Monte Carlo trial of it. All lanes step through the same
frames in the same tracker; what comes out are track rows, on which the rules are asked once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bikeped.decision import (
    PairChecks,
    Pairs,
    RuleSettings,
    TrackRows,
    evaluate_rule,
    frame_mask,
    is_remembered,
    pair_rows,
    resolve_state,
)
from bikeped.tracking import BatchTracker, TrackerSettings, predict
from bikeped.types import BoolArray, FloatArray, IntArray, Kind, KindArray

FPS = 30.0
#: The paper's simulation tracker (definitions, section 7): the defaults of TrackerSettings.
SIMULATION_TRACKER = TrackerSettings()


@dataclass(frozen=True)
class DetectionSequence:
    """Detections of one lane: positions [f, a, 2] in the camera ground frame, `detected` [f, a]."""

    xy_m: FloatArray
    detected: BoolArray
    kind: KindArray
    delay_frames: int = 0


@dataclass(frozen=True)
class TrackHistory:
    """What the tracker reported in every lane and frame, as arrays [f, lane, slot].

    Before prediction: `build_rule_input` makes the rows that the rules read.
    """

    reported: BoolArray
    id: IntArray
    kind: KindArray
    xy_m: FloatArray
    velocity_mps: FloatArray
    acceleration_mps2: FloatArray
    frames: IntArray  #: [lane]: frames of each lane; later ones are padding
    delay_frames: IntArray  #: [lane]

    @property
    def lanes(self) -> int:
        return len(self.frames)


def track(
    scenes: Sequence[DetectionSequence], settings: TrackerSettings = SIMULATION_TRACKER
) -> TrackHistory:
    """Runs the tracker over all scenes side by side."""
    lanes = len(scenes)
    frames = np.asarray([len(s.xy_m) for s in scenes])
    longest = int(frames.max())
    agents = max(s.xy_m.shape[1] for s in scenes)
    xy = np.zeros((longest, lanes, agents, 2))
    kind = np.full((longest, lanes, agents), -1, np.int8)
    for lane, scene in enumerate(scenes):
        late = scene.delay_frames
        count = len(scene.xy_m) - late
        if count <= 0:
            continue
        width = scene.xy_m.shape[1]
        there = scene.detected[:count]
        xy[late : late + count, lane, :width] = np.where(there[..., None], scene.xy_m[:count], 0.0)
        kind[late : late + count, lane, :width] = np.where(there, scene.kind, -1)
    tracker = BatchTracker(settings, lanes, slots=max(2 * agents, 4))
    history = _history(longest, tracker)
    for frame in range(longest):
        tracker.update(frame / FPS, xy[frame], kind[frame])
        if tracker.alive.shape[1] > history[0].shape[2]:
            old, history = history, _history(longest, tracker)
            for wide, narrow in zip(history, old, strict=True):
                wide[:, :, : narrow.shape[2]] = narrow
        for array, now in zip(history, _arrays(tracker), strict=True):
            array[frame] = now
    inside = np.arange(longest)[:, None] < frames[None, :]
    reported, number, kinds, position, velocity, acceleration = history
    return TrackHistory(
        reported=reported & inside[..., None],
        id=number,
        kind=kinds,
        xy_m=position,
        velocity_mps=velocity,
        acceleration_mps2=acceleration,
        frames=frames,
        delay_frames=np.asarray([s.delay_frames for s in scenes]),
    )


def delay_history(tracked: TrackHistory, frames: int) -> TrackHistory:
    """What the tracker reports when the same detections come `frames` frames later.

    A tracker knows time differences only, so its report is the same, later; nothing until then.
    """
    if frames == 0:
        return tracked
    longest = len(tracked.reported)
    late = min(frames, longest)

    def later(array: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
        out = np.zeros_like(array)
        out[late:] = array[: longest - late]
        return out

    inside = np.arange(longest)[:, None] < tracked.frames[None, :]
    return replace(
        tracked,
        reported=later(tracked.reported) & inside[..., None],
        id=later(tracked.id),
        kind=later(tracked.kind),
        xy_m=later(tracked.xy_m),
        velocity_mps=later(tracked.velocity_mps),
        acceleration_mps2=later(tracked.acceleration_mps2),
        delay_frames=tracked.delay_frames + frames,
    )


def _arrays(tracker: BatchTracker) -> tuple[np.ndarray, ...]:  # type: ignore[type-arg]
    """What is kept of every frame, in the order of `TrackHistory`."""
    return (
        tracker.reported,
        tracker.id,
        tracker.kind,
        tracker.xy_m,
        tracker.velocity_mps,
        tracker.acceleration_mps2,
    )


def _history(frames: int, tracker: BatchTracker) -> list[np.ndarray]:  # type: ignore[type-arg]
    """Room for every frame; made again, wider, when the tracker's slots have grown."""
    return [np.zeros((frames, *a.shape), a.dtype) for a in _arrays(tracker)]


@dataclass(frozen=True)
class RuleInput:
    """Track rows of all lanes with their pairs: what any number of rules can be asked of.

    Frames are counted over all lanes in turn: frame `start[lane] + i` is frame i of a lane.
    """

    rows: TrackRows
    pairs: Pairs
    start: IntArray
    frames: IntArray
    time_s: FloatArray
    pedestrian: BoolArray
    cyclist_last_s: FloatArray

    def frame_slice(self, lane: int) -> slice:
        """Where a lane's frames lie in arrays over all frames."""
        begin = int(self.start[lane])
        return slice(begin, begin + int(self.frames[lane]))


def build_rule_input(tracked: TrackHistory, order: int = 0) -> RuleInput:
    """The rows that the rules read, predicted ahead by each lane's delay with `order`."""
    # Lane-major order, so that a lane's frames are neighbours.
    reported = tracked.reported.transpose(1, 0, 2)
    lane, frame, slot = np.nonzero(reported)
    ids = tracked.id[frame, lane, slot]
    # Within a frame in track order (ascending id): slots are reused, ids are not.
    # One key and a stable sort: it is quick on what is nearly sorted already.
    key = (lane * reported.shape[1] + frame) * (int(ids.max(initial=0)) + 1) + ids
    order_index = np.argsort(key, kind="stable")
    lane, frame, slot, ids = (a[order_index] for a in (lane, frame, slot, ids))
    start = np.concatenate([[0], np.cumsum(tracked.frames)[:-1]])
    number = np.full(reported.shape, -1, np.intp)
    number[lane, frame, slot] = np.arange(len(lane))
    before = np.where(frame > 0, number[lane, np.maximum(frame - 1, 0), slot], -1)
    same = (before >= 0) & (ids[np.maximum(before, 0)] == ids)
    total = int(tracked.frames.sum())
    at = (frame, lane, slot)
    rows = TrackRows(
        frame=(start[lane] + frame).astype(np.intp),
        time_s=frame / FPS,
        id=ids,
        kind=tracked.kind[at],
        xy_m=predict(
            tracked.xy_m[at],
            tracked.velocity_mps[at] if order else tracked.xy_m[:0],
            tracked.acceleration_mps2[at] if order > 1 else None,
            (tracked.delay_frames / FPS)[lane][:, None],
            order,
        ),
        previous=np.where(same, before, -1),
    )
    time_s = np.concatenate([np.arange(n) / FPS for n in tracked.frames])
    cyclist = frame_mask(rows.frame[rows.kind == int(Kind.CYCLIST)], total)
    last = np.where(cyclist, time_s, -np.inf)
    for begin, count in zip(start, tracked.frames, strict=True):
        part = last[begin : begin + count]
        np.maximum.accumulate(part, out=part)
    return RuleInput(
        rows=rows,
        pairs=pair_rows(rows, total),
        start=start,
        frames=tracked.frames,
        time_s=time_s,
        pedestrian=frame_mask(rows.frame[rows.kind == int(Kind.PEDESTRIAN)], total),
        cyclist_last_s=last,
    )


def verdicts(run: RuleInput, settings: RuleSettings) -> PairChecks:
    """What the rule says of every pair of every frame."""
    return evaluate_rule(run.rows, run.pairs, settings)


def states(
    run: RuleInput, settings: RuleSettings
) -> np.ndarray[tuple[int, ...], np.dtype[np.int8]]:
    """State codes of every frame of every lane, lane after lane."""
    fired = verdicts(run, settings).fires
    approaching = frame_mask(run.rows.frame[run.pairs.pedestrian_row[fired]], len(run.time_s))
    memory = is_remembered(run.time_s, run.cyclist_last_s, settings.memory_s)
    return resolve_state(run.pedestrian, memory, approaching)
