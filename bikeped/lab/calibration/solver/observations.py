"""From found boards to a set that can be fitted, or a clear word on why it cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bikeped.errors import CalibrationError
from bikeped.geometry import Framing
from bikeped.geometry.lens import unit_angle
from bikeped.lab.calibration.board_view import BoardView, Found, Refused
from bikeped.lab.calibration.solver.board_shape import alignment
from bikeped.lab.calibration.solver.bundle_adjustment import Adjusted, adjust
from bikeped.lab.calibration.solver.initial_guess import FISHEYE, first_guess, picture_errors_px
from bikeped.lab.calibration.solver.lens_model import Model, Sightings, State, angles, camera_points
from bikeped.lab.calibration.solver.outliers import (
    FEWEST_CORNERS,
    LeftOut,
    named,
    useless_pictures,
    wrong_corners,
)
from bikeped.lab.calibration.solver.single_thread import one_thread

FEWEST_BOARDS = 3
#: Boards are alike when none moves by more than this share of its own size.
_ALIKE_SHARE = 0.1
#: Corners that are off by more of a square than this make no board.
_MOST_NOISE_SHARE = 0.1
#: A fisheye lens sees at least this far from its axis, in the corner of its picture ...
_FISHEYE_FROM_DEG = 50.0
#: ... and one that shows a corner as far out as this cannot be an ordinary lens.
_ORDINARY_TO_DEG = 70.0
#: How much better a perspective lens must explain the corners than every fisheye one.
_CLEARLY = 0.8


@dataclass(frozen=True)
class Prepared:
    """Boards of one size, counted one way, without wrong corners, and a good start."""

    sightings: Sightings
    start: State
    left_out: tuple[LeftOut, ...]
    refused: tuple[Refused, ...]
    boards_total: int  #: pictures looked at
    pictures_hash: str


def cropped(found: Found, framing: Framing) -> Found:
    """Sensor frames in pixels of the square crop: what `camera_calibration.json` speaks of.

    Pictures of another size than the sensor stay as they are.
    """
    if not found.views:
        return found
    first = found.views[0]
    if (first.width, first.height) != (framing.sensor_w, framing.sensor_h):
        return found
    width, height = framing.crop_wh
    views: list[BoardView] = []
    refused = list(found.refused)
    for view in found.views:
        uv = framing.frame_to_crop(view.uv_px)
        inside = (uv >= 0).all(1) & (uv[:, 0] <= width - 1) & (uv[:, 1] <= height - 1)
        if inside.sum() < FEWEST_CORNERS:
            refused.append(Refused(view.name, "lies outside the square crop"))
            continue
        views.append(BoardView(view.name, view.ids[inside], uv[inside], width, height))
    return replace(found, views=views, refused=refused)


@one_thread
def prepare(found: Found) -> Prepared:
    """Checks the boards, guesses the lens, finds wrong corners, counts all boards one way.

    CalibrationError, with the mend, where the boards cannot give a lens.
    """
    _enough(found.views, found)
    sightings = Sightings.of(found.pattern, found.views)
    _differ(sightings)
    state = first_guess(sightings)
    refused = list(found.refused)
    flexible = Model("equidistant", 4)
    left_out: list[LeftOut] = []
    for _ in range(3):
        fitted = adjust(sightings, flexible, state)
        state = fitted.state
        wrong = wrong_corners(fitted, sightings)
        if not wrong.any():
            break
        useless = useless_pictures(sightings, wrong)
        for row in np.flatnonzero(useless):
            error = float(picture_errors_px(state, sightings)[row])
            refused.append(
                Refused(
                    sightings.names[row],
                    f"its corners do not fit the other boards (median {error:.1f} px off)",
                )
            )
        left_out += named(fitted, sightings, wrong & ~useless[:, None])
        sightings = sightings.without(wrong).rows(~useless)
        state = state.rows(~useless)
        if len(sightings) < FEWEST_BOARDS:
            raise CalibrationError(
                f"IMAGES: the corners of {int(useless.sum())} boards contradict one another, and "
                f"{len(sightings)} are left; check --pattern, and that the board is stiff"
            )
    _make_boards(fitted, sightings)
    numbering, state = alignment(state, sightings, fitted.sigma_px)
    sightings = sightings.renumbered(numbering)
    _is_fisheye(sightings, state)
    return Prepared(
        sightings, state, tuple(left_out), tuple(refused), found.pictures, found.pictures_hash
    )


def _enough(views: Sequence[BoardView], found: Found) -> None:
    size = f"{found.pattern.columns}x{found.pattern.rows}"
    pictures = "1 picture" if found.pictures == 1 else f"{found.pictures} pictures"
    if not views:
        first = found.refused[:1]
        why = f" ({Path(first[0].name).name}: {first[0].why})" if first else ""
        raise CalibrationError(
            f"IMAGES: no board of {size} inner corners in {pictures}{why}; count "
            "the corners where four squares meet and give them as --pattern COLUMNSxROWS"
        )
    if len(views) < FEWEST_BOARDS:
        what = "one board" if len(views) == 1 else f"{len(views)} boards"
        raise CalibrationError(
            f"IMAGES: {what} of {size} inner corners in {pictures}, and a lens "
            f"needs at least {FEWEST_BOARDS}, better 15, all over the picture; photograph more, or "
            "correct --pattern"
        )


def _make_boards(fitted: Adjusted, sightings: Sightings) -> None:
    """Corners that lie nowhere near a board, even after the best fit."""
    square = float(np.median(sightings.square_px))
    if fitted.sigma_px > _MOST_NOISE_SHARE * square:
        raise CalibrationError(
            f"IMAGES: the corners make no {sightings.pattern.columns}x{sightings.pattern.rows} "
            f"boards: off by {fitted.sigma_px:.1f} px where a square has {square:.0f}; check "
            "--pattern"
        )


def _differ(sightings: Sightings) -> None:
    """Boards that all stand alike say the same thing again and again."""
    both = sightings.seen & sightings.seen[:1]
    shift = np.linalg.norm(sightings.uv_px - sightings.uv_px[:1], axis=-1)
    mean = (shift * both).sum(1) / np.maximum(both.sum(1), 1)
    corners = sightings.uv_px[0][sightings.seen[0]]
    size = float(np.linalg.norm(corners.max(0) - corners.min(0)))
    if (both.sum(1) > 0).all() and mean.max() < _ALIKE_SHARE * size:
        raise CalibrationError(
            f"IMAGES: all {len(sightings)} boards stand alike (none moves by more than "
            f"{mean.max():.0f} px); move and tilt the board between pictures, out to the rim"
        )


def _is_fisheye(sightings: Sightings, state: State) -> None:
    """CalibrationError when an ordinary lens explains the corners, and sees no farther than one."""
    farthest = angles(camera_points(state, sightings.flat))[sightings.seen].max()
    if farthest > np.radians(_ORDINARY_TO_DEG):
        return
    plain = [adjust(sightings, Model(name), state, robust=False) for name in FISHEYE]
    best = min(plain, key=lambda fitted: float((fitted.residuals_px**2).sum()))
    fisheye = float(np.sqrt((best.residuals_px**2).sum()))
    centre = best.state.lens[:2]
    size = np.array([sightings.width - 1, sightings.height - 1])
    rim = np.hypot(*np.maximum(centre, size - centre)) / best.state.lens[2]
    theta = float(np.degrees(unit_angle(best.state.projection, np.asarray(rim))))
    ordinary = adjust(
        sightings, Model("perspective"), first_guess(sightings, ("perspective",)), robust=False
    )
    perspective = float(np.sqrt((ordinary.residuals_px**2).sum()))
    share = perspective / fisheye if fisheye > 0 else np.inf
    if share < _CLEARLY:
        why = (
            f"an ordinary (perspective) one leaves {share:.2f} times the error of the best fisheye"
        )
    elif theta < _FISHEYE_FROM_DEG:
        why = f"its picture ends {theta:.0f} degrees from the axis, in the corner"
    else:
        return
    raise CalibrationError(
        f"IMAGES: the lens is not a fisheye: {why}; for an ordinary lens set camera.projection: "
        "perspective, with camera.radius_px and camera.fov_deg"
    )
