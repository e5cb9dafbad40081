"""From detected boards to a set that can be fitted, with a first guess; else CalibrationError.

The guess needs no lens. For every projection and a range of focal lengths the corners become rays;
a flat board's corners and their rays obey b x (H P) = 0 with H = [r1 r2 t], linear in H, and true
for rays beside and behind the lens plane as well (a homography between planes would not be). The
guess whose boards project nearest to the observed corners wins.

Outlier corners are found once, with the most flexible lens, so that every model is judged on the
same corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bikeped.errors import CalibrationError
from bikeped.geometry.lens import PROJECTIONS, Projection
from bikeped.lab.calibration.board_view import DetectedBoards, RefusedImage
from bikeped.lab.calibration.solver.board_shape import align_numbering
from bikeped.lab.calibration.solver.bundle_adjustment import adjust
from bikeped.lab.calibration.solver.lens_model import (
    CalibrationState,
    CornerObservations,
    LensModel,
    angles,
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
FEWEST_BOARDS = 3
#: Boards are alike when none moves by more than this share of its own size.
_ALIKE_SHARE = 0.1
#: Corners that are off by more of a square than this make no board.
_MOST_NOISE_SHARE = 0.1
#: A fisheye lens sees at least this far from its axis, in the corner of its image ...
_FISHEYE_FROM_DEG = 50.0
#: ... and one that shows a corner as far out as this cannot be an ordinary lens.
_ORDINARY_TO_DEG = 70.0
#: How much better a perspective lens must explain the corners than every fisheye one.
_CLEARLY = 0.8
#: A corner is an outlier beyond this many standard deviations, and beyond GROSS_PX. Plain noise of
#: two coordinates reaches seven once in 10^10.
GROSS_SIGMAS, GROSS_PX = 7.0, 1.0
#: Nor is a corner an outlier within this share of its image's squares: so far boards bend.
_BENDS_SHARE = 0.04
#: An image with fewer inliers, or a smaller share of them, is not used.
FEWEST_CORNERS, LEAST_SHARE = 8, 0.5


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
            if np.radians(angle) > PROJECTIONS[projection].limit_rad * 0.98:
                continue
            focal = farthest / float(PROJECTIONS[projection].radius(np.asarray(np.radians(angle))))
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


@dataclass(frozen=True)
class OutlierCorner:
    """One corner that is not used: its image, its id, and the size of its residual."""

    file: str
    corner: int
    off_px: float


@dataclass(frozen=True)
class PreparedObservations:
    """Boards of one size, numbered alike, without outliers, and a good start for the solver."""

    observations: CornerObservations
    start: CalibrationState
    outliers: tuple[OutlierCorner, ...]
    refused: tuple[RefusedImage, ...]
    images: int  #: of the set, refused ones included
    images_hash: str


@single_threaded
def prepare_observations(boards: DetectedBoards) -> PreparedObservations:
    """Checks the boards, guesses the lens, removes outliers, numbers all boards alike.

    CalibrationError, with the remedy, where the boards cannot give a lens.
    """
    _check_count(boards)
    observations = CornerObservations.of(boards.pattern, boards.views)
    _check_variety(observations)
    state = first_guess(observations)
    refused = list(boards.refused)
    flexible = LensModel("equidistant", 4)
    outliers: list[OutlierCorner] = []
    for _ in range(3):
        fitted = adjust(observations, flexible, state)
        state = fitted.state
        off_px = np.hypot(fitted.residuals_px[..., 0], fitted.residuals_px[..., 1])
        bends = _BENDS_SHARE * observations.square_px[:, None]
        far = np.maximum(bends, max(GROSS_SIGMAS * fitted.sigma_px, GROSS_PX))
        wrong = observations.visible & (off_px > far)
        if not wrong.any():
            break
        good = (observations.visible & ~wrong).sum(1)
        useless = (good < FEWEST_CORNERS) | (good < LEAST_SHARE * observations.visible.sum(1))
        median_px = median_errors_px(state, observations)
        names = observations.names
        refused += [
            RefusedImage(
                names[row],
                f"its corners do not fit the other boards (median {median_px[row]:.1f} px off)",
            )
            for row in np.flatnonzero(useless)
        ]
        outliers += [
            OutlierCorner(names[row], int(corner), float(off_px[row, corner]))
            for row, corner in np.argwhere(wrong & ~useless[:, None])
        ]
        observations = observations.without(wrong).rows(~useless)
        state = state.rows(~useless)
        if len(observations) < FEWEST_BOARDS:
            raise CalibrationError(
                f"IMAGES: the corners of {int(useless.sum())} boards contradict one another, and "
                f"{len(observations)} are left; check --pattern, and that the board is stiff"
            )
    square_px = float(np.median(observations.square_px))
    if fitted.sigma_px > _MOST_NOISE_SHARE * square_px:
        raise CalibrationError(
            f"IMAGES: the corners make no {observations.pattern} boards: off by "
            f"{fitted.sigma_px:.1f} px where a square has {square_px:.0f}; check --pattern"
        )
    numbering, state = align_numbering(state, observations, fitted.sigma_px)
    observations = observations.renumbered(numbering)
    _check_fisheye(observations, state)
    return PreparedObservations(
        observations, state, tuple(outliers), tuple(refused), boards.images, boards.images_hash
    )


def _check_count(boards: DetectedBoards) -> None:
    pictures = "1 picture" if boards.images == 1 else f"{boards.images} pictures"
    if not boards.views:
        first = boards.refused[:1]
        reason = f" ({Path(first[0].file).name}: {first[0].reason})" if first else ""
        raise CalibrationError(
            f"IMAGES: no board of {boards.pattern} inner corners in {pictures}{reason}; count "
            "the corners where four squares meet and give them as --pattern COLUMNSxROWS"
        )
    if len(boards.views) < FEWEST_BOARDS:
        count = "one board" if len(boards.views) == 1 else f"{len(boards.views)} boards"
        raise CalibrationError(
            f"IMAGES: {count} of {boards.pattern} inner corners in {pictures}, and a lens needs at "
            f"least {FEWEST_BOARDS}, better 15, all over the picture; photograph more, or correct "
            "--pattern"
        )


def _check_variety(observations: CornerObservations) -> None:
    """CalibrationError where all boards stand alike: they give the same equations again."""
    both = observations.visible & observations.visible[:1]
    shift = np.linalg.norm(observations.uv_px - observations.uv_px[:1], axis=-1)
    mean = (shift * both).sum(1) / np.maximum(both.sum(1), 1)
    corners = observations.uv_px[0][observations.visible[0]]
    size = float(np.linalg.norm(corners.max(0) - corners.min(0)))
    if (both.sum(1) > 0).all() and mean.max() < _ALIKE_SHARE * size:
        raise CalibrationError(
            f"IMAGES: all {len(observations)} boards stand alike (none moves by more than "
            f"{mean.max():.0f} px); move and tilt the board between pictures, out to the rim"
        )


def _check_fisheye(observations: CornerObservations, state: CalibrationState) -> None:
    """CalibrationError where an ordinary lens explains the corners and reaches as far out."""
    farthest = angles(camera_points(state, observations.flat))[observations.visible].max()
    if farthest > np.radians(_ORDINARY_TO_DEG):
        return
    plain = [adjust(observations, LensModel(name), state, robust=False) for name in FISHEYE]
    best = min(plain, key=lambda fitted: float((fitted.residuals_px**2).sum()))
    centre = best.state.lens[:2]
    size = np.array([observations.width - 1, observations.height - 1])
    rim = np.hypot(*np.maximum(centre, size - centre)) / best.state.lens[2]
    theta = float(np.degrees(PROJECTIONS[best.state.projection].theta(np.asarray(rim))))
    start = first_guess(observations, ("perspective",))
    ordinary = adjust(observations, LensModel("perspective"), start, robust=False)
    fisheye, perspective = (
        float(np.sqrt((fitted.residuals_px**2).sum())) for fitted in (best, ordinary)
    )
    share = perspective / fisheye if fisheye > 0 else np.inf
    if share < _CLEARLY:
        reason = f"a perspective one leaves {share:.2f} times the error of the best fisheye"
    elif theta < _FISHEYE_FROM_DEG:
        reason = f"its picture ends {theta:.0f} degrees from the axis, in the corner"
    else:
        return
    raise CalibrationError(
        f"IMAGES: the lens is not a fisheye: {reason}; for an ordinary lens set camera.projection: "
        "perspective, with camera.radius_px and camera.fov_deg"
    )
