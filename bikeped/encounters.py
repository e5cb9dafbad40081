"""How near a cyclist and a pedestrian came to a collision (definitions, section 15). Pure.

One measure for ground truth, traffic, messages and history. Samples of any number of pairs lie in
flat arrays, pair after pair; positions and velocities are in any plane frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.types import BoolArray, FloatArray, IntArray

#: Nearer than this is a contact, metres.
CONTACT_M = 1.0
#: Two who come so near to one place pass it, metres.
SAME_PLACE_M = 0.75
#: Slower ones do not pass a place, m/s.
CYCLIST_MOVES_MPS, PEDESTRIAN_MOVES_MPS = 1.0, 0.3
#: A real conflict: PET or TTC below this, seconds, or a contact at more than this speed, m/s.
CONFLICT_S = 1.5
CONFLICT_MPS = 1.5
#: Passes of one place farther apart in time are none, seconds.
PET_WINDOW_S = 5.0
#: Braking room is at least this, so that a deceleration stays finite, metres.
_LEAST_ROOM_M = 0.1
#: Slower than this is rounding, not closing, m/s.
_CLOSES_MPS = 1e-6
_EPSILON_S = 1e-6


@dataclass(frozen=True)
class PairSamples:
    """Samples [n] of cyclist-pedestrian pairs, sorted by `pair`, within a pair by time.

    `pair` [n] are numbers from 0; positions and velocities [n, 2] in m and m/s, NaN where one of
    the two is not there.
    """

    pair: IntArray
    time_s: FloatArray
    cyclist_m: FloatArray
    pedestrian_m: FloatArray
    cyclist_mps: FloatArray
    pedestrian_mps: FloatArray


@dataclass(frozen=True)
class Encounters:
    """Each pair's measures [p], p the largest number of a pair and one.

    Least distance (m), TTC and PET (s), infinite where there is none, and largest DRAC (m/s^2).
    `conflict_s` is the earliest time of a real conflict, NaN where there is none.
    """

    least_distance_m: FloatArray
    ttc_s: FloatArray
    pet_s: FloatArray
    drac_mps2: FloatArray
    conflict_s: FloatArray


def pair_samples(
    time_s: FloatArray,
    xy_m: FloatArray,
    velocity_mps: FloatArray,
    pairs: IntArray,
    window_s: float = PET_WINDOW_S,
) -> PairSamples:
    """The samples of `pairs` [p, 2] (cyclist, pedestrian: indices of people) from whole tracks.

    `time_s` [f]; positions and velocities [f, a, 2] of a people, NaN where one is not there. The
    samples of a pair are those from `window_s` before both are there to `window_s` after.
    """
    there = ~np.isnan(xy_m[..., 0])
    first_s = np.where(there.any(axis=0), time_s[there.argmax(axis=0)], np.inf)
    last_s = np.where(there.any(axis=0), time_s[len(there) - 1 - there[::-1].argmax(axis=0)], 0.0)
    begin = time_s.searchsorted(first_s[pairs].max(axis=1, initial=-np.inf) - window_s)
    end = time_s.searchsorted(last_s[pairs].min(axis=1, initial=np.inf) + window_s, side="right")
    count = np.maximum(end - begin, 0)
    pair = np.arange(len(pairs)).repeat(count)
    frame = np.arange(len(pair)) - (count.cumsum() - count - begin).repeat(count)
    cyclist, pedestrian = pairs[pair].T
    return PairSamples(
        pair,
        time_s[frame],
        *(values[frame, who] for values in (xy_m, velocity_mps) for who in (cyclist, pedestrian)),
    )


def time_to_collision(apart_m: FloatArray, relative_mps: FloatArray) -> FloatArray:
    """Time [n] until two at constant velocities are under 1 m apart, s; infinite unless they close.

    `apart_m` and `relative_mps` [n, 2]: one's position and velocity minus the other's.
    """
    square = (relative_mps**2).sum(-1)
    inward = -(apart_m * relative_mps).sum(-1)
    outside = (apart_m**2).sum(-1) - CONTACT_M**2
    root = inward**2 - square * outside
    hits = (inward > _CLOSES_MPS * _length(apart_m)) & (root >= 0)
    # The smaller root of |apart + t relative| = 1 m, in the form that does not cancel.
    reach = inward + np.sqrt(np.where(hits, root, 0.0))
    first_s = np.maximum(outside, 0.0) / np.where(hits, reach, 1.0)
    return np.where(hits, first_s, np.inf)


def deceleration_needed(apart_m: FloatArray, relative_mps: FloatArray) -> FloatArray:
    """DRAC [n], m/s^2: the braking that ends the closing speed within the gap; 0 unless closing."""
    distance = _length(apart_m)
    inward = -(apart_m * relative_mps).sum(-1) / np.maximum(distance, 1e-9)
    room = np.maximum(distance - CONTACT_M, _LEAST_ROOM_M)
    return np.where(inward > _CLOSES_MPS, inward**2 / (2 * room), 0.0)


def post_encroachment(samples: PairSamples, window_s: float = PET_WINDOW_S) -> FloatArray:
    """PET [n] by sample: the least time until the other passes the place that one passes now.

    Infinite where neither moves past a place that the other passes within `window_s` later.
    """
    riding = _length(samples.cyclist_mps) > CYCLIST_MOVES_MPS
    walking = _length(samples.pedestrian_mps) > PEDESTRIAN_MOVES_MPS
    found = np.full(len(samples.pair), np.inf)
    # The pedestrian's way within the window bounds how far off he is when the cyclist passes.
    walk_mps = np.where(walking, _length(samples.pedestrian_mps), 0.0)
    fastest = _largest(samples, walk_mps, initial=0.0)[samples.pair] if len(found) else walk_mps
    apart = _length(samples.cyclist_m - samples.pedestrian_m)
    near = ~(apart > SAME_PLACE_M + fastest * window_s)  # NaN, one is not there: near
    cyclist_at = np.flatnonzero(riding & near)
    for direction in (1, -1):
        at, lag = cyclist_at, 0
        while len(at):
            other = at + direction * lag
            there = (other >= 0) & (other < len(found))
            at, other = at[there], other[there]
            after_s = np.abs(samples.time_s[other] - samples.time_s[at])
            within = (samples.pair[other] == samples.pair[at]) & (after_s <= window_s + _EPSILON_S)
            at, other, after_s = at[within], other[within], after_s[within]
            near_by = _length(samples.cyclist_m[at] - samples.pedestrian_m[other]) < SAME_PLACE_M
            passed = near_by & walking[other]
            first = np.minimum(at, other)[passed]
            found[first] = np.minimum(found[first], after_s[passed])
            lag += 1
    return found


def measure_encounters(samples: PairSamples, window_s: float = PET_WINDOW_S) -> Encounters:
    """The measures of every pair. A conflict by PET begins when the first of the two passes."""
    apart = samples.cyclist_m - samples.pedestrian_m
    relative = samples.cyclist_mps - samples.pedestrian_mps
    distance = _length(apart)
    ttc = time_to_collision(apart, relative)
    pet = post_encroachment(samples, window_s)
    conflict = is_conflict(samples, ttc, pet)
    drac = np.nan_to_num(deceleration_needed(apart, relative))
    return Encounters(
        least_distance_m=_least(samples, np.where(np.isnan(distance), np.inf, distance)),
        ttc_s=_least(samples, ttc),
        pet_s=_least(samples, pet),
        drac_mps2=_largest(samples, drac, initial=0.0),
        conflict_s=_finite(_least(samples, np.where(conflict, samples.time_s, np.inf))),
    )


def is_conflict(samples: PairSamples, ttc_s: FloatArray, pet_s: FloatArray) -> BoolArray:
    """Samples [n] with both there that are a real conflict, from their TTC and PET [n]."""
    distance = _length(samples.cyclist_m - samples.pedestrian_m)
    relative_mps = _length(samples.cyclist_mps - samples.pedestrian_mps)
    contact = (distance < CONTACT_M) & (relative_mps > CONFLICT_MPS)
    moving = _length(samples.cyclist_mps) > CYCLIST_MOVES_MPS
    found = (pet_s < CONFLICT_S) | (moving & ((ttc_s < CONFLICT_S) | contact))
    return np.asarray(found & ~np.isnan(distance))


def _length(vector: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt((vector**2).sum(-1)))


def _finite(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, np.nan)


def _least(samples: PairSamples, values: FloatArray) -> FloatArray:
    return -_largest(samples, -values, initial=-np.inf)


def _largest(samples: PairSamples, values: FloatArray, *, initial: float) -> FloatArray:
    largest: npt.NDArray[np.float64] = np.full(int(samples.pair.max(initial=-1)) + 1, initial)
    np.maximum.at(largest, samples.pair, values)
    return largest
