"""Guides a person with a board before a live camera: what was seen, what is kept, what comes next.

No camera, clock or screen in here: frames and their times come in, a verdict in words comes out.
`live_session.py` runs it on a source, `live_page.py` shows it in a browser.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from bikeped.geometry import Lens
from bikeped.lab.calibration.board_view import BoardPattern, BoardView
from bikeped.lab.calibration.capture.coverage import Coverage, Part, cover, inside
from bikeped.lab.calibration.corners.board_check import Checked
from bikeped.lab.calibration.corners.find_boards import check_pattern, find_board
from bikeped.types import FloatArray, ImageArray

FEWEST, MOST = 12, 40
#: Enough when this share of the circle is covered, and FEWEST boards are kept.
ENOUGH_SHARE = 0.85
_STILL_SHARE = 0.003  # of the picture's width, between two looks
_STILL_WITHIN_S = 1.0
_NEW_SHARE = 0.05  # of the width, from every board that is kept
_NEW_CORNERS = 4  # in parts that are not covered yet
_BLUR_TIMES, _BLUR_PX = 1.6, 1.0  # as wide as this many times the sharpest board's edges


class Answer(enum.Enum):
    """What a frame was good for."""

    NO_BOARD = "no board"
    MOVING = "moving"
    BLURRED = "blurred"
    SEEN = "seen before"
    KEPT = "kept"


@dataclass(frozen=True)
class Verdict:
    """One frame's answer, in words too, and the corners [n, 2] that were found in it."""

    answer: Answer
    words: str
    uv_px: FloatArray


class Guide:
    """Keeps sharp, new and well-spread boards of one camera. One thread at a time.

    `lens` and `centre_px` need only be about right: they say where in the circle a board is.
    """

    def __init__(
        self,
        pattern: BoardPattern,
        width: int,
        height: int,
        lens: Lens,
        centre_px: tuple[float, float],
    ) -> None:
        check_pattern(pattern)
        self.pattern, self.width, self.height = pattern, width, height
        self.lens, self.centre_px = lens, centre_px
        self.kept: list[BoardView] = []
        self.coverage: Coverage = self._cover()
        self._last: tuple[float, Checked] | None = None
        self._sharpest_px = float("inf")

    @property
    def enough(self) -> bool:
        """Whether a calibration from the kept boards can be trusted all over the circle."""
        spread = self.coverage.share >= ENOUGH_SHARE and len(self.kept) >= FEWEST
        return spread or len(self.kept) >= MOST

    @property
    def advice(self) -> str:
        """What to do next, in one line."""
        if self.enough:
            return f"enough: {len(self.kept)} boards cover {self.coverage.share:.0%} of the circle"
        advice = self.coverage.advice(1)
        return advice[0] if advice else "more boards, anywhere, tilted this way and that"

    def look(self, grey: ImageArray, time_s: float) -> Verdict:
        """Judges one frame [height, width]; the caller saves it when the answer is KEPT.

        `time_s` on any clock that runs evenly. A board is kept at its second still sighting, so
        that the hand has come to rest.
        """
        seen = find_board(grey, self.pattern, thorough=False)
        before, self._last = self._last, None
        if seen.board is None:
            return Verdict(Answer.NO_BOARD, seen.why, np.empty((0, 2)))
        board = seen.board
        self._last = time_s, board
        self._sharpest_px = min(self._sharpest_px, board.blur_px)
        if board.blur_px > max(_BLUR_PX, _BLUR_TIMES * self._sharpest_px):
            return Verdict(Answer.BLURRED, "blurred: hold the board still", board.uv_px)
        if before is None or time_s - before[0] > _STILL_WITHIN_S:
            return Verdict(Answer.MOVING, "a board: hold it still", board.uv_px)
        if _moved_px(board, before[1]) > _STILL_SHARE * self.width:
            return Verdict(Answer.MOVING, "still moving: hold it still", board.uv_px)
        why_not = self._not_new(board)
        if why_not:
            return Verdict(Answer.SEEN, why_not, board.uv_px)
        name = f"board {len(self.kept) + 1}"
        self.kept.append(BoardView(name, board.ids, board.uv_px, self.width, self.height))
        self.coverage = self._cover()
        return Verdict(Answer.KEPT, f"kept as {name}", board.uv_px)

    def fills(self, board: Checked) -> list[Part]:
        """Parts of the circle that are not covered and that this board helps to cover."""
        offset = board.uv_px - np.array(self.centre_px)
        theta = self.lens.theta(np.hypot(offset[:, 0], offset[:, 1]))
        phi = np.arctan2(offset[:, 1], offset[:, 0])
        return [
            part
            for part in self.coverage.gaps
            if int(inside(part, theta, phi).sum()) >= _NEW_CORNERS
        ]

    def _not_new(self, board: Checked) -> str:
        near = min((_moved_px(board, view) for view in self.kept), default=float("inf"))
        if near < _NEW_SHARE * self.width:
            return "seen before: move or tilt the board"
        if len(self.kept) >= FEWEST and not self.fills(board):
            return "covered already: hold the board elsewhere"
        return ""

    def _cover(self) -> Coverage:
        window = (0.0, 0.0, float(self.width), float(self.height))
        return cover(self.kept, self.lens, self.centre_px, window)


def _moved_px(board: Checked, other: Checked | BoardView) -> float:
    """Root mean square over the corners that both have; infinite where there are too few."""
    _, mine, theirs = np.intersect1d(board.ids, other.ids, return_indices=True)
    if len(mine) < 4:
        return float("inf")
    off = board.uv_px[mine] - other.uv_px[theirs]
    return float(np.sqrt((off**2).sum(1).mean()))
