"""The bird's-eye-view tracker (definitions, section 7), batched over independent scenes.

The device tracks a batch of one scene; the simulation runs the same code over hundreds of Monte
Carlo trials at once. All scenes share the clock; tracks of one never match detections of another.
State is held in arrays [batch, slots], where a slot holds one track until it is dropped.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bikeped.tracking.kalman import MotionNoise, correct
from bikeped.tracking.kinds import cycle_evidence, first_kind, next_kind
from bikeped.tracking.matching import IndexArray, match_greedy
from bikeped.types import BoolArray, Float32Array, FloatArray, IntArray, Kind, KindArray

#: Slack of comparisons between times, far below a frame and far above rounding.
_EPSILON_S = 1e-6
_PEDESTRIAN, _CYCLIST, _VEHICLE = (int(k) for k in (Kind.PEDESTRIAN, Kind.CYCLIST, Kind.VEHICLE))
#: Weight of the newest step in the smoothed acceleration, per nominal frame.
_ACCELERATION_WEIGHT = 0.15
#: A cyclist's track unseen for longer is not continued by a detection of a person.
_RIDER_MAX_UNSEEN_S = 1.0
#: A cycle that stands (definitions, section 13): it moves no farther than this, for so long, and no
#: person has been this near within the last seconds, for a waiting rider is missed now and then.
_STANDS_M, _PARKED_AFTER_S, _PERSON_M, _PERSON_MEMORY_S = 0.5, 10.0, 1.0, 2.0
#: A track that is not yet confirmed is dropped when unseen for longer than this.
_TENTATIVE_MAX_UNSEEN_S = 0.2


@dataclass(frozen=True)
class TrackerSettings:
    """Tracker parameters; times in seconds, lengths in metres.

    The defaults are the tracker of the paper's simulation (definitions, section 7); the device's
    come from the configuration. A match is gated by `max_speed_mps` of its kind (pedestrian,
    cyclist, vehicle): a detection may lie at most speed * time since last seen +
    `position_noise_m` from the track's last position. `motion` gives the Kalman filter of the
    device's; without it tracks are where their detections are, and their velocity is an exponential
    mean with `velocity_weight` per `frame_s` for the newest step, from zero. A track that coasts
    farther than `max_range_m` from the origin is dropped.

    `rider_radius_m`: detectors see a small bicycle in some frames and only its rider in others. A
    person without a track within this radius of an unmatched cyclist's track continues that track
    (and the reverse), so that one rider does not become a cyclist and a pedestrian who close in.
    0: never, as in the paper's simulation, whose agents have one kind.
    `max_tracks`: above it, those unseen for longest are dropped, unconfirmed ones first; 0: no cap.
    `cyclist_box_includes_rider`: the detector boxes rider and cycle as one, so a track has the kind
    of most of its recent detections. `acceleration`: estimate it, for second-order prediction.
    """

    match_radius_m: float = 3.0
    max_unseen_s: float = 30 / 30
    motion: MotionNoise | None = None
    velocity_weight: float = 0.5
    frame_s: float = 1 / 30
    confirm_hits: int = 1
    max_speed_mps: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    position_noise_m: float = math.inf
    max_range_m: float = math.inf
    rider_radius_m: float = 0.0
    cyclist_box_includes_rider: bool = False
    acceleration: bool = True
    max_tracks: int = 0


class BatchTracker:
    """Tracks of a batch of `scenes` independent scenes: `update` once a frame, then read arrays.

    Arrays are [batch, slots]; positions (m), velocities and accelerations [batch, slots, 2]. Values
    in slots with `alive` false are undefined. `id` counts up from 1 in each scene in order of
    birth; `detection` is the index matched in the last update, or -1; `parked` marks cycles that
    stand without a person, until they move. `covariance` [batch, slots, 3] is that of `kalman`, at
    the time `seen_s`.
    """

    def __init__(self, settings: TrackerSettings, scenes: int = 1, slots: int = 8) -> None:
        self.settings = settings
        self.time_s = -math.inf
        self.alive: BoolArray = np.zeros((scenes, slots), np.bool_)
        self.id: IntArray = np.zeros((scenes, slots), np.int64)
        self.kind: KindArray = np.zeros((scenes, slots), np.int8)
        self.xy_m: FloatArray = np.zeros((scenes, slots, 2))
        self.velocity_mps: FloatArray = np.zeros((scenes, slots, 2))
        self.acceleration_mps2: FloatArray = np.zeros((scenes, slots, 2))
        self.covariance: FloatArray = np.zeros((scenes, slots, 3))
        self.seen_s: FloatArray = np.zeros((scenes, slots))
        self.hits: IntArray = np.zeros((scenes, slots), np.int64)
        self.detection: IndexArray = np.full((scenes, slots), -1, np.intp)
        self.parked: BoolArray = np.zeros((scenes, slots), np.bool_)
        self._seen_xy_m: FloatArray = np.zeros((scenes, slots, 2))
        self._stands_xy_m: FloatArray = np.zeros((scenes, slots, 2))
        self._stands_s: FloatArray = np.zeros((scenes, slots))
        self._person_s: FloatArray = np.zeros((scenes, slots))
        self._cycle_share: FloatArray = np.zeros((scenes, slots))
        self._next_id: IntArray = np.ones(scenes, np.int64)
        self._max_speed = np.asarray(settings.max_speed_mps)
        self._gated = bool(np.isfinite(self._max_speed).any())
        motion = settings.motion or MotionNoise()
        # A pair, for `_grow` widens every array.
        self._motion = motion.noise(settings.frame_s), motion.first_covariance()

    @property
    def reported(self) -> BoolArray:
        """[batch, slots]: the tracks that count as present."""
        return self.alive & (self.hits >= self.settings.confirm_hits)

    def update(
        self,
        time_s: float,
        xy_m: FloatArray,
        kind: KindArray,
        ridden: BoolArray | None = None,
        confidence: Float32Array | None = None,
    ) -> None:
        """Advances every scene to `time_s` with detections `xy_m` [batch, n, 2] in metres.

        `kind` [batch, n]; -1 marks an unused place, for scenes differ in their number of
        detections. `ridden` [batch, n]: cycles whose rider was seen with them; `confidence`
        [batch, n]: of the detections, of a ridden cycle that of the cycle alone; None: all clear.
        ValueError when time goes back.
        """
        if time_s < self.time_s:
            raise ValueError(f"time_s: {time_s} is before the last update at {self.time_s}")
        step_s = time_s - self.time_s if math.isfinite(self.time_s) else 0.0
        self.time_s = time_s
        if step_s > 2 * self.settings.frame_s:
            # After a gap in time: drop expired tracks first, so that they are not matched.
            self.alive &= time_s - self.seen_s <= (
                self.settings.max_unseen_s + 1.5 * self.settings.frame_s
            )
        self.xy_m += self.velocity_mps * step_s  # free slots move along, unread
        matched, refused = self._match(xy_m, kind)
        self.detection = matched
        whole = self.settings.cyclist_box_includes_rider
        cycle = cycle_evidence(kind, None if whole else confidence)
        self._correct(time_s, xy_m, kind, matched, cycle)
        self._find_parked(time_s, xy_m, kind, ridden)
        self._drop(time_s)
        fresh = kind >= 0
        scene, slot = (matched >= 0).nonzero()
        fresh[scene, matched[scene, slot]] = False
        if refused is not None:
            fresh &= ~refused
        if np.count_nonzero(fresh):
            if self.settings.max_tracks:
                self._make_room(fresh)
            self._add(time_s, xy_m, kind, fresh, cycle, ridden)

    def _match(self, xy_m: FloatArray, kind: KindArray) -> tuple[IndexArray, BoolArray | None]:
        """Detection of each slot, and the detections that only the gate kept from a free track."""
        scenes, slots = self.alive.shape
        detections = kind.shape[1]
        track_xy = np.where(self.alive[..., None], self.xy_m, np.nan)  # NaN is near nothing
        dx = track_xy[:, :, None, 0] - xy_m[:, None, :, 0]
        dy = track_xy[:, :, None, 1] - xy_m[:, None, :, 1]
        cost = dx * dx + dy * dy
        scene, slot, detection = (cost <= self.settings.match_radius_m**2).nonzero()
        # Flat indices over the batch: what follows runs over the few near pairs only.
        track = scene * slots + slot
        place = scene * detections + detection
        near_cost = cost[scene, slot, detection]
        same = self.kind.ravel()[track] == kind.ravel()[place]
        shape = (scenes * slots, scenes * detections)
        if not self._gated:
            matched = match_greedy(track[same], place[same], near_cost[same], *shape)
            return self._per_slot(matched, detections), None
        reach = (
            self._max_speed[self.kind.ravel()[track]] * (self.time_s - self.seen_s.ravel()[track])
            + self.settings.position_noise_m
        )
        displacement = xy_m.reshape(-1, 2)[place] - self._seen_xy_m.reshape(-1, 2)[track]
        allowed = same & ((displacement**2).sum(1) <= reach**2)
        matched = match_greedy(track[allowed], place[allowed], near_cost[allowed], *shape)
        # The gate may refuse a match but must not start a track: a detection beside a free track of
        # its kind, but too far for one frame, waits until the gate has widened.
        refused = np.zeros(scenes * detections, np.bool_)
        refused[place[same & ~allowed & (matched[track] < 0)]] = True
        if self.settings.rider_radius_m > 0 and np.count_nonzero(same) < len(same):
            self._match_riders(track, place, near_cost, kind, matched, refused)
        return self._per_slot(matched, detections), refused.reshape(scenes, detections)

    def _match_riders(
        self,
        track: IndexArray,
        place: IndexArray,
        cost: FloatArray,
        kind: KindArray,
        matched: IndexArray,
        refused: BoolArray,
    ) -> None:
        """Matches free pedestrians with free cyclists' tracks (riders), and the reverse.

        Writes into `matched`; `kinds` decides the kind of the track.
        """
        taken = np.zeros(len(refused), np.bool_)
        taken[matched[matched >= 0]] = True
        track_kind, detected_kind = self.kind.ravel()[track], kind.ravel()[place]
        allowed = (
            (track_kind != detected_kind)
            & (detected_kind >= 0)
            & (track_kind != _VEHICLE)
            & (detected_kind != _VEHICLE)
            & (cost <= self.settings.rider_radius_m**2)
            & (matched[track] < 0)
            & ~taken[place]
            & ~refused[place]
            & (self.time_s - self.seen_s.ravel()[track] <= _RIDER_MAX_UNSEEN_S)
        )
        shape = (len(matched), len(refused))
        riders = match_greedy(track[allowed], place[allowed], cost[allowed], *shape)
        found = riders >= 0
        matched[found] = riders[found]

    def _per_slot(self, matched: IndexArray, detections: int) -> IndexArray:
        """[batch, slots] index within the scene, from the flat index over the batch."""
        shaped = matched.reshape(self.alive.shape)
        if len(shaped) == 1:
            return shaped
        return np.where(shaped >= 0, shaped - np.arange(len(shaped))[:, None] * detections, -1)

    def _correct(
        self,
        time_s: float,
        xy_m: FloatArray,
        kind: KindArray,
        matched: IndexArray,
        cycle: FloatArray,
    ) -> None:
        # Views with one flat index over the batch: half the time of indexing scene and slot.
        flat = (matched.ravel() >= 0).nonzero()[0]
        if len(flat) == 0:
            return
        scene = flat // matched.shape[1]
        velocity = self.velocity_mps.reshape(-1, 2)
        acceleration = self.acceleration_mps2.reshape(-1, 2)
        covariance = self.covariance.reshape(-1, 3)
        seen_xy = self._seen_xy_m.reshape(-1, 2)
        seen_s, hits = self.seen_s.reshape(-1), self.hits.reshape(-1)
        place = scene * xy_m.shape[1] + matched.ravel()[flat]
        new_xy = xy_m.reshape(-1, 2)[place]
        elapsed = np.maximum(time_s - seen_s[flat], _EPSILON_S)
        old_v, kinds = velocity[flat], self.kind.reshape(-1)[flat]
        weight = self.settings.velocity_weight
        if self.settings.motion is None:
            kept = self._kept(weight, elapsed)
            new_v = old_v * kept + (new_xy - seen_xy[flat]) / elapsed[:, None] * (1 - kept)
        else:
            weight = _ACCELERATION_WEIGHT
            new_xy, new_v, covariance[flat] = correct(
                self.xy_m.reshape(-1, 2)[flat],
                old_v,
                covariance[flat],
                new_xy,
                elapsed,
                self._motion[0][kinds],
            )
        if self._gated:
            limit = self._max_speed[kinds]
            over = (new_v * new_v).sum(1) > limit * limit
            if np.count_nonzero(over):
                speed = np.hypot(new_v[over, 0], new_v[over, 1])
                new_v[over] *= (limit[over] / speed)[:, None]
        velocity[flat] = new_v
        if self.settings.acceleration:
            kept = self._kept(weight, elapsed)
            raw_a = (new_v - old_v) / elapsed[:, None]
            acceleration[flat] = acceleration[flat] * kept + raw_a * (1 - kept)
        self.xy_m.reshape(-1, 2)[flat] = new_xy
        seen_xy[flat] = new_xy
        stands = self._stands_xy_m.reshape(-1, 2)
        moved = flat[((new_xy - stands[flat]) ** 2).sum(1) > _STANDS_M**2]
        if len(moved):
            stands[moved] = self.xy_m.reshape(-1, 2)[moved]
            self._stands_s.reshape(-1)[moved] = time_s
            self.parked.reshape(-1)[moved] = False
        seen_s[flat] = time_s
        hits[flat] += 1
        if self.settings.rider_radius_m > 0:
            self._update_kind(flat, cycle.ravel()[place])

    def _kept(self, weight: float, elapsed_s: FloatArray) -> FloatArray:
        """[n, 1]: what is kept of a mean whose newest value has `weight` each nominal frame."""
        return np.asarray((1 - weight) ** (elapsed_s / self.settings.frame_s))[:, None]

    def _find_parked(
        self, time_s: float, xy_m: FloatArray, kind: KindArray, ridden: BoolArray | None
    ) -> None:
        """Marks cycles that have stood for long and have no person beside them."""
        if self.settings.cyclist_box_includes_rider:
            return  # every cycle is ridden
        stood_s = time_s - self._stands_s
        still = self.alive & (self.kind == _CYCLIST) & ~self.parked
        still &= stood_s >= _PARKED_AFTER_S - _PERSON_MEMORY_S
        scene, slot = still.nonzero()
        if len(scene) == 0:
            return
        distance_m2 = ((self.xy_m[scene, slot, None] - xy_m[scene]) ** 2).sum(-1)
        person = ((kind[scene] == _PEDESTRIAN) & (distance_m2 <= _PERSON_M**2)).any(axis=1)
        if ridden is not None:  # index -1 reads the last place: unmatched
            unmatched = np.zeros((len(ridden), 1), np.bool_)
            person |= np.hstack([ridden, unmatched])[scene, self.detection[scene, slot]]
        self._person_s[scene[person], slot[person]] = time_s
        alone = time_s - self._person_s[scene, slot] > _PERSON_MEMORY_S
        self.parked[scene, slot] = alone & (stood_s[scene, slot] >= _PARKED_AFTER_S - _EPSILON_S)

    def _update_kind(self, flat: IndexArray, cycle: FloatArray) -> None:
        share, kind = self._cycle_share.reshape(-1), self.kind.reshape(-1)
        if np.count_nonzero(share[flat] != cycle):  # else detected as always
            hits = self.hits.reshape(-1)[flat]
            whole = self.settings.cyclist_box_includes_rider
            kind[flat], share[flat] = next_kind(kind[flat], share[flat], cycle, hits, whole)

    def _drop(self, time_s: float) -> None:
        unseen = time_s - self.seen_s
        self.alive &= unseen <= self.settings.max_unseen_s + _EPSILON_S
        if self.settings.confirm_hits > 1:
            confirmed = self.hits >= self.settings.confirm_hits
            self.alive &= confirmed | (unseen <= _TENTATIVE_MAX_UNSEEN_S + _EPSILON_S)
        if math.isfinite(self.settings.max_range_m):
            self.alive &= (self.xy_m**2).sum(-1) <= self.settings.max_range_m**2

    def _make_room(self, fresh: BoolArray) -> None:
        """Drops tracks not seen now, where there would be more than `max_tracks` with `fresh`."""
        over = self.alive.sum(axis=1) + fresh.sum(axis=1) - self.settings.max_tracks
        for scene in (over > 0).nonzero()[0]:
            unseen = (self.alive[scene] & (self.seen_s[scene] < self.time_s)).nonzero()[0]
            confirmed = self.hits[scene, unseen] >= self.settings.confirm_hits
            order = np.lexsort((self.seen_s[scene, unseen], confirmed))
            self.alive[scene, unseen[order[: over[scene]]]] = False

    def _add(
        self,
        time_s: float,
        xy_m: FloatArray,
        kind: KindArray,
        fresh: BoolArray,
        cycle: FloatArray,
        ridden: BoolArray | None,
    ) -> None:
        need = fresh.sum(axis=1)
        while (need > (~self.alive).sum(axis=1)).any():
            self._grow()
        free = np.argsort(self.alive, axis=1, kind="stable")  # free slots first, in slot order
        order = fresh.cumsum(axis=1) - 1
        scene, detection = np.nonzero(fresh)
        rank = order[scene, detection]
        at = (scene, free[scene, rank])
        self.alive[at] = True
        self.id[at] = self._next_id[scene] + rank
        self._next_id += need
        self.kind[at], self._cycle_share[at] = first_kind(
            kind[scene, detection],
            cycle[scene, detection],
            None if ridden is None else ridden[scene, detection],
        )
        self.xy_m[at] = xy_m[scene, detection]
        self._seen_xy_m[at] = self._stands_xy_m[at] = xy_m[scene, detection]
        self._stands_s[at] = time_s
        self._person_s[at] = -math.inf
        self.parked[at] = False
        self.velocity_mps[at] = 0.0
        self.acceleration_mps2[at] = 0.0
        self.covariance[at] = self._motion[1][kind[scene, detection]]
        self.seen_s[at] = time_s
        self.hits[at] = 1
        self.detection[at] = detection

    def _grow(self) -> None:
        """Doubles the slots."""
        for name, array in vars(self).items():
            if isinstance(array, np.ndarray) and array.ndim > 1:
                fill = np.full_like(array, -1 if name == "detection" else 0)
                setattr(self, name, np.concatenate([array, fill], axis=1))
