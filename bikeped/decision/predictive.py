"""The project's own rule: where the two would be if both went on as now. Pure.

In four sentences. A pair is judged by the courses that the tracker's filter gives both: how fast
they close, how near they would pass and when. It alerts when they close in, the cyclist rides, the
pass would be near (the farther ahead, the less sure, so the wider), and the cyclist either can no
longer stop in a good part of the gap or would be there soon. An alert stays on, without a break,
while the same holds with wider numbers. Nobody is asked how far away they are now.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.decision.track_rows import IndexArray, Pairs, TrackRows
from bikeped.types import BoolArray, FloatArray

#: Courses are followed so far ahead, s: as far as the ground truth looks.
HORIZON_S = 5.0
#: Two this near are in contact, m (definitions, section 5).
CONTACT_M = 1.0
#: Slower than this is not closing in: a division by it gives times beyond every bound, m/s.
_STANDS_MPS = 1e-3


@dataclass(frozen=True)
class PredictiveSettings:
    """The rule's numbers, in metres and seconds; docs/rule.md has the reasons and the search."""

    least_closing_mps: float = 0.35
    least_cycling_mps: float = 1.8
    pass_within_m: float = 7.8
    pass_growth_mps: float = 0.65
    stopping_share: float = 0.55
    contact_within_s: float = 5.2
    least_ahead_s: float = 0.3
    stay_margin: float = 0.1


@dataclass(frozen=True)
class Courses:
    """Where pairs [m] would go at constant velocities.

    `closing_mps`: how fast their distance shrinks now; `pass_m`, `pass_s`: the least distance
    within `HORIZON_S`, and when; `contact_s`: time until contact at this closing speed (infinite
    where they do not close); `cyclist_mps`: the cyclist's speed.
    """

    closing_mps: FloatArray
    pass_m: FloatArray
    pass_s: FloatArray
    contact_s: FloatArray
    cyclist_mps: FloatArray


def courses(rows: TrackRows, pairs: Pairs) -> Courses:
    """The courses of all pairs."""
    cyclist, pedestrian = pairs.cyclist_row[pairs.cyclist], pairs.pedestrian_row
    apart = rows.xy_m[cyclist] - rows.xy_m[pedestrian]
    ridden = rows.velocity_mps[cyclist]
    relative = ridden - rows.velocity_mps[pedestrian]
    distance = np.sqrt((apart**2).sum(-1))
    towards = -(apart * relative).sum(-1)
    closing = towards / np.maximum(distance, _STANDS_MPS)
    speed2 = (relative**2).sum(-1)
    pass_s = np.clip(towards / np.maximum(speed2, _STANDS_MPS**2), 0.0, HORIZON_S)
    passing = apart + relative * pass_s[:, None]
    gap = np.maximum(distance - CONTACT_M, 0.0)
    contact = np.where(closing > _STANDS_MPS, gap / np.maximum(closing, _STANDS_MPS), np.inf)
    return Courses(
        closing_mps=closing,
        pass_m=np.sqrt((passing**2).sum(-1)),
        pass_s=pass_s,
        contact_s=contact,
        cyclist_mps=np.sqrt((ridden**2).sum(-1)),
    )


def alerts(
    rows: TrackRows,
    pairs: Pairs,
    course: Courses,
    gap_m: FloatArray,
    stopping_m: FloatArray,
    settings: PredictiveSettings,
    was_on: BoolArray | None = None,
) -> BoolArray:
    """[m]: which pairs alert, judged one frame after another.

    `gap_m` [m] is between them, less contact; `stopping_m` [m] the cyclist's stopping distance;
    `was_on` [m]: pairs that alerted in the frame before the first one given.
    """
    begins = (course.cyclist_mps > settings.least_cycling_mps) & _holds(
        course, gap_m, stopping_m, settings, 0.0
    )
    stays = _holds(course, gap_m, stopping_m, settings, settings.stay_margin)
    order, first = _chains(rows, pairs)
    begins, stays = begins[order], stays[order]
    if was_on is not None:
        begins |= first & stays & was_on[order]
    # Within a chain an alert lasts from where it begins until the first frame without its reason.
    number = np.arange(len(order))
    began = np.maximum.accumulate(np.where(begins, number, -1))
    ended = np.maximum.accumulate(np.where((first | ~stays) & ~begins, number, -1))
    on: BoolArray = np.zeros(len(order), np.bool_)
    on[order] = began > ended
    return on


def _holds(
    course: Courses,
    gap_m: FloatArray,
    stopping_m: FloatArray,
    settings: PredictiveSettings,
    margin: float,
) -> BoolArray:
    """[m]: the conditions, each wider by `margin` (the share of the stopping distance by half)."""
    wider = 1 + margin
    pass_limit = wider * (settings.pass_within_m + settings.pass_growth_mps * course.pass_s)
    unable = stopping_m > (1 - margin / 2) * settings.stopping_share * gap_m
    soon = course.contact_s < wider * settings.contact_within_s
    return np.asarray(
        (course.closing_mps > (1 - margin) * settings.least_closing_mps)
        & (course.pass_m < pass_limit)
        & (course.pass_s > settings.least_ahead_s)
        & (unable | soon)
    )


def _chains(rows: TrackRows, pairs: Pairs) -> tuple[IndexArray, BoolArray]:
    """The order in which each pair's frames follow one another, and where a pair's begin in it."""
    cyclist, pedestrian = pairs.cyclist_row[pairs.cyclist], pairs.pedestrian_row
    order = np.lexsort((rows.frame[cyclist], rows.id[pedestrian], rows.id[cyclist]))
    cyclist, pedestrian = cyclist[order], pedestrian[order]
    first: BoolArray = np.ones(len(order), np.bool_)
    first[1:] = (rows.previous[cyclist[1:]] != cyclist[:-1]) | (
        rows.previous[pedestrian[1:]] != pedestrian[:-1]
    )
    return order, first
