"""The deployed tracker (or the paper's), predictor and rules over a batch of detection sequences.

An element of the batch is a scenario, or one Monte Carlo trial of it. All elements step through the
same frames in one tracker; it gives track rows, on which a rule is evaluated once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from bikeped.config.build import rule_settings, tracker_settings
from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.decision.rules import (
    PairChecks,
    RuleSettings,
    evaluate_rule,
    is_remembered,
    resolve_state,
)
from bikeped.decision.shown import AS_RAW, shown_alert, shown_states
from bikeped.decision.track_rows import Pairs, TrackRows, pair_rows
from bikeped.decision.who_counts import counts
from bikeped.lab.simulation.paper_tracker import PaperTracker
from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.tracking.tracker import predict
from bikeped.types import BoolArray, FloatArray, IntArray, Kind, KindArray, State

FPS = 30.0
DEFAULT_RULE = RuleSettings()
TrackerName = Literal["deployed", "paper"]
StateArray = npt.NDArray[np.int8]


@dataclass(frozen=True)
class SimulatedTracker:
    """Which tracker a simulation uses, and what comes with it (definitions, section 7).

    `settings` are those of the configuration; None: the paper's own tracker, with which every track
    counts and the light shows the raw state.
    """

    settings: TrackerSettings | None

    @staticmethod
    def of(loaded: LoadedConfig, name: TrackerName = "deployed") -> SimulatedTracker:
        """The tracker of a configuration as the pole runs it, or the paper's."""
        if name == "paper":
            return PAPER
        config = loaded.config
        fps = config.decision.nominal_fps
        return SimulatedTracker(tracker_settings(config.tracking, fps, acceleration=True))

    @property
    def name(self) -> TrackerName:
        return "paper" if self.settings is None else "deployed"

    def rule(self, decision: DecisionConfig) -> RuleSettings:
        """The decision's parameters as this tracker's simulation has them."""
        settings = rule_settings(decision)
        if self.settings is not None:
            return settings
        return replace(settings, max_unseen_s=math.inf, count_all=True, shown=AS_RAW)


PAPER = SimulatedTracker(None)


@dataclass(frozen=True)
class DetectionSequence:
    """Detections of one batch element: positions [f, a, 2] (m) in the camera ground frame,
    `detected` [f, a], `kind` [a]; `delay_frames`: how late they reach the tracker."""

    xy_m: FloatArray
    detected: BoolArray
    kind: KindArray
    delay_frames: int = 0


#: The tracker's arrays that a history keeps, in the order of `TrackHistory`.
_STATE = ("reported", "id", "kind", "xy_m", "velocity_mps", "acceleration_mps2", "seen_s", "parked")


@dataclass(frozen=True)
class TrackHistory:
    """What the tracker reported in every frame, as arrays [f, batch, slot], before prediction."""

    reported: BoolArray
    id: IntArray
    kind: KindArray
    xy_m: FloatArray
    velocity_mps: FloatArray
    acceleration_mps2: FloatArray
    seen_s: FloatArray
    parked: BoolArray
    frames: IntArray  #: [batch]: frames of each element; later ones are padding
    delay_frames: IntArray  #: [batch]

    def select(self, part: slice) -> TrackHistory:
        """The history of a part of the batch."""
        arrays = {name: getattr(self, name)[:, part] for name in _STATE}
        return TrackHistory(
            **arrays, frames=self.frames[part], delay_frames=self.delay_frames[part]
        )


def track(sequences: Sequence[DetectionSequence], use: SimulatedTracker) -> TrackHistory:
    """Runs the tracker over all sequences side by side."""
    batch = len(sequences)
    frames = np.asarray([len(s.xy_m) for s in sequences])
    longest = int(frames.max())
    agents = max(s.xy_m.shape[1] for s in sequences)
    xy: FloatArray = np.zeros((longest, batch, agents, 2))
    kind: KindArray = np.full((longest, batch, agents), -1, np.int8)
    for index, sequence in enumerate(sequences):
        late = sequence.delay_frames
        count = len(sequence.xy_m) - late
        if count <= 0:
            continue
        at = (slice(late, late + count), index, slice(sequence.xy_m.shape[1]))
        detected = sequence.detected[:count]
        xy[at] = np.where(detected[..., None], sequence.xy_m[:count], 0.0)
        kind[at] = np.where(detected, sequence.kind, -1)
    tracker: BatchTracker | PaperTracker
    if use.settings is None:
        tracker = PaperTracker(batch, agents, FPS)
    else:
        # In traffic few of all agents are there at a time: those who are come first.
        order = np.argsort(kind < 0, axis=2, kind="stable")[
            ..., : max(int((kind >= 0).sum(2).max()), 1)
        ]
        kind = np.take_along_axis(kind, order, 2)
        xy = np.take_along_axis(xy, order[..., None], 2)
        tracker = BatchTracker(use.settings, batch, slots=max(2 * order.shape[2], 4))
    history = _empty_history(longest, tracker)
    for frame in range(longest):
        tracker.update(frame / FPS, xy[frame], kind[frame])
        if tracker.alive.shape[1] > history["id"].shape[2]:
            old, history = history, _empty_history(longest, tracker)
            for name, narrow in old.items():
                history[name][:, :, : narrow.shape[2]] = narrow
        for name, array in history.items():
            array[frame] = getattr(tracker, name)
    history["reported"] &= (np.arange(longest)[:, None] < frames[None, :])[..., None]
    delays = np.asarray([s.delay_frames for s in sequences])
    return TrackHistory(**history, frames=frames, delay_frames=delays)


def delay_history(history: TrackHistory, frames: int) -> TrackHistory:
    """What the tracker reports when the same detections come `frames` frames later.

    A tracker knows time differences only, so its report is the same, later; nothing until then.
    """
    if frames == 0:
        return history
    longest = len(history.reported)
    late = min(frames, longest)
    arrays = {}
    for name in _STATE:
        array = getattr(history, name)
        arrays[name] = np.zeros_like(array)
        arrays[name][late:] = array[: longest - late]
    arrays["reported"] &= (np.arange(longest)[:, None] < history.frames[None, :])[..., None]
    arrays["seen_s"] += frames / FPS
    return replace(history, **arrays, delay_frames=history.delay_frames + frames)


def _empty_history(frames: int, tracker: BatchTracker | PaperTracker) -> dict[str, Any]:
    """Arrays for every frame; made again, wider, when the tracker's slots have grown."""
    arrays = {name: getattr(tracker, name) for name in _STATE}
    return {name: np.zeros((frames, *a.shape), a.dtype) for name, a in arrays.items()}


@dataclass(frozen=True)
class RuleInput:
    """Track rows of the whole batch with their pairs: the input of any number of rules.

    Frames are numbered over all elements in turn: `start[index] + i` is frame i of an element.
    `time_s`, `pedestrian` (one counts as present) and `cyclist_last_s` (time of the last cyclist
    that counts; -inf before the first) are by frame.
    """

    rows: TrackRows
    pairs: Pairs
    start: IntArray
    frames: IntArray
    time_s: FloatArray
    pedestrian: BoolArray
    cyclist_last_s: FloatArray

    def frame_slice(self, index: int) -> slice:
        """Where an element's frames lie in arrays over all frames."""
        begin = int(self.start[index])
        return slice(begin, begin + int(self.frames[index]))


def build_rule_input(
    history: TrackHistory, order: int = 0, settings: RuleSettings = DEFAULT_RULE
) -> RuleInput:
    """The rows that the rules read, predicted ahead by each element's delay.

    `order` of the prediction: 0 none, 1 velocity, 2 acceleration. Of the `settings` only those that
    say who counts: `max_unseen_s` and `count_all`.
    """
    # Element-major order, so that an element's frames are neighbours.
    reported = history.reported.transpose(1, 0, 2)
    element, frame, slot = np.nonzero(reported)
    ids = history.id[frame, element, slot]
    # Within a frame in track order (ascending id): slots are reused, ids are not.
    # One key and a stable sort, which is fast on what is nearly sorted already.
    key = (element * reported.shape[1] + frame) * (int(ids.max(initial=0)) + 1) + ids
    order_index = np.argsort(key, kind="stable")
    element, frame, slot, ids = (a[order_index] for a in (element, frame, slot, ids))
    start = np.concatenate([[0], np.cumsum(history.frames)[:-1]])
    number = np.full(reported.shape, -1, np.intp)
    number[element, frame, slot] = np.arange(len(element))
    before = np.where(frame > 0, number[element, np.maximum(frame - 1, 0), slot], -1)
    same = (before >= 0) & (ids[np.maximum(before, 0)] == ids)
    total = int(history.frames.sum())
    at = (frame, element, slot)
    unseen_s = frame / FPS - history.seen_s[at]
    counted = counts(unseen_s, history.parked[at], settings.max_unseen_s) | settings.count_all
    rows = TrackRows(
        frame=(start[element] + frame).astype(np.intp),
        time_s=frame / FPS,
        id=ids,
        kind=history.kind[at],
        xy_m=predict(
            history.xy_m[at],
            history.velocity_mps[at] if order else history.xy_m[:0],
            history.acceleration_mps2[at] if order > 1 else None,
            (history.delay_frames / FPS)[element][:, None],
            order,
        ),
        velocity_mps=history.velocity_mps[at],
        counts=counted,
        previous=np.where(same, before, -1),
    )
    time_s = np.concatenate([np.arange(n) / FPS for n in history.frames])
    present = {
        kind: np.bincount(rows.frame[counted & (rows.kind == int(kind))], minlength=total) > 0
        for kind in (Kind.CYCLIST, Kind.PEDESTRIAN)
    }
    last = np.where(present[Kind.CYCLIST], time_s, -np.inf)
    for begin, count in zip(start, history.frames, strict=True):
        part = last[begin : begin + count]
        np.maximum.accumulate(part, out=part)
    return RuleInput(
        rows=rows,
        pairs=pair_rows(rows),
        start=start,
        frames=history.frames,
        time_s=time_s,
        pedestrian=present[Kind.PEDESTRIAN],
        cyclist_last_s=last,
    )


def verdicts(run: RuleInput, settings: RuleSettings) -> PairChecks:
    """The rule evaluated for every pair of every frame."""
    return evaluate_rule(run.rows, run.pairs, settings)


@dataclass(frozen=True)
class Outcome:
    """State codes of every frame, element after element: the rule's own, and what is shown."""

    raw: StateArray
    states: StateArray


def outcome(run: RuleInput, settings: RuleSettings) -> Outcome:
    """What the rule says in every frame, and what the light shows of it."""
    fired = verdicts(run, settings).fires
    approaching = (
        np.bincount(run.rows.frame[run.pairs.pedestrian_row[fired]], minlength=len(run.time_s)) > 0
    )
    memory = is_remembered(run.time_s, run.cyclist_last_s, settings.memory_s)
    raw = resolve_state(run.pedestrian, memory, approaching)
    if settings.shown == AS_RAW:
        return Outcome(raw, raw)
    shown = shown_alert(run.time_s, raw == int(State.ALERT), settings.shown, run.start)
    return Outcome(raw, shown_states(raw, shown))
