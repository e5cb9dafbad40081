"""A first guess without knowing the lens: focal length by scan, poses from rays.

For every projection and a range of focal lengths the corners become rays; a flat board's corners
and their rays obey b x (H P) = 0 with H = [r1 r2 t], linear in H, and true for rays beside and
behind the lens plane as well (a homography between planes would not be). The guess whose boards
project nearest to the observed corners wins.
"""

from __future__ import annotations

import numpy as np

from bikeped.errors import CalibrationError
from bikeped.geometry.lens import LIMITS, Projection, unit_radius
from bikeped.lab.calibration.solver.lens_model import (
    CalibrationState,
    CornerObservations,
    bearings,
    camera_points,
    project,
)
from bikeped.lab.calibration.solver.normal_equations import single_threaded
from bikeped.types import FloatArray

FISHEYE: tuple[Projection, ...] = ("equidistant", "equisolid", "stereographic", "orthographic")
#: Angles that the farthest corner may lie at, degrees from the axis.
_FARTHEST_DEG: tuple[float, ...] = (20.0, 30.0, 42.0, 55.0, 68.0, 80.0, 90.0, 100.0, 112.0, 125.0)
_SCANNED = 10  # images that the scan uses: the choice needs no more
_REWEIGHTED = 4


@single_threaded
def first_guess(
    observations: CornerObservations, projections: tuple[Projection, ...] = FISHEYE
) -> CalibrationState:
    """Lens (no radial terms) and poses; CalibrationError where no lens explains the boards.

    The first projection is scanned over all angles, the others near the best of these.
    """
    centre = np.array([(observations.width - 1) / 2, (observations.height - 1) / 2])
    offset = np.where(
        observations.visible, np.linalg.norm(observations.uv_px - centre, axis=-1), 0.0
    )
    farthest = float(offset.max())
    # The farthest boards tell projections apart; some near ones stabilise the choice.
    order = np.argsort(offset.max(axis=1))[::-1]
    some = observations.rows(np.sort(order[:: max(1, len(order) // _SCANNED)][:_SCANNED]))
    best: tuple[float, Projection, float] | None = None  # mean error, projection, angle
    chosen = 0.0
    for projection in projections:
        around = _FARTHEST_DEG
        if best is not None:
            at = _FARTHEST_DEG.index(best[2])
            around = _FARTHEST_DEG[max(at - 1, 0) : at + 2]
        for angle in around:
            if np.radians(angle) > LIMITS[projection] * 0.98:
                continue
            focal = farthest / float(unit_radius(projection, np.asarray(np.radians(angle))))
            state = poses_from_rays(projection, np.array([*centre, focal]), some, reweighted=2)
            score = float(np.mean(median_errors_px(state, some)))
            if best is None or score < best[0]:
                best, chosen = (score, projection, angle), focal
    if best is None or not np.isfinite(best[0]):
        raise CalibrationError("no lens makes a board of these corners; check --pattern")
    return poses_from_rays(best[1], np.array([*centre, chosen]), observations)


def median_errors_px(state: CalibrationState, observations: CornerObservations) -> FloatArray:
    """[V] median distance of each image's corners from their projections, pixels."""
    error = project(state, camera_points(state, observations.flat)) - observations.uv_px
    distance = np.hypot(error[..., 0], error[..., 1])
    return np.asarray(np.nanmedian(np.where(observations.visible, distance, np.nan), axis=1))


def poses_from_rays(
    projection: Projection,
    lens: FloatArray,
    observations: CornerObservations,
    reweighted: int = _REWEIGHTED,
) -> CalibrationState:
    """Every board's pose for a lens [cx, cy, f], robust to some wrong corners."""
    flat = observations.flat
    half = float(np.abs(flat).max())
    plane = np.stack([flat[:, 0] / half, flat[:, 1] / half, np.ones(len(flat))], axis=1)
    rays = bearings(projection, float(lens[2]), lens[:2], observations.uv_px)
    outer = np.eye(3) - rays[..., :, None] * rays[..., None, :]  # [V, C, 3, 3]
    moments = plane[:, :, None] * plane[:, None, :]  # [C, 3, 3]
    weight = observations.visible.astype(np.float64)
    for _ in range(reweighted):
        block = (outer.reshape(*outer.shape[:2], 9) * weight[..., None]).transpose(0, 2, 1)
        square = (block @ moments.reshape(-1, 9)).reshape(-1, 3, 3, 3, 3)
        matrix = square.transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)
        mapped = np.linalg.eigh(matrix)[1][:, :, 0].reshape(-1, 3, 3)
        ahead = mapped @ plane.T  # [V, 3, C]
        along = (rays.transpose(0, 2, 1) * ahead).sum(1)
        sign = np.sign((np.sign(along) * observations.visible).sum(1) + 1e-9)
        mapped, ahead, along = (
            x * sign.reshape(-1, *[1] * (x.ndim - 1)) for x in (mapped, ahead, along)
        )
        # The angle between ray and corner; the error in pixels is about f times this.
        sine = np.linalg.norm(np.cross(rays, ahead.transpose(0, 2, 1)), axis=-1)
        off = np.arctan2(sine, along)
        size = np.linalg.norm(ahead, axis=1)
        scale = np.nanmedian(np.where(observations.visible, off, np.nan), axis=1, keepdims=True)
        weight = observations.visible / (np.maximum(off, scale + 1e-6) * size)
        weight = weight / np.maximum(size, 1e-12)
        weight = weight / weight.max(axis=1, keepdims=True)
    first, second, translation = mapped[..., 0] / half, mapped[..., 1] / half, mapped[..., 2]
    length = (np.linalg.norm(first, axis=1) + np.linalg.norm(second, axis=1)) / 2
    axes = np.stack([first, second, np.cross(first, second) / length[:, None]], axis=-1)
    left, _, right = np.linalg.svd(axes)
    rotation = left @ right
    return CalibrationState(
        projection, lens, rotation, translation / length[:, None], np.zeros((len(flat), 3))
    )
