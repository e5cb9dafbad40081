"""The tracker, over many independent scenes ("lanes") at once.

The pole runs one lane; the simulation runs the same code over hundreds of Monte Carlo trials side
by side. All lanes share the clock; a lane's tracks never see another lane's detections. State is
held as arrays of shape [lanes, slots], where a slot holds one track until it is dropped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bikeped.tracking.matching import IndexArray, match_greedy
from bikeped.types import BoolArray, FloatArray, IntArray, Kind, KindArray

#: Slack of comparisons between times, far below a frame and far above rounding.
_EPSILON_S = 1e-6
_PEDESTRIAN, _CYCLIST, _VEHICLE = (int(k) for k in (Kind.PEDESTRIAN, Kind.CYCLIST, Kind.VEHICLE))
#: How a track's kind follows its detections (see `TrackerSettings.rider_radius_m`): the share of
#: cycles among the recent ones, smoothed with this weight: over 0.4 s at 30 frames/s.
_CYCLE_WEIGHT = 0.08
#: Above the first share a pedestrian becomes a cyclist, below the second the reverse. Where a
#: bicycle is easily missed, two in a row make a cyclist, and 0.7 to 2.3 s of mere persons a
#: pedestrian again; where rider and cycle are one box, the most frequent kind is the right one.
_CYCLE_SHARES = (0.12, 0.03)
_WHOLE_SHARES = (0.55, 0.45)
#: A cyclist unseen for longer is not a rider's any more.
_RIDER_UNSEEN_S = 1.0
#: A track that is not yet confirmed is dropped when unseen for longer than this.
_TENTATIVE_S = 0.2


@dataclass(frozen=True)
class TrackerSettings:
    """How detections become tracks; times in seconds, lengths in metres.

    The defaults are the tracker of the paper's simulation (definitions, section 7); the pole's
    come from the configuration. `max_speed_mps` by kind (pedestrian, cyclist, vehicle) gates a
    match: a detection may lie at most speed * time since last seen + `position_noise_m` from where
    the track was then. `velocity_weight` is the weight of the newest step per `frame_s`.
    `position_weight`, also per `frame_s`, is that of a detection's place against the predicted one
    (with the former an alpha-beta filter; 1: tracks are where their detections are).
    With `unbiased` the smoothed velocity starts at the first step instead of at zero. A track that
    coasts farther than `max_range_m` from the origin is dropped.

    `rider_radius_m`: detectors see a small bicycle in some frames and only its rider in others. A
    person without a track, this near to a cyclist's track without a detection, is that cyclist (and
    the reverse), so that one rider does not become a cyclist and a pedestrian who meet. 0: never,
    as in the paper's simulation, whose agents have one kind. `cyclist_box_includes_rider`: the
    detector boxes rider and cycle as one, so both kinds count alike and a track is what most of its
    recent detections were. `acceleration`: whether it is estimated; only second-order prediction
    reads it.
    """

    match_radius_m: float = 3.0
    max_unseen_s: float = 30 / 30
    velocity_weight: float = 0.5
    position_weight: float = 1.0
    frame_s: float = 1 / 30
    confirm_hits: int = 1
    max_speed_mps: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    position_noise_m: float = math.inf
    unbiased: bool = False
    max_range_m: float = math.inf
    rider_radius_m: float = 0.0
    cyclist_box_includes_rider: bool = False
    acceleration: bool = True


class BatchTracker:
    """Tracks of `lanes` independent scenes; `update` once a frame, then read the arrays.

    Arrays are [lanes, slots] (positions, velocities, accelerations [lanes, slots, 2]); slots with
    `alive` false hold rubbish. `id` counts up from 1 in each lane in order of birth; `detection`
    is the index matched in the last update, or -1.
    """

    def __init__(self, settings: TrackerSettings, lanes: int = 1, slots: int = 8) -> None:
        self.settings = settings
        self.time_s = -math.inf
        self.alive: BoolArray = np.zeros((lanes, slots), np.bool_)
        self.id: IntArray = np.zeros((lanes, slots), np.int64)
        self.kind: KindArray = np.zeros((lanes, slots), np.int8)
        self.xy_m: FloatArray = np.zeros((lanes, slots, 2))
        self.velocity_mps: FloatArray = np.zeros((lanes, slots, 2))
        self.acceleration_mps2: FloatArray = np.zeros((lanes, slots, 2))
        self.seen_s: FloatArray = np.zeros((lanes, slots))
        self.hits: IntArray = np.zeros((lanes, slots), np.int64)
        self.detection: IndexArray = np.full((lanes, slots), -1, np.intp)
        self._seen_xy_m: FloatArray = np.zeros((lanes, slots, 2))
        self._cycle_share: FloatArray = np.zeros((lanes, slots))
        self._next_id: IntArray = np.ones(lanes, np.int64)
        self._max_speed = np.asarray(settings.max_speed_mps)
        self._gated = bool(np.isfinite(self._max_speed).any())

    @property
    def reported(self) -> BoolArray:
        """[lanes, slots]: the tracks that count as present."""
        return self.alive & (self.hits >= self.settings.confirm_hits)

    def update(self, time_s: float, xy_m: FloatArray, kind: KindArray) -> None:
        """Advances every lane to `time_s` with detections `xy_m` [lanes, n, 2].

        `kind` [lanes, n]; -1 marks an empty place (lanes have different numbers of detections).
        Time must not go back.
        """
        if time_s < self.time_s:
            raise ValueError(f"time_s: {time_s} is before the last update at {self.time_s}")
        step_s = time_s - self.time_s if math.isfinite(self.time_s) else 0.0
        self.time_s = time_s
        if step_s > 2 * self.settings.frame_s:
            # After a silence: what ran out meanwhile must not be matched first and dropped later.
            self.alive &= time_s - self.seen_s <= (
                self.settings.max_unseen_s + 1.5 * self.settings.frame_s
            )
        self.xy_m += self.velocity_mps * step_s  # rubbish in free slots moves along, unread
        matched, refused = self._match(xy_m, kind)
        self.detection = matched
        self._correct(time_s, xy_m, kind, matched)
        self._drop(time_s)
        fresh = kind >= 0
        lane, slot = (matched >= 0).nonzero()
        fresh[lane, matched[lane, slot]] = False
        if refused is not None:
            fresh &= ~refused
        if np.count_nonzero(fresh):
            self._add(time_s, xy_m, kind, fresh)

    def _match(self, xy_m: FloatArray, kind: KindArray) -> tuple[IndexArray, BoolArray | None]:
        """Detection of each slot, and the detections that only a gate kept from a free track."""
        lanes, slots = self.alive.shape
        detections = kind.shape[1]
        track_xy = np.where(self.alive[..., None], self.xy_m, np.nan)  # NaN is near nothing
        dx = track_xy[:, :, None, 0] - xy_m[:, None, :, 0]
        dy = track_xy[:, :, None, 1] - xy_m[:, None, :, 1]
        cost = dx * dx + dy * dy
        lane, slot, detection = (cost <= self.settings.match_radius_m**2).nonzero()
        # Flat indices over all lanes: what follows runs over the few near pairs only.
        track = lane * slots + slot
        place = lane * detections + detection
        near_cost = cost[lane, slot, detection]
        same = self.kind.ravel()[track] == kind.ravel()[place]
        shape = (lanes * slots, lanes * detections)
        if not self._gated:
            matched = match_greedy(track[same], place[same], near_cost[same], *shape)
            return self._per_slot(matched, detections), None
        reach = (
            self._max_speed[self.kind.ravel()[track]] * (self.time_s - self.seen_s.ravel()[track])
            + self.settings.position_noise_m
        )
        way = xy_m.reshape(-1, 2)[place] - self._seen_xy_m.reshape(-1, 2)[track]
        allowed = same & (way[:, 0] ** 2 + way[:, 1] ** 2 <= reach**2)
        matched = match_greedy(track[allowed], place[allowed], near_cost[allowed], *shape)
        # A gate may refuse a match but must not breed tracks: a detection beside a track that is
        # still free is that track's, too far for one frame; it waits until the gate has widened.
        refused = np.zeros(lanes * detections, np.bool_)
        refused[place[same & ~allowed & (matched[track] < 0)]] = True
        if self.settings.rider_radius_m > 0 and np.count_nonzero(same) < len(same):
            self._match_riders(track, place, near_cost, kind, matched, refused)
        return self._per_slot(matched, detections), refused.reshape(lanes, detections)

    def _match_riders(
        self,
        track: IndexArray,
        place: IndexArray,
        cost: FloatArray,
        kind: KindArray,
        matched: IndexArray,
        refused: BoolArray,
    ) -> None:
        """Second choice: a free pedestrian beside a free cyclist's track is its rider, and the
        reverse. Fills in `matched`; what kind the track is, `_correct` decides."""
        taken = np.zeros(len(refused), np.bool_)
        taken[matched[matched >= 0]] = True
        track_kind, detected_kind = self.kind.ravel()[track], kind.ravel()[place]
        fit = (
            (track_kind != detected_kind)
            & (track_kind != _VEHICLE)
            & (detected_kind != _VEHICLE)
            & (cost <= self.settings.rider_radius_m**2)
            & (matched[track] < 0)
            & ~taken[place]
            & ~refused[place]
            & (self.time_s - self.seen_s.ravel()[track] <= _RIDER_UNSEEN_S)
        )
        riders = match_greedy(track[fit], place[fit], cost[fit], len(matched), len(refused))
        found = riders >= 0
        matched[found] = riders[found]

    def _per_slot(self, matched: IndexArray, detections: int) -> IndexArray:
        """[lanes, slots] index within the lane, from the flat index over all lanes."""
        shaped = matched.reshape(self.alive.shape)
        if len(shaped) == 1:
            return shaped
        return np.where(shaped >= 0, shaped - np.arange(len(shaped))[:, None] * detections, -1)

    def _correct(
        self, time_s: float, xy_m: FloatArray, kind: KindArray, matched: IndexArray
    ) -> None:
        # Views over all lanes with one flat index: half the time of indexing lane and slot.
        flat = (matched.ravel() >= 0).nonzero()[0]
        if len(flat) == 0:
            return
        lane = flat // matched.shape[1]
        velocity = self.velocity_mps.reshape(-1, 2)
        acceleration = self.acceleration_mps2.reshape(-1, 2)
        seen_xy = self._seen_xy_m.reshape(-1, 2)
        seen_s, hits = self.seen_s.reshape(-1), self.hits.reshape(-1)
        place = lane * xy_m.shape[1] + matched.ravel()[flat]
        new_xy = xy_m.reshape(-1, 2)[place]
        elapsed = np.maximum(time_s - seen_s[flat], _EPSILON_S)
        keep = (1 - self.settings.velocity_weight) ** (elapsed / self.settings.frame_s)
        old_v = velocity[flat]
        if self.settings.position_weight < 1:
            expected = (1 - self.settings.position_weight) ** (elapsed / self.settings.frame_s)
            # A young track's velocity is that of a few noisy steps: at first the weights are those
            # with which the filter fits a line to all of its sights.
            n = hits[flat] + 1
            expected = np.minimum(expected, 1 - 2 * (2 * n - 1) / (n * (n + 1)))[:, None]
            keep = np.minimum(keep, 1 - 3 / (2 * n - 1))
            new_xy = new_xy + expected * (self.xy_m.reshape(-1, 2)[flat] - new_xy)
        raw_v = (new_xy - seen_xy[flat]) / elapsed[:, None]
        if self.settings.unbiased:
            keep = np.where(hits[flat] == 1, 0.0, keep)
        kept = keep[:, None]
        new_v = old_v * kept + raw_v * (1 - kept)
        if self._gated:
            most = self._max_speed[self.kind.ravel()[flat]]
            over = (new_v * new_v).sum(1) > most * most
            if np.count_nonzero(over):
                speed = np.hypot(new_v[over, 0], new_v[over, 1])
                new_v[over] *= (most[over] / speed)[:, None]
        velocity[flat] = new_v
        if self.settings.acceleration:
            raw_a = (new_v - old_v) / elapsed[:, None]
            acceleration[flat] = acceleration[flat] * kept + raw_a * (1 - kept)
        self.xy_m.reshape(-1, 2)[flat] = new_xy
        seen_xy[flat] = new_xy
        seen_s[flat] = time_s
        hits[flat] += 1
        if self.settings.rider_radius_m > 0:
            self._settle_kind(flat, kind.ravel()[place])

    def _settle_kind(self, flat: IndexArray, seen: KindArray) -> None:
        """Lets the kind of pedestrians and cyclists follow what they were lately seen as."""
        share, kind = self._cycle_share.reshape(-1), self.kind.reshape(-1)
        if not np.count_nonzero(share[flat] != (seen == _CYCLIST)):
            return  # seen as they were always seen
        whole = self.settings.cyclist_box_includes_rider
        # A young track has no past to hold against what it is seen as: all of its sights count.
        weight = np.maximum(_CYCLE_WEIGHT, 1 / self.hits.reshape(-1)[flat]) if whole else None
        share[flat] += (_CYCLE_WEIGHT if weight is None else weight) * (
            (seen == _CYCLIST) - share[flat]
        )
        on, off = _WHOLE_SHARES if whole else _CYCLE_SHARES
        was = kind[flat]
        rides = (was == _PEDESTRIAN) & (share[flat] > on)
        walks = (was == _CYCLIST) & (share[flat] < off)
        if whole:  # of the first two sights the newer one is right: most people come nearer
            young = self.hits.reshape(-1)[flat] == 2
            rides |= young & (seen == _CYCLIST)
            walks |= young & (seen == _PEDESTRIAN)
        kind[flat] = np.where(rides, _CYCLIST, np.where(walks, _PEDESTRIAN, was))

    def _drop(self, time_s: float) -> None:
        unseen = time_s - self.seen_s
        self.alive &= unseen <= self.settings.max_unseen_s + _EPSILON_S
        if self.settings.confirm_hits > 1:
            confirmed = self.hits >= self.settings.confirm_hits
            self.alive &= confirmed | (unseen <= _TENTATIVE_S + _EPSILON_S)
        if math.isfinite(self.settings.max_range_m):
            self.alive &= (self.xy_m**2).sum(-1) <= self.settings.max_range_m**2

    def _add(self, time_s: float, xy_m: FloatArray, kind: KindArray, fresh: BoolArray) -> None:
        need = fresh.sum(axis=1)
        while (need > (~self.alive).sum(axis=1)).any():
            self._grow()
        free = np.argsort(self.alive, axis=1, kind="stable")  # free slots first, in slot order
        order = fresh.cumsum(axis=1) - 1
        lane, detection = np.nonzero(fresh)
        rank = order[lane, detection]
        at = (lane, free[lane, rank])
        self.alive[at] = True
        self.id[at] = self._next_id[lane] + rank
        self._next_id += need
        self.kind[at] = kind[lane, detection]
        self.xy_m[at] = xy_m[lane, detection]
        self._seen_xy_m[at] = xy_m[lane, detection]
        self.velocity_mps[at] = 0.0
        self.acceleration_mps2[at] = 0.0
        self.seen_s[at] = time_s
        self.hits[at] = 1
        self._cycle_share[at] = kind[lane, detection] == _CYCLIST
        self.detection[at] = detection

    def _grow(self) -> None:
        """Doubles the slots."""
        lanes, slots = self.alive.shape

        def wider(array: np.ndarray) -> np.ndarray:  # type: ignore[type-arg]
            return np.concatenate([array, np.zeros_like(array)], axis=1)

        self.alive = wider(self.alive)
        self.id = wider(self.id)
        self.kind = wider(self.kind)
        self.xy_m = wider(self.xy_m)
        self.velocity_mps = wider(self.velocity_mps)
        self.acceleration_mps2 = wider(self.acceleration_mps2)
        self.seen_s = wider(self.seen_s)
        self.hits = wider(self.hits)
        self._seen_xy_m = wider(self._seen_xy_m)
        self._cycle_share = wider(self._cycle_share)
        self.detection = np.concatenate(
            [self.detection, np.full((lanes, slots), -1, np.intp)], axis=1
        )
