"""The way of every calibration image: detection, selection within the set, the square crop.

`detect_boards` passes each image through and answers with its board or with a `RefusedImage`.
What remains is the solver's: `prepare_observations` refuses images that contradict the others.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from bikeped.cores import cores
from bikeped.errors import CalibrationError
from bikeped.geometry.framing import Framing
from bikeped.lab.calibration.board_view import (
    BoardPattern,
    BoardRefusedError,
    BoardView,
    DetectedBoards,
    RefusedImage,
)
from bikeped.lab.calibration.capture.images import CalibrationImage, check_image_sizes, images_hash
from bikeped.lab.calibration.corners.board_check import DetectedBoard, rms_shift_px
from bikeped.lab.calibration.corners.board_detector import check_pattern, detect_board
from bikeped.lab.calibration.solver.observations import FEWEST_CORNERS

_SAME_PX = 0.5  # corners this close in two images: one and the same
_SAME_MOVING = 0.004  # in a video, of the image's width: the board has not moved since
_BLURRED_PX = 2.0  # edges wider than this (standard deviation) ...
_BLURRED_TIMES = 2.5  # ... and than the set's median this many times, ...
_BLURRED_SQUARE = 0.2  # ... or wider than this share of a square


def detect_boards(
    images: Sequence[CalibrationImage],
    pattern: BoardPattern,
    framing: Framing | None = None,
    *,
    progress: Callable[[int], None] | None = None,
    workers: int | None = None,
) -> DetectedBoards:
    """The boards of all images, refined, and every image that is not used with the reason.

    `framing`: corners of sensor frames are given in its square crop; images of another size and
    None: as they are. `progress` gets the number of images done; `workers` threads (default: one a
    core). Views come in the order of the images. Raises CalibrationError for images of several
    sizes and for a pattern that is no board.
    """
    check_pattern(pattern)
    if not images:
        raise CalibrationError("no picture to calibrate from; name files, a folder or a video")
    check_image_sizes(images)
    first_with = {image.digest: image for image in reversed(images)}
    done = itertools.count(1)

    def detect(image: CalibrationImage) -> DetectedBoard | RefusedImage:
        try:
            first = first_with[image.digest]
            if first is not image:
                raise BoardRefusedError(f"same picture as {first.name}")
            return detect_board(image.grey(), pattern)
        except BoardRefusedError as refused:
            return RefusedImage(image.name, str(refused))
        finally:
            if progress is not None:
                progress(next(done))

    with ThreadPoolExecutor(max(1, min(workers or cores(), len(images)))) as pool:
        detected = list(pool.map(detect, images))
    boards = [board for board in detected if isinstance(board, DetectedBoard)]
    blurs = [board.blur_px for board in boards]
    usual_px = float(np.median(blurs)) if blurs else 0.0
    whole_seen = any(_shows_outer_lines(board, pattern) for board in boards)
    kept: list[tuple[CalibrationImage, DetectedBoard]] = []
    views: list[BoardView] = []
    refused: list[RefusedImage] = []
    for image, board in zip(images, detected, strict=True):
        if isinstance(board, RefusedImage):
            refused.append(board)
            continue
        try:
            wide = board.blur_px > max(_BLURRED_PX, _BLURRED_TIMES * usual_px)
            if wide or board.blur_px >= max(_BLURRED_SQUARE * board.spacing_px, 1.0):
                raise BoardRefusedError(
                    f"blurred: its edges are {2 * board.blur_px:.1f} px wide (usual here: "
                    f"{2 * usual_px:.1f}); take it again with the board held still"
                )
            for other, known in kept:
                shift_px = rms_shift_px(board, known, 0.8 * min(len(board.ids), len(known.ids)))
                if shift_px < _SAME_PX:
                    raise BoardRefusedError(f"same picture as {other.name}")
                moving = image.moving and other.moving
                if moving and shift_px < _SAME_MOVING * image.width:
                    raise BoardRefusedError(f"the board has not moved since {other.name}")
            if not whole_seen:
                # 7x6 corners whose far edge is out of sight look like 8x6 that lack a column.
                raise BoardRefusedError(
                    f"a row or column of {pattern} corners is out of sight, and no other picture "
                    "shows all of them; take one that does, or correct --pattern"
                )
            kept.append((image, board))
            view = BoardView(image.name, board.ids, board.uv_px, image.width, image.height)
            views.append(view if framing is None else crop_view(view, framing))
        except BoardRefusedError as error:
            refused.append(RefusedImage(image.name, str(error)))
    return DetectedBoards(pattern, views, refused, len(images), images_hash(images))


def _shows_outer_lines(board: DetectedBoard, pattern: BoardPattern) -> bool:
    """Whether all four outer lines of the pattern show at least one corner."""
    column, row = board.ids % pattern.columns, board.ids // pattern.columns
    wide = column.min() == 0 and column.max() == pattern.columns - 1
    return bool(wide and row.min() == 0 and row.max() == pattern.rows - 1)


def crop_view(view: BoardView, framing: Framing) -> BoardView:
    """The view of a sensor frame in pixels of the square crop, which the calibration file uses.

    Images of another size than the sensor stay as they are. BoardRefusedError where too few
    corners lie in the crop.
    """
    if (view.width, view.height) != (framing.sensor_w, framing.sensor_h):
        return view
    uv = framing.frame_to_crop(view.uv_px)
    width, height = framing.crop_wh
    inside = (uv >= 0).all(1) & (uv <= [width - 1, height - 1]).all(1)
    if inside.sum() < FEWEST_CORNERS:
        raise BoardRefusedError("lies outside the square crop")
    return BoardView(view.name, view.ids[inside], uv[inside], width, height)
