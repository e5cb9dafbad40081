"""The decision, frame by frame, and its explanation in words."""

from __future__ import annotations

import math

import numpy as np

from bikeped.decision.rules import (
    EPSILON_M,
    PairChecks,
    RuleSettings,
    evaluate_rule,
    is_remembered,
    resolve_state,
)
from bikeped.decision.shown import ShownAlert, shown_states
from bikeped.decision.track_rows import CYCLIST, PEDESTRIAN, Pairs, RowBuffer, TrackRows, pair_rows
from bikeped.decision.who_counts import RIDER_S
from bikeped.types import BoolArray, Decision, FloatArray, IntArray, KindArray, PairMetrics, State


class Decider:
    """Keeps the last fraction of a second of positions and the time of the last cyclist.

    Call `decide` once a frame, with the reported tracks in ascending id and increasing times.
    """

    def __init__(self, settings: RuleSettings) -> None:
        self.settings = settings
        span_s = max(settings.lookback_s, settings.speed_window_s, RIDER_S)
        self._buffer = RowBuffer(span_s)
        self._last_cyclist_s = -math.inf
        self._shown = ShownAlert(settings.shown)
        self._alert_pair: PairMetrics | None = None
        self._on: set[tuple[int, int]] = set()  # cyclist and pedestrian of pairs that fired

    def decide(
        self,
        time_s: float,
        ids: IntArray,
        kind: KindArray,
        xy_m: FloatArray,
        velocity_mps: FloatArray | None = None,
        counted: BoolArray | None = None,
    ) -> Decision:
        """The decision at `time_s` (s); `ids` [n] ascending, `kind` [n], `xy_m` [n, 2] (m).

        `velocity_mps` [n, 2]: of the tracks (None: standing); `counted` [n]: those that
        `who_counts.counts` admits (None: all).
        """
        if velocity_mps is None:
            velocity_mps = np.zeros((len(ids), 2))
        if counted is None:
            counted = np.ones(len(ids), np.bool_)
        rows, newest = self._buffer.append(time_s, ids, kind, xy_m, velocity_mps, counted)
        pairs = pair_rows(rows, newest)
        cyclist_id = rows.id[pairs.cyclist_row[pairs.cyclist]].tolist()
        both = list(zip(cyclist_id, rows.id[pairs.pedestrian_row].tolist(), strict=True))
        was_on = np.asarray([ids in self._on for ids in both], np.bool_) if self._on else None
        checks = evaluate_rule(rows, pairs, self.settings, was_on)
        self._on = {both[i] for i in checks.fires.nonzero()[0].tolist()}
        if np.count_nonzero((kind == CYCLIST) & counted):
            self._last_cyclist_s = time_s
        pedestrians = np.count_nonzero((kind == PEDESTRIAN) & counted)
        remembered = is_remembered(time_s, self._last_cyclist_s, self.settings.memory_s)
        approaching = np.count_nonzero(checks.fires) > 0
        raw = State(resolve_state(pedestrians > 0, remembered, approaching).item())
        index = select_pair(raw, checks.fires, checks.distance_m)
        pair = None if index is None else pair_metrics(index, rows, pairs, checks, self.settings)
        since_s = time_s - self._last_cyclist_s
        shown = self._shown.update(time_s, raw is State.ALERT)
        if raw is State.ALERT:
            self._alert_pair = pair
        state = State(shown_states(np.asarray(raw), np.asarray(shown)).item())
        detail = explain(raw, pair, pedestrians, since_s, self.settings)
        detail = shown_sentence(raw, state, detail, self.settings)
        sentence = plain_sentence(raw, state, pair, pedestrians, since_s)
        if state is State.ALERT and raw is not State.ALERT:
            pair = self._alert_pair
        return Decision(time_s, state, sentence, pair, raw, detail)


def select_pair(state: State, fires: BoolArray, distance_m: FloatArray) -> int | None:
    """Index of the pair that a frame's decision reports: the first in track order that fires
    (ALERT), or the nearest (WARNING)."""
    if state is State.ALERT:
        return int(np.argmax(fires))
    if state is State.WARNING and len(distance_m):
        return int(np.argmin(distance_m))
    return None


def pair_metrics(
    index: int, rows: TrackRows, pairs: Pairs, checks: PairChecks, settings: RuleSettings
) -> PairMetrics:
    """The measurements of pair `index`."""
    names = (
        "distance_m",
        "distance_then_m",
        "lookback_s",
        "displacement_m",
        "speed_mps",
        "d_max_m",
    )
    course = ("closing_mps", "pass_m", "pass_s", "contact_s")
    return PairMetrics(
        cyclist_id=int(rows.id[pairs.cyclist_row[pairs.cyclist[index]]]),
        pedestrian_id=int(rows.id[pairs.pedestrian_row[index]]),
        d_min_m=settings.d_min_m,
        **{name: float(getattr(checks, name)[index]) for name in names},
        **{name: float(getattr(checks.course, name)[index]) for name in course},
    )


#: What is said of a course: closing faster than this, and together within so many seconds.
_CLOSING_MPS, _SOON_S = 0.3, 9.0


def plain_sentence(
    raw: State, state: State, pair: PairMetrics | None, pedestrians: int, since_cyclist_s: float
) -> str:
    """What a resident sees, and why the light shows `state`; the test's numbers: `explain`."""
    if state is State.ALERT and raw is not State.ALERT:
        return "ALERT: it stays red for a moment after the danger."
    if raw is State.IDLE:
        return "IDLE: no pedestrian is in view."
    people = "1 pedestrian is" if pedestrians == 1 else f"{pedestrians} pedestrians are"
    if raw is State.SAFE:
        return f"SAFE: {people} in view, and no cyclist."
    if pair is None:
        return f"WARNING: {people} in view, and a cyclist was there {since_cyclist_s:.1f} s ago."
    both = f"a cyclist and a pedestrian are {pair.distance_m:.0f} m apart"
    course = "and not closing"
    if pair.closing_mps > _CLOSING_MPS:
        course = "and closing"
        if pair.contact_s < _SOON_S:
            course += f"; together in {pair.contact_s:.1f} s"
    if raw is State.WARNING:
        course = course.replace("and closing", "and closing, but not into danger", 1)
    return f"{state.name}: {both} {course}."


def explain(
    state: State,
    pair: PairMetrics | None,
    pedestrians: int,
    since_cyclist_s: float,
    settings: RuleSettings,
) -> str:
    """The decision and the numbers that the rule compared, in one line."""
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
    pair_text = f"cyclist {pair.cyclist_id} and pedestrian {pair.pedestrian_id}"
    gap = f"{pair.distance_m:.2f} m apart"
    past = f"were {pair.distance_then_m:.2f} m {pair.lookback_s:.2f} s ago"
    if settings.rule == "predictive":
        contact = f"{pair.contact_s:.1f} s" if pair.contact_s < _SOON_S else "not soon"
        return (
            f"{state.name}: {pair_text} are {gap}, closing at {pair.closing_mps:.1f} m/s; contact: "
            f"{contact}; going on so they pass {pair.pass_m:.1f} m apart in {pair.pass_s:.1f} s; "
            f"the cyclist rides at {pair.speed_mps:.1f} m/s (rule predictive)."
        )
    if state is State.ALERT:
        moved = f"the cyclist moved {pair.displacement_m:.2f} m at {pair.speed_mps:.1f} m/s"
        bounds = f"{pair.d_min_m:g} to {pair.d_max_m:.1f} m"
        if settings.rule == "distance":
            return f"ALERT: {pair_text} are {gap}, within {bounds} (rule distance)."
        return (
            f"ALERT: {pair_text} are {gap}, {past}; {moved}; alerts within {bounds} "
            f"(rule {settings.rule})."
        )
    return f"WARNING: {pair_text} are {gap}, {_reason_not_to_alert(pair, past, settings)}."


def shown_sentence(raw: State, state: State, sentence: str, settings: RuleSettings) -> str:
    """The raw state's sentence, as it reads where another one is shown."""
    if state is raw:
        return sentence
    if state is State.ALERT:
        return f"ALERT: held for {settings.shown.hold_s:g} s. Now {sentence}"
    return sentence.replace(f"{raw.name}:", f"{state.name}: not yet sure:", 1)


def _reason_not_to_alert(pair: PairMetrics, past: str, settings: RuleSettings) -> str:
    if pair.distance_m < pair.d_min_m:
        return f"nearer than the {pair.d_min_m:g} m at which a warning still helps"
    if pair.distance_m > pair.d_max_m:
        return f"farther than {pair.d_max_m:.1f} m"
    if pair.lookback_s <= 0:
        return f"just appeared, or more than {settings.max_range_m:g} m from the camera"
    if settings.rule == "ttc":
        return f"{past}: not soon together"
    if pair.distance_m >= pair.distance_then_m - EPSILON_M:
        return f"{past}: not closing"
    return (
        f"closing, but the cyclist moved only {pair.displacement_m:.2f} m in "
        f"{pair.lookback_s:.2f} s"
    )
