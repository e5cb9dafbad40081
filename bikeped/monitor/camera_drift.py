"""Has the camera moved since it was aligned? The reference against the picture now.

The fit starts at the last pose. Now and then, and when few patches match, another one starts from
coarse pictures, and from turned poses if need be; the one with more matches counts. A verdict
changes when all measurements of some seconds say so, and stays while nothing can be measured. The
reference never changes: a camera that has moved does not become normal.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bikeped.errors import GeometryError
from bikeped.faults import Fault
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.monitor.drift_reference import (
    DriftReference,
    edge_strength,
    levels_of,
    make_reference,
    reduced,
)
from bikeped.monitor.patch_fit import Fit, PatchFit, Pose, rotation
from bikeped.types import FloatArray, ImageArray

#: Definitions, section 18. Pitch or roll of 2 degrees are a fault also where the view is so narrow
#: that they are less (faults.md, row 57), and so are 5 degrees about any axis (row 8).
NOTICE_M, FAULT_M, FAULT_TILT_DEG, FAULT_TURN_DEG = 0.3, 1.0, 1.8, 4.7
AT_M = 10.0
_START_S = 2.0  #: without a saved reference: the first pictures
_HOLD_S, _HOLD_MIN = 4.0, 3  #: all measurements of so long, at least so many, change a verdict
#: The fit from coarse pictures takes 12 ms; with the turned poses, of which _TRIED are tried in a
#: call, 40 ms. It is made every _SELDOM_S; where few patches match, every _SEARCH_S for _VAIN_S.
_TRIED, _SEARCH_S, _SELDOM_S, _VAIN_S = 60, 2.0, 10.0, 60.0
_TURNS = sorted(  # rotation vectors, radians: 18 degrees of roll and pitch, 24 of heading
    itertools.product(*(np.arange(-n, n + 1) * math.radians(6) for n in (3, 3, 4))),
    key=lambda turn: float(np.linalg.norm(turn)),
)
#: *Lost*: the share of patches that match fell from _SEEN to _LOST at once, and stays there, in a
#: picture that is as sharp as before: the camera looks elsewhere, or something stands before it.
_SEEN, _LOST, _LOST_WITHIN_S, _LOST_AFTER_S, _LOST_SHARPNESS = 0.35, 0.15, 5.0, 15.0, 0.5


@dataclass(frozen=True)
class Drift:
    """How far the camera is from its reference; medians of the last measurements.

    Signs are those of `GroundCamera`: pitch up, heading to the right, roll of the picture
    clockwise. NaN before there is a measurement.
    """

    pixels: float = math.nan  #: median over the patches, sensor pixels
    degrees: float = math.nan  #: of the turn about its axis
    pitch_deg: float = math.nan
    heading_deg: float = math.nan
    roll_deg: float = math.nan
    shift_m: float = math.nan
    metres_at_10m: float = (
        math.nan
    )  #: largest error of a place 10 m away, over the bearings in view
    inliers: int = 0  #: patches that match in this picture
    match: float = 0.0  #: their share of those that are in view
    judged: bool = False  #: whether this picture could be judged; otherwise the values are older
    lost: bool = False  #: the reference suddenly matches nowhere, in a picture as sharp as before
    since_start: bool = False  #: no alignment saved a reference: the first pictures are it
    moved: bool = False  #: a fault: the camera must be aligned again before its positions count
    moved_slightly: bool = False  #: a notice: align it again; the decision still holds

    def fault(self) -> Fault | None:
        """What to report. Its numbers stand in this object only: they change all the time."""
        since = "the service started" if self.since_start else "it was aligned"
        code, detail = "camera.moved", f"has moved since {since}; fasten it and align it again"
        if self.moved and self.lost:
            return Fault("camera", code, f"sees nothing of what it saw when {since}")
        if self.moved_slightly:
            return Fault(
                "camera", "camera.moved_slightly", detail.replace("moved", "moved a little")
            )
        return Fault("camera", code, detail) if self.moved else None


class DriftCheck:
    """Compares a picture now and then (once a second) with the reference. Not thread-safe.

    `size` (width, height): that pictures are reduced to; larger ones take longer.
    """

    def __init__(
        self, reference: DriftReference | None, camera: GroundCamera, framing: Framing
    ) -> None:
        """`reference` None: the first 2 s of pictures are it. GeometryError when the reference was
        saved with another lens, pose or sensor."""
        self._camera, self._framing = camera, framing
        self.size = levels_of(camera, framing)[0]
        self._first: list[tuple[float, ImageArray]] = []
        self._fit: PatchFit | None = None
        self._last, self._next_turn = Pose.unmoved(), 0
        self._measured: deque[tuple[float, tuple[float, ...]]] = deque()
        self._moved = self._slightly = False
        self._drift = Drift(since_start=reference is None)
        self._judged_s = self._searched_s = self._seen_s = -math.inf
        self._lost_since_s = math.inf
        if reference is not None:
            if (reference.camera, reference.framing) != (camera, framing):
                raise GeometryError(
                    "camera.reference: was saved with another lens, pose or frame size than the "
                    "configuration has; align the camera again"
                )
            self._fit, self._sharpness = PatchFit(reference), reference.sharpness

    def update(self, picture: ImageArray, time_s: float) -> Drift | None:
        """The drift by this picture ([h, w] grey or [h, w, 3] RGB, a scaled copy of the sensor's
        picture) at `time_s`, which only grows. None while the first pictures are collected."""
        grey = reduced(picture, self.size)
        if self._fit is None:
            self._begin(grey, time_s)
            return None
        found, sharpness = self._search(self._fit, grey, time_s)
        if found.counts:
            self._last, self._judged_s, self._next_turn = found.pose, time_s, 0
            self._decide(self._fit, found.pose, time_s)
        lost = self._is_lost(found.match, sharpness, time_s)
        self._drift = replace(
            self._drift,
            inliers=int(found.inlier.sum()),
            match=found.match,
            judged=found.counts,
            lost=lost,
            moved=self._moved or lost,
            moved_slightly=self._slightly and not (self._moved or lost),
        )
        return self._drift

    def _begin(self, grey: ImageArray, time_s: float) -> None:
        """Collects the first pictures and makes the reference of them."""
        self._first.append((time_s, grey))
        if time_s - self._first[0][0] < _START_S:
            return
        pictures, self._first = [one for _, one in self._first], []
        with contextlib.suppress(GeometryError):  # too dark, or too much traffic: begin again
            reference = make_reference(pictures, self._camera, self._framing)
            self._fit, self._sharpness = PatchFit(reference), reference.sharpness
            self._seen_s = time_s

    def _search(self, fit: PatchFit, grey: ImageArray, time_s: float) -> tuple[Fit, float]:
        """The best fit to this picture, and the picture's sharpness."""
        finest, sharpness = edge_strength(grey)
        found = fit.fit([finest], self._last, 3)
        fresh = not found.counts and time_s - self._judged_s < _VAIN_S
        if time_s < self._searched_s + (_SEARCH_S if fresh else _SELDOM_S):
            return found, sharpness
        self._searched_s = time_s
        pictures = [finest]
        for _ in fit.sizes[1:]:
            grey = np.asarray(cv2.pyrDown(grey), np.uint8)
            pictures.append(edge_strength(grey)[0])
        tries = [found, fit.fit(pictures, Pose.unmoved(), 5)]
        if not any(one.counts for one in tries):
            turns = _TURNS[self._next_turn : self._next_turn + _TRIED]
            self._next_turn = (self._next_turn + _TRIED) % len(_TURNS)
            poses = [Pose(rotation(np.array(turn)), np.zeros(3)) for turn in turns]
            best = np.argsort(-fit.coarse_match(pictures[-1], poses))[:2]
            tries += [fit.fit(pictures, poses[int(index)], 5) for index in best]
        return max(tries, key=lambda one: (one.counts, one.match)), sharpness

    def _decide(self, fit: PatchFit, pose: Pose, time_s: float) -> None:
        """Takes a measurement in: medians and verdicts of the last ones, if they are enough."""
        before, now = _angles(self._camera, np.eye(3)), _angles(self._camera, pose.turn)
        turn, shift = (
            float(np.linalg.norm(v)) for v in (cv2.Rodrigues(pose.turn)[0], pose.shift_m)
        )
        numbers = (
            fit.moved_px(pose),
            math.degrees(turn),
            *np.degrees(now - before).tolist(),
            shift,
        )
        self._measured.append((time_s, (*numbers, misplaced_m(self._camera, pose))))
        while len(self._measured) > _HOLD_MIN and self._measured[1][0] <= time_s - _HOLD_S:
            self._measured.popleft()
        if len(self._measured) < _HOLD_MIN:
            return
        values = np.array([one for _, one in self._measured])
        pixels, degrees, pitch, heading, roll, shift, off = np.median(values, axis=0).tolist()
        self._drift = replace(
            self._drift,
            pixels=pixels,
            degrees=degrees,
            pitch_deg=pitch,
            heading_deg=heading,
            roll_deg=roll,
            shift_m=shift,
            metres_at_10m=off,
        )
        if self._measured[0][0] <= time_s - _HOLD_S:
            tilt = np.abs(values[:, [2, 4]]).max(axis=1)  # pitch and roll
            moved = (values[:, 6] >= FAULT_M) | (tilt >= FAULT_TILT_DEG)
            moved |= values[:, 1] >= FAULT_TURN_DEG
            slightly = values[:, 6] >= NOTICE_M
            self._moved = bool(moved.any() if self._moved else moved.all())
            self._slightly = bool(slightly.any() if self._slightly else slightly.all())

    def _is_lost(self, match: float, sharpness: float, time_s: float) -> bool:
        if match >= _SEEN:
            self._seen_s, self._sharpness = time_s, sharpness
        if match >= _LOST or sharpness < _LOST_SHARPNESS * self._sharpness:
            self._lost_since_s = math.inf
        elif math.isinf(self._lost_since_s) and time_s - self._seen_s <= _LOST_WITHIN_S:
            self._lost_since_s = time_s
        return time_s - self._lost_since_s >= _LOST_AFTER_S


def misplaced_m(camera: GroundCamera, pose: Pose) -> float:
    """How far off the camera places a point 10 m away that it sees from `pose`: the largest
    distance in metres over the bearings in view; at most 100."""
    bearing = np.radians(np.arange(-90, 91, 3) + camera.heading_deg)
    place = AT_M * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    _, seen = camera.project(place)
    if not seen.any():  # looks steeply down: what the lens would show there
        _, seen = replace(camera, window_px=None).project(place)
    place = place[seen]
    from_lens = np.concatenate([place, np.full((len(place), 1), -camera.height_m)], axis=1)
    moved = (from_lens - pose.shift_m) @ pose.turn
    away = np.where(moved[:, 2] < 0, -camera.height_m / np.minimum(moved[:, 2], -1e-6), np.inf)
    off = np.hypot(*(moved[:, :2] * np.minimum(away, 1e4)[:, None] - place).T)
    return float(min(off.max(initial=0.0), 100.0))


def _angles(camera: GroundCamera, turn: FloatArray) -> FloatArray:
    """Pitch, heading and roll in radians [3] of the camera after a turn in ground axes."""
    forward, beside = camera.rays([[camera.cx, camera.cy], [camera.cx + 1, camera.cy]]) @ turn.T
    right = beside - forward * (beside @ forward)
    right /= np.linalg.norm(right)
    pitch = math.asin(max(-1.0, min(1.0, forward[2])))
    roll = math.asin(max(-1.0, min(1.0, right[2] / max(math.cos(pitch), 1e-6))))
    return np.array([pitch, math.atan2(forward[1], forward[0]), roll])
