"""The closing checks (definitions, section 8) of any number of pairs at once, and the three stages.

Each rule compares a pair now with the same pair `lookback_s` ago. Where no frame lies exactly that
far back, for example because one was dropped, positions are interpolated between the two frames
around it. A pair younger than the lookback is compared over its life so far; a pair without an
earlier position is not evaluated. The stages (paper, algorithm 1): pedestrian present, cyclist
remembered, approaching.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from bikeped.decision.predictive import CONTACT_M, Courses, PredictiveSettings, alerts, courses
from bikeped.decision.shown import ShownSettings
from bikeped.decision.track_rows import EPSILON_S, IndexArray, Pairs, TrackRows
from bikeped.decision.who_counts import without_riders
from bikeped.types import BoolArray, FloatArray, State

RuleName = Literal["pairwise", "naive", "ttc", "distance", "predictive"]

#: Distances closer than this are equal: at a constant gap, rounding must not look like closing.
EPSILON_M = 1e-9
#: Closing speed below which the ttc rule sees no approach, m/s.
TTC_CLOSING_MIN_MPS = 0.1
_IDLE, _SAFE, _WARNING, _ALERT = (int(s) for s in State)
#: State by 4 * pedestrian present + 2 * cyclist remembered + approaching.
_STATES = np.asarray([_IDLE, _IDLE, _IDLE, _IDLE, _SAFE, _SAFE, _WARNING, _ALERT], np.int8)


@dataclass(frozen=True)
class RuleSettings:
    """Parameters of the decision in seconds, metres and metres per second.

    The defaults are the paper's selected configuration: N = 58 and k = 2 at 30 frames per second.
    """

    rule: RuleName = "pairwise"
    memory_s: float = 58 / 30
    d_min_m: float = 1.9
    d_max_m: float = 24.8
    min_displacement_m: float = 0.147
    lookback_s: float = 2 / 30
    max_range_m: float = 25.0
    speed_adaptive: bool = True
    reaction_s: float = 0.84
    deceleration_mps2: float = 1.96
    speed_window_s: float = 4 / 30
    ttc_s: float = 3.0
    max_unseen_s: float = 1.0
    count_all: bool = False  #: riders and parked cycles too, as in the paper's simulation
    shown: ShownSettings = field(default_factory=ShownSettings)
    predictive: PredictiveSettings = field(default_factory=PredictiveSettings)


@dataclass(frozen=True)
class PairChecks:
    """The rule's checks of each pair [m], and the measurements behind them.

    A pair fires when it passes all of: `above_d_min`, `below_d_max`, `in_range` of the camera,
    `evaluated`, `closing` and `displacement_ok` (the cyclist's displacement exceeds the minimum;
    rule ttc: time to collision below `ttc_s`; rule distance: always). `evaluated` is false for
    pairs that fail one of the first three or have no earlier position: these have a lookback of
    0 s, no displacement, and neither of the last two. One rider (`who_counts`) does not fire.
    Rule predictive asks for `in_range` and its own conditions on the `course` alone; for it all
    others but `fires` are true.
    """

    fires: BoolArray
    evaluated: BoolArray
    above_d_min: BoolArray
    below_d_max: BoolArray
    in_range: BoolArray
    closing: BoolArray
    displacement_ok: BoolArray
    distance_m: FloatArray
    distance_then_m: FloatArray
    lookback_s: FloatArray
    displacement_m: FloatArray
    speed_mps: FloatArray
    d_max_m: FloatArray
    course: Courses


def stopping_distance(
    speed_mps: FloatArray, reaction_s: float, deceleration_mps2: float
) -> FloatArray:
    """Stopping distance in metres: v t + v^2 / 2a (paper, section 4.2)."""
    return speed_mps * reaction_s + speed_mps * speed_mps / (2 * deceleration_mps2)


def evaluate_rule(
    rows: TrackRows, pairs: Pairs, settings: RuleSettings, was_on: BoolArray | None = None
) -> PairChecks:
    """Applies the rule `settings.rule` to every pair [m].

    `was_on` [m]: pairs that fired in the frame before the first one given, which rule predictive
    asks for; None: none.
    """
    cyclist, pedestrian = pairs.cyclist_row[pairs.cyclist], pairs.pedestrian_row
    c_now, p_now = rows.xy_m[cyclist], rows.xy_m[pedestrian]
    distance = _length(c_now - p_now)
    window_s = settings.speed_window_s
    least_s = EPSILON_S if settings.count_all else window_s
    speed = _speed(rows, pairs.cyclist_row, window_s, least_s)[pairs.cyclist]
    d_max = np.full(len(pairs), settings.d_max_m)
    if settings.speed_adaptive:
        d_max = np.maximum(
            d_max, stopping_distance(speed, settings.reaction_s, settings.deceleration_mps2)
        )
    course = courses(rows, pairs)
    above_d_min, below_d_max = distance >= settings.d_min_m, distance <= d_max
    in_range = (_length(c_now) <= settings.max_range_m) & (_length(p_now) <= settings.max_range_m)
    if settings.rule == "predictive":
        stopping = stopping_distance(
            course.cyclist_mps, settings.reaction_s, settings.deceleration_mps2
        )
        gap = np.maximum(distance - CONTACT_M, 0.0)
        on = alerts(rows, pairs, course, gap, stopping, settings.predictive, was_on) & in_range
        yes, none = np.ones(len(pairs), np.bool_), np.zeros(len(pairs))
        return PairChecks(
            fires=without_riders(rows, pairs, on),
            evaluated=yes,
            above_d_min=yes,
            below_d_max=yes,
            in_range=in_range,
            closing=yes,
            displacement_ok=yes,
            distance_m=distance,
            distance_then_m=distance,
            lookback_s=none,
            displacement_m=none,
            speed_mps=course.cyclist_mps,
            d_max_m=np.full(len(pairs), settings.max_range_m),
            course=course,
        )
    # Only these are looked up in the past: of thousands of pairs in a crowd few are within bounds.
    index = (above_d_min & below_d_max & in_range).nonzero()[0]
    c_past, p_past, elapsed = _positions_before(
        rows, cyclist[index], pedestrian[index], settings.lookback_s
    )
    near, moved = distance[index], _length(c_now[index] - c_past)
    # The naive rule's flaw: the pedestrian counts as standing.
    past_distance = _length(c_past - (p_now[index] if settings.rule == "naive" else p_past))
    is_closing: BoolArray = np.ones(len(index), np.bool_)
    second_check = is_closing  # rule distance: always
    if settings.rule == "ttc":
        closing_mps = (past_distance - near) / np.maximum(elapsed, EPSILON_S)
        is_closing = closing_mps > TTC_CLOSING_MIN_MPS
        second_check = near < settings.ttc_s * closing_mps
    elif settings.rule != "distance":
        is_closing = near < past_distance - EPSILON_M
        second_check = moved > settings.min_displacement_m

    count = len(pairs)
    distance_then, lookback, displacement = distance.copy(), np.zeros(count), np.zeros(count)
    distance_then[index], lookback[index], displacement[index] = past_distance, elapsed, moved
    evaluated = lookback > 0
    closing, displacement_ok = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    known = evaluated[index] | (settings.rule == "distance")  # which asks for no history
    closing[index] = is_closing & known
    displacement_ok[index] = second_check & known
    fires = closing & displacement_ok
    return PairChecks(
        fires=fires if settings.count_all else without_riders(rows, pairs, fires),
        evaluated=evaluated,
        above_d_min=above_d_min,
        below_d_max=below_d_max,
        in_range=in_range,
        closing=closing,
        displacement_ok=displacement_ok,
        distance_m=distance,
        distance_then_m=distance_then,
        lookback_s=lookback,
        displacement_m=displacement,
        speed_mps=speed,
        d_max_m=d_max,
        course=course,
    )


def _length(vector: FloatArray) -> FloatArray:
    x, y = vector[:, 0], vector[:, 1]
    return np.sqrt(x * x + y * y)


def _positions_before(
    rows: TrackRows, cyclist: IndexArray, pedestrian: IndexArray, lookback_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions [m, 2] of cyclist and pedestrian `lookback_s` before their rows, or as far back as
    both tracks reach, and the time [m] between, seconds."""
    now = rows.time_s[cyclist]
    target = now - (lookback_s - EPSILON_S)
    (c_old, p_old), (c_new, p_new) = _walk_back(rows, target, cyclist, pedestrian)
    c_past, p_past = rows.xy_m[c_old], rows.xy_m[p_old]
    old_s = rows.time_s[c_old]
    overshoot = now - lookback_s - old_s
    between = overshoot > EPSILON_S
    if np.count_nonzero(between):
        gap = np.where(between, rows.time_s[c_new] - old_s, 1.0)
        share = np.where(between, overshoot / gap, 0.0)[:, None]
        c_past = c_past + share * (rows.xy_m[c_new] - c_past)
        p_past = p_past + share * (rows.xy_m[p_new] - p_past)
        old_s = np.where(between, now - lookback_s, old_s)
    return c_past, p_past, now - old_s


def _speed(rows: TrackRows, row: IndexArray, window_s: float, least_s: float) -> FloatArray:
    """Speeds [n] (m/s): the displacement in the last `window_s`, over its time or `least_s`.

    A track younger than `least_s` seems slower than it is: one step, which may be a wrong match, is
    not believed to be its speed.
    """
    now = rows.time_s[row]
    old = _walk_back(rows, now - (window_s - EPSILON_S), row)[0][0]
    displacement = _length(rows.xy_m[row] - rows.xy_m[old])
    return np.asarray(displacement / np.maximum(now - rows.time_s[old], least_s))


def _walk_back(
    rows: TrackRows, target_s: FloatArray, *tracks: IndexArray
) -> tuple[IndexArray, IndexArray]:
    """Follows `previous` from the rows `tracks` [k, n], k at once, to `target_s` [n] or earlier, or
    as far as all k reach: the rows [k, n] arrived at, and those visited just before."""
    old = new = np.stack(tracks)
    while True:
        late = rows.time_s[old[0]] > target_s
        if not np.count_nonzero(late):
            return old, new
        previous = rows.previous[old]
        go = late & (previous >= 0).all(axis=0)
        if not np.count_nonzero(go):
            return old, new
        old, new = np.where(go, previous, old), np.where(go, old, new)


def resolve_state(
    pedestrian_present: BoolArray | bool,
    cyclist_remembered: BoolArray | bool,
    approaching: BoolArray | bool,
) -> npt.NDArray[np.int8]:
    """State codes [n], or one: IDLE without a pedestrian, SAFE without a remembered cyclist, else
    ALERT or WARNING by the closing check."""
    stage = pedestrian_present * np.int8(4) + cyclist_remembered * np.int8(2) + approaching
    return np.asarray(_STATES[stage])


def is_remembered(
    now_s: FloatArray | float, last_cyclist_s: FloatArray | float, memory_s: float
) -> BoolArray:
    """[n] or one: was a cyclist tracked within the last `memory_s`? 0 s means in this frame."""
    return np.asarray(now_s - last_cyclist_s <= memory_s + EPSILON_S)
