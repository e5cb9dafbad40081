"""Guides a person with a board before a live camera: which boards to keep, and what to do next.

No camera, clock or screen in here: frames and their times come in, verdicts come out.
`live_session` runs it on a source, `live_page` shows it in a browser.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np

from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardPattern, BoardRefusedError, BoardView
from bikeped.lab.calibration.capture.coverage import Coverage, corner_counts, measure_coverage
from bikeped.lab.calibration.corners.board_check import DetectedBoard, rms_shift_px
from bikeped.lab.calibration.corners.board_detector import check_pattern, detect_board
from bikeped.types import FloatArray, ImageArray

FEWEST, MOST = 12, 40
#: Enough when this share of the circle is covered, and FEWEST boards are kept.
ENOUGH_SHARE = 0.85
_STILL_SHARE = 0.003  # of the image's width, between two frames
_STILL_WITHIN_S = 1.0
_NEW_SHARE = 0.05  # of the width, from every board that is kept
_NEW_CORNERS = 4  # in sectors that are not covered yet
_BLUR_TIMES, _BLUR_PX = 1.6, 1.0  # edges wider than the sharpest board's by this factor
_LEAST_COMMON = 4  # corners for a comparison of two boards


class FrameStatus(enum.Enum):
    """What became of a frame."""

    NO_BOARD = "no board"
    MOVING = "moving"
    BLURRED = "blurred"
    SEEN = "seen before"
    KEPT = "kept"


@dataclass(frozen=True)
class FrameVerdict:
    """One frame's status, a text for the person with the board, and the corners [n, 2] found."""

    status: FrameStatus
    text: str
    uv_px: FloatArray


@dataclass
class CaptureGuide:
    """Keeps sharp, new and well-spread boards of one camera. One thread at a time.

    `lens` and `centre_px` may be approximate: they only locate a board in the circle.
    """

    pattern: BoardPattern
    width: int
    height: int
    lens: Lens
    centre_px: tuple[float, float]
    kept: list[BoardView] = field(default_factory=list, init=False)
    _last: tuple[float, DetectedBoard] | None = field(default=None, init=False)
    _sharpest_px: float = field(default=float("inf"), init=False)

    def __post_init__(self) -> None:
        check_pattern(self.pattern)
        self.coverage: Coverage = self._measure()

    @property
    def enough(self) -> bool:
        """Whether the kept boards suffice for a calibration all over the circle."""
        spread = self.coverage.share >= ENOUGH_SHARE and len(self.kept) >= FEWEST
        return spread or len(self.kept) >= MOST

    @property
    def advice(self) -> str:
        """What to do next, in one line."""
        if self.enough:
            return f"enough: {len(self.kept)} boards cover {self.coverage.share:.0%} of the circle"
        advice = self.coverage.advice(1)
        return advice[0] if advice else "more boards, anywhere, tilted this way and that"

    def check_frame(self, grey: ImageArray, time_s: float) -> FrameVerdict:
        """The verdict on one frame [height, width]; the caller saves it when its status is KEPT.

        `time_s` on any monotonic clock. A board is kept when it is detected at rest a second time.
        """
        before, self._last = self._last, None
        try:
            board = detect_board(grey, self.pattern, thorough=False)
        except BoardRefusedError as refused:
            return FrameVerdict(FrameStatus.NO_BOARD, str(refused), np.empty((0, 2)))
        self._last = time_s, board
        status, text = self._classify(board, time_s, before)
        if status is FrameStatus.KEPT:
            self.kept.append(BoardView(text, board.ids, board.uv_px, self.width, self.height))
            self.coverage = self._measure()
            text = f"kept as {text}"
        return FrameVerdict(status, text, board.uv_px)

    def _classify(
        self, board: DetectedBoard, time_s: float, before: tuple[float, DetectedBoard] | None
    ) -> tuple[FrameStatus, str]:
        """Status and text of a board; for KEPT the text is its name."""
        self._sharpest_px = min(self._sharpest_px, board.blur_px)
        if board.blur_px > max(_BLUR_PX, _BLUR_TIMES * self._sharpest_px):
            return FrameStatus.BLURRED, "blurred: hold the board still"
        if before is None or time_s - before[0] > _STILL_WITHIN_S:
            return FrameStatus.MOVING, "a board: hold it still"
        if rms_shift_px(board, before[1], _LEAST_COMMON) > _STILL_SHARE * self.width:
            return FrameStatus.MOVING, "still moving: hold it still"
        shifts = (rms_shift_px(board, view, _LEAST_COMMON) for view in self.kept)
        if min(shifts, default=float("inf")) < _NEW_SHARE * self.width:
            return FrameStatus.SEEN, "seen before: move or tilt the board"
        if len(self.kept) >= FEWEST:
            gaps = self.coverage.gaps
            new = corner_counts(gaps, board.uv_px, self.lens, self.centre_px) >= _NEW_CORNERS
            if not new.any():
                return FrameStatus.SEEN, "covered already: hold the board elsewhere"
        return FrameStatus.KEPT, f"board {len(self.kept) + 1}"

    def _measure(self) -> Coverage:
        window = (0.0, 0.0, float(self.width), float(self.height))
        return measure_coverage(self.kept, self.lens, self.centre_px, window)
