"""From detections to a decision: ground, track, predict, decide.

Run by the device, by a replay and by the lab. Frames bring their own time; the clock is read only
to measure the stages. No I/O.
"""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass

import numpy as np

from bikeped.config.build import framing, ground_camera, rule_settings, tracker_settings
from bikeped.config.load import LoadedConfig
from bikeped.decision.decider import Decider
from bikeped.decision.who_counts import counts
from bikeped.faults import Fault
from bikeped.geometry.camera import GroundTable
from bikeped.geometry.framing import Framing
from bikeped.tracking.tracker import Tracker, predict
from bikeped.types import Decision, Detections, FloatArray, GroundPoints, Kind, Tracks

#: Road users of one kind that are tracked of one frame, so that the decision stays under 5 ms
#: whatever the detector returns. A cap a kind, for vehicles must not push out cyclists; and as 48
#: of a kind stay present, what is left out cannot turn a WARNING into SAFE or IDLE.
MAX_OF_A_KIND = 48
CROWDED = Fault(
    "detector",
    "detector.crowded",
    f"more than {MAX_OF_A_KIND} of a kind: the faintest are left out",
)


class GroundMapper:
    """The configured camera, its framing and its ground table.

    Raises GeometryError when lens, framing and ground of the configuration do not fit together.
    """

    def __init__(self, loaded: LoadedConfig) -> None:
        sensor_framing = framing(loaded)
        self.camera = ground_camera(loaded)
        self.table = GroundTable(
            self.camera, *sensor_framing.crop_wh, step_px=loaded.config.camera.table_step_px
        )
        self._max_range_m = loaded.config.tracking.max_range_m
        #: The framing of frames of a width and height; GeometryError if they are another camera's.
        self.framing_for = functools.lru_cache(maxsize=1)(sensor_framing.for_frame)

    def to_ground(self, detections: Detections, frame: Framing) -> tuple[GroundPoints, int]:
        """Ground points within range, and how many detections do not end on the ground."""
        crop = frame.frame_to_crop(detections.bottom_centre_px())
        xy, valid = self.table.lookup(crop)
        near = valid & (np.nan_to_num(np.hypot(xy[:, 0], xy[:, 1]), nan=np.inf) < self._max_range_m)
        index = np.nonzero(near)[0]
        near_ones = detections.take(index)
        points = GroundPoints(
            near_ones.kind,
            xy[index],
            index.astype(np.int64),
            near_ones.ridden,
            near_ones.confidence,
        )
        return points, int((~valid).sum())


@dataclass(frozen=True)
class TrackingResult:
    """Tracks and decision of one frame, and the milliseconds that they took.

    `not_on_ground` counts detections that end above the horizon or outside the image circle: a few
    are reflections and hoardings; many mean a camera that is mounted otherwise than configured.
    """

    points: GroundPoints
    not_on_ground: int
    tracks: Tracks
    decision: Decision
    track_ms: float
    decide_ms: float


class TrackAndDecide:
    """The ground, tracking and decision stages, for frames in order of their capture times."""

    def __init__(
        self,
        loaded: LoadedConfig,
        cyclist_box_includes_rider: bool = False,
        ground_mapper: GroundMapper | None = None,
    ) -> None:
        """`cyclist_box_includes_rider`: as the detector says; `ground_mapper`: if already made."""
        config = loaded.config
        fps = config.decision.nominal_fps
        self.ground_mapper = ground_mapper or GroundMapper(loaded)
        self._tracker_settings = tracker_settings(
            config.tracking,
            fps,
            acceleration=config.latency.order == 2,
            cyclist_box_includes_rider=cyclist_box_includes_rider,
        )
        self._speed_window_s = config.tracking.speed_window_frames / fps
        self._history = config.tracking.history_frames
        self._rule = rule_settings(config.decision, config.tracking.speed_window_frames)
        self._latency = config.latency
        self._fixed_ahead_s = config.latency.frames / fps
        self.capped_frames = 0  #: frames of which not all detections were tracked
        self.fault: Fault | None = None  #: of the newest frame
        self.reset()

    def reset(self) -> None:
        """Forgets all tracks and decisions, as when a recording starts anew."""
        self.tracker = Tracker(self._tracker_settings, self._speed_window_s, self._history)
        self._decider = Decider(self._rule)
        self._last_s = -math.inf

    def update(
        self, detections: Detections, width: int, height: int, captured_s: float, age_s: float
    ) -> TrackingResult:
        """Tracks and decides a frame of `width` x `height` captured at `captured_s`.

        `age_s` is the frame's age now, compensated as section `latency` says. ValueError when
        `captured_s` is not later than that of the last frame.
        """
        began = time.perf_counter()
        mapper = self.ground_mapper
        points, not_on_ground = mapper.to_ground(detections, mapper.framing_for(width, height))
        self.fault = None
        if np.bincount(points.kind, minlength=1).max() > MAX_OF_A_KIND:
            points = _most_confident(points)
            self.capped_frames += 1
            self.fault = CROWDED
        return self.update_from_points(points, captured_s, age_s, not_on_ground, began)

    def update_from_points(
        self,
        points: GroundPoints,
        captured_s: float,
        age_s: float = 0.0,
        not_on_ground: int = 0,
        began: float | None = None,
    ) -> TrackingResult:
        """Tracks and decides from ground points: what `update` does after the ground table.

        `began` is the `time.perf_counter()` from which `track_ms` counts; None: now.
        """
        began = time.perf_counter() if began is None else began
        if not captured_s > self._last_s:  # NaN included
            raise ValueError(f"captured_s: {captured_s} is not after {self._last_s}")
        self._last_s = captured_s
        tracks = self.tracker.update(points, captured_s)
        tracked = time.perf_counter()
        velocity, _ = self.tracker.smoothed()
        counted = counts(tracks.unseen_s, self.tracker.parked(), self._rule.max_unseen_s)
        decision = self._decider.decide(
            captured_s, tracks.id, tracks.kind, self._ahead(tracks, age_s), velocity, counted
        )
        decided = time.perf_counter()
        track_ms, decide_ms = (tracked - began) * 1e3, (decided - tracked) * 1e3
        return TrackingResult(points, not_on_ground, tracks, decision, track_ms, decide_ms)

    def _ahead(self, tracks: Tracks, age_s: float) -> FloatArray:
        """Positions [n, 2] in metres that the rule uses: predicted ahead if so configured."""
        latency = self._latency
        if latency.compensation == "off":
            return tracks.xy_m
        ahead_s = self._fixed_ahead_s if latency.compensation == "frames" else age_s
        ahead_s = min(max(ahead_s + latency.camera_offset_s, 0.0), latency.max_s)
        velocity, acceleration = self.tracker.smoothed()
        return predict(tracks.xy_m, velocity, acceleration, ahead_s, latency.order)


def _most_confident(points: GroundPoints) -> GroundPoints:
    """Of each kind the `MAX_OF_A_KIND` most confident, of equals the nearest to the camera."""
    if points.confidence is None:
        return points
    distance_m = np.hypot(points.xy_m[:, 0], points.xy_m[:, 1])
    order = np.lexsort((distance_m, -points.confidence))
    kind = points.kind[order]
    return points.take(np.sort(np.concatenate([order[kind == k][:MAX_OF_A_KIND] for k in Kind])))
