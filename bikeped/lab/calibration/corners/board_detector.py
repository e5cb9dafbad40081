"""The board of one image: detectors in order of cost, each candidate checked and refined.

The first detector whose candidate passes the checks decides. Where none finds a whole board,
`partial_board` looks for a part of one.
"""

from __future__ import annotations

import itertools

from bikeped.errors import CalibrationError
from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.lab.calibration.corners.board_check import DetectedBoard, check_board
from bikeped.lab.calibration.corners.candidates import (
    quick_candidates,
    raw_candidates,
    remapped_candidates,
)
from bikeped.lab.calibration.corners.partial_board import partial_board
from bikeped.lab.calibration.refusals import BoardRefusedError, no_board
from bikeped.types import ImageArray


def check_pattern(pattern: BoardPattern) -> None:
    """CalibrationError for a pattern that no detector can find."""
    if min(pattern.columns, pattern.rows) < 3:
        raise CalibrationError(
            f"--pattern {pattern}: a board needs at least 3x3 inner corners (a corner is where "
            "four squares meet)"
        )


def detect_board(
    grey: ImageArray, pattern: BoardPattern, *, thorough: bool = True
) -> DetectedBoard:
    """The board in a grey image [height, width]; BoardRefusedError, with the reason, without one.

    `thorough` False, for live frames: only the quickest detector, and only whole boards.
    """
    candidates = quick_candidates(grey, pattern)
    if thorough:
        candidates = itertools.chain(
            raw_candidates(grey, pattern), remapped_candidates(grey, pattern)
        )
    reason = ""
    for candidate in candidates:
        try:
            return check_board(grey, pattern, candidate)
        except BoardRefusedError as refused:  # noqa: PERF203  (a detection takes far longer)
            reason = reason or refused.reason
    if thorough:
        try:
            return partial_board(grey, pattern)
        except BoardRefusedError as refused:
            reason = refused.reason or reason
    raise BoardRefusedError(no_board(pattern, reason))
