"""The deployed tracker, predictor and rules over many scenes at once.

A lane is one scene: a scenario, or one Monte Carlo trial of it. All lanes step through the same
frames in the same tracker; what comes out are track rows, on which the rules are asked once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bikeped.decision import (
    Pairs,
    PairVerdicts,
    RuleSettings,
    TrackRows,
    frames_with,
    judge,
    pair_rows,
    remembered,
    resolve,
)
from bikeped.tracking import LaneTracker, TrackerSettings, predict
from bikeped.types import BoolArray, FloatArray, IntArray, Kind, KindArray

FPS = 30.0
#: The paper's simulation tracker (definitions, section 7): the defaults of TrackerSettings.
SIMULATION_TRACKER = TrackerSettings()


@dataclass(frozen=True)
class Scene:
    """Detections of one lane: positions [f, a, 2] in the camera ground frame, `detected` [f, a]."""

    xy_m: FloatArray
    detected: BoolArray
    kind: KindArray
    delay_frames: int = 0


@dataclass(frozen=True)
class Tracked:
    """What the tracker reported in every lane and frame, as arrays [f, lane, slot].

    Before prediction: `predicted` makes the rows that the rules read.
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


def track(scenes: Sequence[Scene], settings: TrackerSettings = SIMULATION_TRACKER) -> Tracked:
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
    tracker = LaneTracker(settings, lanes, slots=max(2 * agents, 4))
    steps = []
    for frame in range(longest):
        tracker.update(frame / FPS, xy[frame], kind[frame])
        steps.append(
            (
                tracker.reported,
                tracker.id.copy(),
                tracker.kind.copy(),
                tracker.xy_m.copy(),
                tracker.velocity_mps.copy(),
                tracker.acceleration_mps2.copy(),
            )
        )
    slots = tracker.alive.shape[1]
    stacked = [np.stack([_wide(step[i], slots) for step in steps]) for i in range(6)]
    inside = np.arange(longest)[:, None] < frames[None, :]
    return Tracked(
        reported=stacked[0] & inside[..., None],
        id=stacked[1],
        kind=stacked[2],
        xy_m=stacked[3],
        velocity_mps=stacked[4],
        acceleration_mps2=stacked[5],
        frames=frames,
        delay_frames=np.asarray([s.delay_frames for s in scenes]),
    )


@dataclass(frozen=True)
class Run:
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

    def lane_slice(self, lane: int) -> slice:
        """Where a lane's frames lie in arrays over all frames."""
        begin = int(self.start[lane])
        return slice(begin, begin + int(self.frames[lane]))


def rows_of(tracked: Tracked, order: int = 0) -> Run:
    """The rows that the rules read, predicted ahead by each lane's delay with `order`."""
    ahead_s = (tracked.delay_frames / FPS)[None, :, None, None]
    xy = predict(tracked.xy_m, tracked.velocity_mps, tracked.acceleration_mps2, ahead_s, order)
    # Lane-major order, so that a lane's frames are neighbours.
    reported = tracked.reported.transpose(1, 0, 2)
    lane, frame, slot = np.nonzero(reported)
    ids = tracked.id[frame, lane, slot]
    # Within a frame in track order (ascending id): slots are reused, ids are not.
    order_index = np.lexsort((ids, frame, lane))
    lane, frame, slot, ids = (a[order_index] for a in (lane, frame, slot, ids))
    start = np.concatenate([[0], np.cumsum(tracked.frames)[:-1]])
    number = np.full(reported.shape, -1, np.intp)
    number[lane, frame, slot] = np.arange(len(lane))
    before = np.where(frame > 0, number[lane, np.maximum(frame - 1, 0), slot], -1)
    same = (before >= 0) & (ids[np.maximum(before, 0)] == ids)
    total = int(tracked.frames.sum())
    rows = TrackRows(
        frame=(start[lane] + frame).astype(np.intp),
        time_s=frame / FPS,
        id=ids,
        kind=tracked.kind[frame, lane, slot],
        xy_m=xy[frame, lane, slot],
        previous=np.where(same, before, -1),
    )
    time_s = np.concatenate([np.arange(n) / FPS for n in tracked.frames])
    cyclist = frames_with(rows.frame[rows.kind == int(Kind.CYCLIST)], total)
    last = np.where(cyclist, time_s, -np.inf)
    for begin, count in zip(start, tracked.frames, strict=True):
        part = last[begin : begin + count]
        np.maximum.accumulate(part, out=part)
    return Run(
        rows=rows,
        pairs=pair_rows(rows, total),
        start=start,
        frames=tracked.frames,
        time_s=time_s,
        pedestrian=frames_with(rows.frame[rows.kind == int(Kind.PEDESTRIAN)], total),
        cyclist_last_s=last,
    )


def verdicts(run: Run, settings: RuleSettings) -> PairVerdicts:
    """What the rule says of every pair of every frame."""
    return judge(run.rows, run.pairs, settings)


def states(run: Run, settings: RuleSettings) -> np.ndarray[tuple[int, ...], np.dtype[np.int8]]:
    """State codes of every frame of every lane, lane after lane."""
    fired = verdicts(run, settings).fires
    approaching = frames_with(run.rows.frame[run.pairs.pedestrian_row[fired]], len(run.time_s))
    memory = remembered(run.time_s, run.cyclist_last_s, settings.memory_s)
    return resolve(run.pedestrian, memory, approaching)


def _wide(array: np.ndarray, slots: int) -> np.ndarray:  # type: ignore[type-arg]
    """Pads the slots axis, which may have grown during the run."""
    missing = slots - array.shape[1]
    if not missing:
        return array
    return np.pad(array, [(0, 0), (0, missing)] + [(0, 0)] * (array.ndim - 2))
