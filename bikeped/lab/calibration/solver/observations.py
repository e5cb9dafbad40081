"""From detected boards to a set that can be fitted; CalibrationError where it cannot be.

Outlier corners are found once, with the most flexible lens, so that every model is judged on the
same corners.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bikeped.errors import CalibrationError
from bikeped.geometry.lens import unit_angle
from bikeped.lab.calibration.board_view import DetectedBoards, RefusedImage
from bikeped.lab.calibration.solver.board_shape import align_numbering
from bikeped.lab.calibration.solver.bundle_adjustment import AdjustmentResult, adjust
from bikeped.lab.calibration.solver.initial_guess import FISHEYE, first_guess, median_errors_px
from bikeped.lab.calibration.solver.lens_model import (
    CalibrationState,
    CornerObservations,
    LensModel,
    angles,
    camera_points,
)
from bikeped.lab.calibration.solver.normal_equations import single_threaded

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
    _check_noise(fitted, observations)
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


def _check_noise(fitted: AdjustmentResult, observations: CornerObservations) -> None:
    """CalibrationError where the corners are nowhere near a board, even after the best fit."""
    square = float(np.median(observations.square_px))
    if fitted.sigma_px > _MOST_NOISE_SHARE * square:
        raise CalibrationError(
            f"IMAGES: the corners make no {observations.pattern} boards: off by "
            f"{fitted.sigma_px:.1f} px where a square has {square:.0f}; check --pattern"
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
    theta = float(np.degrees(unit_angle(best.state.projection, np.asarray(rim))))
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
