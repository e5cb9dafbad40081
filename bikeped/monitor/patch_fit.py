"""Fits the pose of a camera to a picture by the patches of a reference.

Inverse compositional Gauss-Newton on normalised patches (Baker and Matthews, Lucas-Kanade 20 years
on, 2004): the picture is read where a pose puts the patches, and one linear step of turn and shift
brings it nearer to them. Each patch is weighted by how well it matches: people, vehicles, shadows
and fresh snow match nothing and drop out. A patch on a straight edge counts across it only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from bikeped.monitor.drift_reference import (
    COMPARED,
    FAR_M,
    PATCH_PX,
    DriftReference,
    levels_of,
    normalised,
    sampled,
)
from bikeped.types import BoolArray, Float32Array, FloatArray

#: What makes a fit count: share of the patches in view, their number, standard error of the turn.
_MIN_MATCH, _MIN_INLIERS, _MAX_SIGMA_DEG = 0.2, 12, 0.15
_MATCHES, _OFF_PX = 0.6, 1.0  #: correlation and distance of a patch that matches
_SIGMA_PX, _SHIFT_SIGMA_M = 0.4, 0.08  #: of a patch's place; of the shift before it is measured


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
        ray = self._camera.rays(reference.framing.frame_to_crop(reference.uv_px))
        near = np.isfinite(reference.ground_m).all(axis=1)
        reach = np.where(near, self._camera.height_m / -np.where(near, ray[:, 2], -1), FAR_M)
        self._xyz_m = ray * reach[:, None]
        step = 2.0
        beside = [(step, 0), (0, step), (-step, 0), (0, -step)]
        rays = self._camera.rays(self._view.frame_to_crop(self._uv + np.array(beside)[:, None]))
        self._around_m = np.where(np.isfinite(rays), rays, ray) * reach[:, None]
        self._around_px = 2 * step
        home, tiny = self.project(self._xyz_m, Pose.unmoved()), 1e-4
        moves = [Pose(rotation(tiny * axis), np.zeros(3)) for axis in np.eye(3)]
        moves += [Pose(np.eye(3), tiny * axis) for axis in np.eye(3)]
        self._slope = np.stack([(self.project(self._xyz_m, m) - home) / tiny for m in moves], -1)
        self._levels = [_Level(reference.patches[:, i]) for i in range(len(self.sizes))]

    def project(self, xyz_m: FloatArray, pose: Pose) -> FloatArray:
        """Pixels [..., 2] of the finest picture of points [..., 3] from the lens, ground axes."""
        moved = (xyz_m - pose.shift_m) @ pose.turn
        uv, _ = self._camera.project(moved + np.array([0.0, 0.0, self._camera.height_m]))
        return self._view.crop_to_frame(uv)

    def fit(self, pictures: list[Float32Array], start: Pose, steps: int) -> Fit:
        """The pose that is found from `start` in `steps` steps a picture: `pictures` of edge
        strength are the finest one or more of the pyramid, finest first."""
        pose, information = start, np.eye(6)
        shift_weight = np.diag([1e-3] * 3 + [_SHIFT_SIGMA_M**-2] * 3)
        for number in reversed(range(len(pictures))):
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
                back = rotation(move[:3]).T
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


def rotation(vector: FloatArray) -> FloatArray:
    """The rotation matrix of a rotation vector [3] in radians."""
    return np.asarray(cv2.Rodrigues(vector.reshape(3, 1))[0], np.float64)
