"""Has the camera moved since it was aligned? The reference against the picture now.

The patches of the reference are fitted to the picture by a small turn and shift of the camera
(inverse compositional Gauss-Newton on normalised patches; Baker and Matthews 2004), each patch
weighted by how well it matches: people, vehicles, shadows and fresh snow match nothing and drop
out. A patch on a straight edge counts across the edge only. A start near the last pose is tried
first; when few patches match there, the fit starts from coarse pictures and from turned poses.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bikeped.errors import GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.monitor.drift_reference import (
    COMPARED,
    FAR_M,
    PATCH_PX,
    DriftReference,
    edge_strength,
    levels_of,
    make_reference,
    normalised,
    reduced,
    sampled,
)
from bikeped.types import BoolArray, Float32Array, FloatArray, ImageArray

#: Definitions, section 18; a turn of 2 degrees about any axis is a fault, too (faults.md, row 57).
NOTICE_M, FAULT_M, FAULT_DEG = 0.3, 1.0, 1.8
AT_M = 10.0
_START_S = 2.0  #: without a saved reference: the first pictures
_MEDIAN_OF, _MEDIAN_S, _MEDIAN_MIN = 5, 20.0, 3  #: measurements, within these seconds, at least
_MIN_MATCH, _MIN_INLIERS, _MAX_SIGMA_DEG = 0.2, 12, 0.15  #: of the patches in view: a fit counts
_MATCHES, _OFF_PX = 0.6, 1.0  #: correlation and distance of a patch that matches
_SIGMA_PX, _SHIFT_SIGMA_M = 0.4, 0.08
_STEP_DEG, _TRIED = 6.0, 60  #: turned poses that are tried, and how many in a call
_GRID = sorted(
    itertools.product(*(np.arange(-n, n + 1) * math.radians(_STEP_DEG) for n in (3, 3, 4))),
    key=lambda turn: float(np.linalg.norm(turn)),
)
#: *Lost*: from this share of matching patches to that one, for so long, in a picture as sharp.
_LOST_FROM, _LOST_AT, _LOST_GAP_S, _LOST_S, _LOST_SHARP = 0.35, 0.1, 5.0, 15.0, 0.5


@dataclass(frozen=True)
class Drift:
    """How far the camera is from its reference; medians of the last measurements.

    Signs are those of `GroundCamera`: pitch up, heading to the right, roll of the picture
    clockwise. NaN before there is a measurement.
    """

    pixels: float  #: median over the patches, sensor pixels
    degrees: float  #: of the turn about its axis
    pitch_deg: float
    heading_deg: float
    roll_deg: float
    shift_m: float
    metres_at_10m: float  #: largest error of a place 10 m away, over the bearings in view
    inliers: int  #: patches that match in this picture
    match: float  #: their share of those that are in view
    judged: bool  #: whether this picture could be judged; otherwise the values are older
    lost: bool  #: the reference suddenly matches nowhere, in a picture as sharp as before
    since_start: bool  #: no alignment saved a reference: the first pictures are it

    @property
    def is_fault(self) -> bool:
        """Whether the camera must be aligned again before its positions count."""
        return self.lost or self.metres_at_10m >= FAULT_M or self.degrees >= FAULT_DEG

    @property
    def is_notice(self) -> bool:
        """Whether an operator should align it again, while the decision still holds."""
        return not self.is_fault and self.metres_at_10m >= NOTICE_M


@dataclass(frozen=True)
class Pose:
    """A turn [3, 3] and shift [3] (m) of the camera against its reference, in ground axes."""

    turn: FloatArray
    shift_m: FloatArray

    @staticmethod
    def unmoved() -> Pose:
        return Pose(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Fit:
    """A pose, which patches match there and are in view, the turn's standard error."""

    pose: Pose
    inlier: BoolArray
    in_view: BoolArray
    sigma_deg: float

    @property
    def match(self) -> float:
        """Share of the patches in view that match."""
        return float(self.inlier.sum() / max(int(self.in_view.sum()), len(self.inlier) // 3, 1))

    @property
    def counts(self) -> bool:
        """Whether enough patches match, and so spread that they fix the turn."""
        enough = self.inlier.sum() >= _MIN_INLIERS and self.match >= _MIN_MATCH
        return bool(enough and self.sigma_deg <= _MAX_SIGMA_DEG)


class PatchFit:
    """Fits the pose of a camera by the patches of a reference. Immutable."""

    def __init__(self, reference: DriftReference) -> None:
        self._camera = replace(reference.camera, window_px=None)
        self.sizes = levels_of(reference.camera, reference.framing)
        self._view = reference.framing.for_frame(*self.sizes[0])
        self._uv = reference.uv_px / self._view.scale
        n = len(self._uv)
        near = np.isfinite(reference.ground_m).all(axis=1)
        reach = np.where(near, self._camera.height_m / -np.where(near, reference.ray[:, 2], -1), FAR_M)
        self._xyz_m = reference.ray * reach[:, None]
        step = 2.0
        beside = [(step, 0), (0, step), (-step, 0), (0, -step)]
        rays = self._camera.rays(self._view.frame_to_crop(self._uv + np.array(beside)[:, None]))
        self._around_m = np.where(np.isfinite(rays), rays, reference.ray) * reach[:, None]
        self._around_px = 2 * step
        home, tiny = self.project(self._xyz_m, Pose.unmoved()), 1e-4
        moves = [Pose(_rotation(tiny * axis), np.zeros(3)) for axis in np.eye(3)]
        moves += [Pose(np.eye(3), tiny * axis) for axis in np.eye(3)]
        self._slope = np.stack([(self.project(self._xyz_m, m) - home) / tiny for m in moves], -1)
        self._levels = [_Level(reference.patches[:, i]) for i in range(len(self.sizes))]
        self._all = n

    def project(self, xyz_m: FloatArray, pose: Pose) -> FloatArray:
        """Pixels [..., 2] of the finest picture of points [..., 3] from the lens, ground axes."""
        moved = (xyz_m - pose.shift_m) @ pose.turn
        uv, _ = self._camera.project(moved + (0.0, 0.0, self._camera.height_m))
        return self._view.crop_to_frame(uv)

    def fit(self, pictures: list[Float32Array], start: Pose, coarsest: int, steps: int) -> Fit:
        """Fits from `start`, first in the picture `coarsest`, last in the finest (0)."""
        pose, information = start, np.eye(6)
        shift_weight = np.diag([1e-3] * 3 + [_SHIFT_SIGMA_M**-2] * 3)
        for number in range(coarsest, -1, -1):
            level, slope = self._levels[number], self._slope / 2**number
            shape = self._shape(pose)
            for _ in range(steps):
                match, off, _ = self._compare(pictures[number], number, pose, shape)
                weight = np.clip((match - 0.2) / 0.5, 0, 1) ** 2
                weight /= (1 + (off**2).sum(axis=1)) * _SIGMA_PX**2
                weighted = (weight[:, None, None] * slope).transpose(0, 2, 1)
                information = (weighted @ level.share @ slope).sum(axis=0) + shift_weight
                pull = (weighted @ off[..., None]).sum(axis=0)[:, 0]
                pull[3:] += shift_weight[3:, 3:] @ pose.shift_m
                move = np.linalg.solve(information, pull)
                back = _rotation(move[:3]).T
                pose = Pose(back @ pose.turn, back @ (pose.shift_m - move[3:]))
                if np.abs(move[:3]).max() < 2e-4:
                    break
        match, off, in_view = self._compare(pictures[0], 0, pose, self._shape(pose))
        inlier = (match > _MATCHES) & (np.hypot(off[:, 0], off[:, 1]) < _OFF_PX)
        sigma = np.sqrt(np.diag(np.linalg.inv(information))[:3].max())
        return Fit(pose, inlier, in_view, math.degrees(float(sigma)))

    def coarse_match(self, picture: Float32Array, poses: list[Pose]) -> FloatArray:
        """How well the patches match the coarsest picture at each of some poses [n]."""
        number = len(self.sizes) - 1
        level = self._levels[number]
        uv = np.stack([self.project(self._xyz_m, pose) for pose in poses])[:, ::2]
        now, _ = normalised(sampled(picture, uv.reshape(-1, 1, 2) / 2**number + COMPARED))
        match = (now.reshape(len(poses), -1, PATCH_PX**2) * level.patch[::2]).sum(axis=-1)
        match[~self._inside(uv)] = 0
        return np.asarray(np.clip(match, 0, None).mean(axis=1), np.float64)

    def moved_px(self, pose: Pose) -> float:
        """Median distance of the patches from where they were, in sensor pixels."""
        gone = self.project(self._xyz_m, pose) - self._uv
        return float(np.median(np.hypot(gone[:, 0], gone[:, 1])) * self._view.scale)

    def _shape(self, pose: Pose) -> FloatArray:
        """How the surroundings of every patch are turned and stretched [n, 2, 2]."""
        right, down, left, up = self.project(self._around_m, pose)
        return np.stack([right - left, down - up], axis=-1) / self._around_px

    def _inside(self, uv: FloatArray) -> BoolArray:
        edge = PATCH_PX / 2
        low, high = (uv > edge).all(axis=-1), (uv < np.array(self.sizes[0]) - edge).all(axis=-1)
        return np.asarray(low & high)

    def _compare(
        self, picture: Float32Array, number: int, pose: Pose, shape: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Correlation [n] of every patch at a pose, its distance [n, 2] from there in pixels of
        the level (across an edge only), and whether it is in view [n]."""
        level, uv = self._levels[number], self.project(self._xyz_m, pose)
        at = uv[:, None] / 2**number + COMPARED @ shape.transpose(0, 2, 1)
        now, length = normalised(sampled(picture, at))
        match = np.einsum("ks,ks->k", now, level.patch)
        in_view = self._inside(uv)
        off = np.matmul(level.across, (now - level.patch)[..., None])[..., 0]
        off *= in_view[:, None]
        return np.where(in_view & (length > 1e-2), match, -1.0), off, in_view


class _Level:
    """The patches of one picture of the pyramid, ready to be compared.

    `patch` [n, samples]: normalised; `across` [n, 2, samples]: reads a distance in pixels off the
    difference of two patches; `share` [n, 2, 2]: what of a displacement it can read (trace 1).
    """

    def __init__(self, patches: Float32Array) -> None:
        inner = patches[:, 1:-1, 1:-1].reshape(len(patches), -1)
        self.patch, length = normalised(inner)
        du = (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]).reshape(inner.shape) / 2
        dv = (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]).reshape(inner.shape) / 2
        slope = np.stack([du, dv], axis=1) / np.maximum(length, 1e-3)[:, None, None]
        slope -= slope.mean(axis=2, keepdims=True)  # mean and contrast of a patch are free
        slope -= (slope @ self.patch[..., None]) * self.patch[:, None]
        power = slope @ slope.transpose(0, 2, 1)
        size = np.maximum(np.trace(power, axis1=1, axis2=2), 1e-6)[:, None, None]
        self.across, self.share = slope / size, power / size


class DriftCheck:
    """Compares a picture now and then (once a second) with the reference. Not thread-safe."""

    def __init__(
        self, reference: DriftReference | None, camera: GroundCamera, framing: Framing
    ) -> None:
        """`reference` None: the first 2 s of pictures are it. GeometryError when the reference is
        of another lens or sensor."""
        self.since_start = reference is None
        self._camera, self._framing = camera, framing
        self._first: list[tuple[float, ImageArray]] = []
        self._size = levels_of(camera, framing)[0]
        self._last, self._next_try = Pose.unmoved(), 0
        self._recent: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=_MEDIAN_OF)
        self._values: tuple[float, ...] = (math.nan,) * 7
        self._seen_s, self._lost_since_s = -math.inf, math.inf
        self._fit: PatchFit | None = None
        if reference is not None:
            same = (reference.camera.lens, reference.framing) == (camera.lens, framing)
            if not same or (reference.camera.cx, reference.camera.cy) != (camera.cx, camera.cy):
                raise GeometryError(
                    "camera.reference: was saved with another lens or frame size than the "
                    "configuration has; align the camera again"
                )
            self._use(reference)

    def _use(self, reference: DriftReference) -> None:
        self._fit, self._sharpness = PatchFit(reference), reference.sharpness

    def update(self, picture: ImageArray, time_s: float) -> Drift | None:
        """The drift by this picture ([h, w] grey or [h, w, 3] RGB, a scaled copy of the sensor's
        picture) at `time_s`, which only grows. None while the first pictures are collected."""
        grey = reduced(picture, self._size)
        if self._fit is None:
            self._begin(grey, time_s)
            return None
        found, sharpness = self._measure(grey)
        judged = found.counts
        if judged:
            self._last = found.pose
            self._recent.append((time_s, self._numbers(self._fit, found.pose)))
            fresh = [values for at, values in self._recent if time_s - at <= _MEDIAN_S]
            if len(fresh) >= _MEDIAN_MIN:
                self._values = tuple(np.median(np.array(fresh), axis=0).tolist())
        lost = self._is_lost(found.match, sharpness, time_s)
        inliers, match = int(found.inlier.sum()), found.match
        return Drift(*self._values, inliers, match, judged, lost, self.since_start)

    def _begin(self, grey: ImageArray, time_s: float) -> None:
        """Collects the first pictures; the reference is made of those of the last 2 s."""
        self._first.append((time_s, grey))
        if time_s - self._first[0][0] < _START_S:
            return
        try:
            self._use(make_reference([one for _, one in self._first], self._camera, self._framing))
            self._first.clear()
        except GeometryError:  # too dark, or too much traffic
            self._first = [one for one in self._first if time_s - one[0] < _START_S]

    def _measure(self, grey: ImageArray) -> tuple[Fit, float]:
        """The best fit to this picture, and the picture's sharpness."""
        assert self._fit is not None
        finest, sharpness = edge_strength(grey)
        found = self._fit.fit([finest], self._last, 0, 3)
        if found.counts and found.match >= _LOST_FROM:
            return found, sharpness
        pictures, coarsest = [finest], len(self._fit.sizes) - 1
        for _ in range(coarsest):
            grey = np.asarray(cv2.pyrDown(grey), np.uint8)
            pictures.append(edge_strength(grey)[0])
        tries = [found, self._fit.fit(pictures, Pose.unmoved(), coarsest, 5)]
        if not max(tries, key=lambda fit: fit.match).counts:
            turns = _GRID[self._next_try : self._next_try + _TRIED]
            self._next_try = (self._next_try + _TRIED) % len(_GRID)
            poses = [Pose(_rotation(np.array(turn)), np.zeros(3)) for turn in turns]
            match = self._fit.coarse_match(pictures[-1], poses)
            for index in np.argsort(-match)[:2]:
                tries.append(self._fit.fit(pictures, poses[int(index)], coarsest, 5))
        return max(tries, key=lambda fit: (fit.counts, fit.match)), sharpness

    def _numbers(self, fit: PatchFit, pose: Pose) -> tuple[float, ...]:
        """The first seven values of `Drift`."""
        before = _angles(self._camera, np.eye(3))
        pitch, heading, roll = np.degrees(_angles(self._camera, pose.turn) - before).tolist()
        turn = math.degrees(float(np.linalg.norm(cv2.Rodrigues(pose.turn)[0])))
        shift = float(np.linalg.norm(pose.shift_m))
        off = misplaced_m(self._camera, pose)
        return fit.moved_px(pose), turn, pitch, heading, roll, shift, off

    def _is_lost(self, match: float, sharpness: float, time_s: float) -> bool:
        if match >= _LOST_FROM:
            self._seen_s, self._sharpness = time_s, sharpness
        if match >= _LOST_AT or sharpness < _LOST_SHARP * self._sharpness:
            self._lost_since_s = math.inf
        elif math.isinf(self._lost_since_s) and time_s - self._seen_s <= _LOST_GAP_S:
            self._lost_since_s = time_s
        return time_s - self._lost_since_s >= _LOST_S


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


def _rotation(vector: FloatArray) -> FloatArray:
    """The rotation matrix of a rotation vector [3] in radians."""
    return np.asarray(cv2.Rodrigues(vector.reshape(3, 1))[0], np.float64)


def _angles(camera: GroundCamera, turn: FloatArray) -> FloatArray:
    """Pitch, heading and roll in radians [3] of the camera after a turn in ground axes."""
    forward, beside = camera.rays([[camera.cx, camera.cy], [camera.cx + 1, camera.cy]]) @ turn.T
    right = beside - forward * (beside @ forward)
    right /= np.linalg.norm(right)
    pitch = math.asin(max(-1.0, min(1.0, forward[2])))
    roll = math.asin(max(-1.0, min(1.0, right[2] / max(math.cos(pitch), 1e-6))))
    return np.array([pitch, math.atan2(forward[1], forward[0]), roll])
