"""Boards in pictures: detectors in order of cost, each board checked and refined, or refused.

`find_boards` is the way in. A picture stops at the first detector whose board holds; where none
finds a whole board, a part of one is looked for (`partial.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bikeped.cores import cores
from bikeped.errors import CalibrationError
from bikeped.lab.calibration.board_view import BoardPattern, BoardView, Found, Refused
from bikeped.lab.calibration.capture.pictures import (
    Picture,
    check_sizes,
    load_pictures,
    pictures_hash,
)
from bikeped.lab.calibration.corners.board_check import Checked, check_board
from bikeped.lab.calibration.corners.detect_raw import quick_candidates, raw_candidates
from bikeped.lab.calibration.corners.detect_remapped import remapped_candidates
from bikeped.lab.calibration.corners.partial_board import partial_board
from bikeped.types import FloatArray, ImageArray

_SAME_PX = 0.5  # corners this close in two pictures: one and the same
_SAME_MOVING = 0.004  # in a video, of the picture's width: the board has not moved since
_BLURRED_PX = 2.0  # edges wider than this (standard deviation) ...
_BLURRED_TIMES = 2.5  # ... and than the set's median this many times, ...
_BLURRED_SQUARE = 0.2  # ... or wider than this share of a square


@dataclass(frozen=True)
class _Seen:
    board: Checked | None
    why: str


def find_boards(
    pictures: Sequence[Picture | Path | str],
    pattern: BoardPattern,
    *,
    progress: Callable[[int], None] | None = None,
    workers: int | None = None,
) -> Found:
    """The boards of all pictures, refined, and every picture that is not used with the reason.

    `progress` is called with 1 after each picture; `workers` threads (default: one per processor).
    Views come in the order of the pictures. Raises CalibrationError for pictures that cannot be
    read or have several sizes, and for a pattern that is no board.
    """
    check_pattern(pattern)
    loaded = [one for one in pictures if isinstance(one, Picture)]
    if len(loaded) != len(pictures):
        loaded = load_pictures([one.name if isinstance(one, Picture) else one for one in pictures])
    if not loaded:
        raise CalibrationError("no picture to calibrate from; name files, a folder or a video")
    check_sizes(loaded)
    twins = _twins(loaded)

    def look(number: int) -> _Seen:
        if number in twins:
            seen = _Seen(None, f"same picture as {loaded[twins[number]].name}")
        else:
            seen = find_board(loaded[number].grey(), pattern)
        if progress is not None:
            progress(1)
        return seen

    count = max(1, min(workers or cores(), len(loaded)))
    with ThreadPoolExecutor(count) as pool:
        seen = list(pool.map(look, range(len(loaded))))
    return _sorted_out(loaded, pattern, seen)


def check_pattern(pattern: BoardPattern) -> None:
    """CalibrationError for a pattern that no detector can find."""
    if min(pattern.columns, pattern.rows) < 3:
        raise CalibrationError(
            f"--pattern {pattern.columns}x{pattern.rows}: a board needs at least 3x3 inner corners "
            "(a corner is where four squares meet)"
        )


def find_board(grey: ImageArray, pattern: BoardPattern, *, thorough: bool = True) -> _Seen:
    """One picture's board. Not `thorough`: only the quickest detector, for live frames, and only
    whole boards."""
    why = ""
    for candidate in _candidates(grey, pattern, thorough):
        checked = check_board(grey, pattern, candidate)
        if isinstance(checked, Checked):
            return _Seen(checked, "")
        why = why or checked
    if thorough:
        part = partial_board(grey, pattern)
        if isinstance(part, Checked):
            return _Seen(part, "")
        why = part or why
    wanted = f"{pattern.columns}x{pattern.rows}"
    return _Seen(None, f"no whole {wanted} board found" + (f": {why}" if why else ""))


def _candidates(grey: ImageArray, pattern: BoardPattern, thorough: bool) -> Iterator[FloatArray]:
    if not thorough:
        yield from quick_candidates(grey, pattern)
        return
    yield from raw_candidates(grey, pattern)
    yield from remapped_candidates(grey, pattern)


def _twins(pictures: Sequence[Picture]) -> dict[int, int]:
    """Pictures with the bytes of an earlier one, and which that is."""
    first: dict[str, int] = {}
    twins = {}
    for number, picture in enumerate(pictures):
        if picture.digest in first:
            twins[number] = first[picture.digest]
        else:
            first[picture.digest] = number
    return twins


def _sorted_out(pictures: Sequence[Picture], pattern: BoardPattern, seen: Sequence[_Seen]) -> Found:
    """Leaves out blurred boards, those that were seen before, and what may be another board."""
    blurs = [one.board.blur_px for one in seen if one.board is not None]
    usual = float(np.median(blurs)) if blurs else 0.0
    boards = [one.board for one in seen if one.board is not None]
    sure = any(_all_in_sight(board, pattern) for board in boards)
    views: list[BoardView] = []
    kept: list[Picture] = []
    refused: list[Refused] = []
    for picture, one in zip(pictures, seen, strict=True):
        why = one.why
        if one.board is not None:
            why = _blurred(one.board, usual) or _before(picture, one.board, kept, views)
            if not sure:
                why = why or _doubtful(pattern)
        if one.board is None or why:
            refused.append(Refused(picture.name, why))
            continue
        kept.append(picture)
        views.append(
            BoardView(picture.name, one.board.ids, one.board.uv_px, picture.width, picture.height)
        )
    return Found(pattern, views, refused, len(pictures), pictures_hash(pictures))


def _all_in_sight(board: Checked, pattern: BoardPattern) -> bool:
    """Whether all four outer lines of the pattern show at least one corner."""
    column, row = board.ids % pattern.columns, board.ids // pattern.columns
    wide = column.min() == 0 and column.max() == pattern.columns - 1
    return bool(wide and row.min() == 0 and row.max() == pattern.rows - 1)


def _doubtful(pattern: BoardPattern) -> str:
    """Words for boards that lack an outer line, in a set that does not show one with all four.

    A board of 7x6 corners whose far edge is out of sight looks like one of 8x6 that lacks a column.
    """
    size = f"{pattern.columns}x{pattern.rows}"
    return (
        f"a row or column of {size} corners is out of sight, and no other picture shows all of "
        "them; take one that does, or correct --pattern"
    )


def _blurred(board: Checked, usual_px: float) -> str:
    wide = board.blur_px > max(_BLURRED_PX, _BLURRED_TIMES * usual_px)
    if not wide and board.blur_px < max(_BLURRED_SQUARE * board.spacing_px, 1.0):
        return ""
    return (
        f"blurred: its edges are {2 * board.blur_px:.1f} px wide (usual here: {2 * usual_px:.1f}); "
        "take it again with the board held still"
    )


def _before(
    picture: Picture, board: Checked, kept: Sequence[Picture], views: Sequence[BoardView]
) -> str:
    for other, view in zip(kept, views, strict=True):
        _, mine, theirs = np.intersect1d(board.ids, view.ids, return_indices=True)
        if len(mine) < 0.8 * min(len(board.ids), len(view.ids)):
            continue
        moved = np.linalg.norm(board.uv_px[mine] - view.uv_px[theirs], axis=1)
        far = float(np.sqrt(np.mean(moved**2)))
        if far < _SAME_PX:
            return f"same picture as {other.name}"
        if picture.moving and other.moving and far < _SAME_MOVING * picture.width:
            return f"the board has not moved since {other.name}"
    return ""


def suggest_pattern(grey: ImageArray) -> tuple[int, int] | None:
    """Columns and rows of any board in a picture, for a person who gave the wrong ones."""
    scale = min(1.0, 800 / max(grey.shape))
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE
    try:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    except cv2.error:
        return None
    if not found or meta is None or np.asarray(meta).ndim < 2:
        return None
    rows, columns = np.asarray(meta).shape[:2]
    return max(rows, columns), min(rows, columns)
