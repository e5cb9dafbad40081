"""Track positions over time as parallel rows: what the rules read.

One row is one track in one frame; `previous` leads to the same track's row one frame earlier.
The pole holds the rows of the last fraction of a second and asks about the newest frame; the
simulation holds a whole suite of scenarios and asks about every frame at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.types import FloatArray, IntArray, Kind, KindArray

IndexArray = npt.NDArray[np.intp]

# Plain integers: numpy looks an enum's attributes up at every comparison.
CYCLIST, PEDESTRIAN = int(Kind.CYCLIST), int(Kind.PEDESTRIAN)


@dataclass(frozen=True)
class TrackRows:
    """Parallel arrays over rows, sorted by frame, within a frame in track order.

    `frame` [r] counts frames; `time_s` [r] is the frame's time; `xy_m` [r, 2] is in the camera
    ground frame; `previous` [r] is a row index or -1.
    """

    frame: IndexArray
    time_s: FloatArray
    id: IntArray
    kind: KindArray
    xy_m: FloatArray
    previous: IndexArray

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Pairs:
    """Cyclist-pedestrian pairs: rows of the cyclists, and per pair which of them and whom.

    `cyclist_row` [c]; `cyclist` [m] index into it; `pedestrian_row` [m]. In track order.
    """

    cyclist_row: IndexArray
    cyclist: IndexArray
    pedestrian_row: IndexArray

    def __len__(self) -> int:
        return len(self.cyclist)


def pair_rows(rows: TrackRows, frames: int, first_row: int = 0) -> Pairs:
    """All cyclist-pedestrian pairs of each frame, of the rows from `first_row` on.

    `frames` is more than the number of the last frame.
    """
    kind = rows.kind[first_row:]
    cyclist_row = (kind == CYCLIST).nonzero()[0] + first_row
    pedestrian_row = (kind == PEDESTRIAN).nonzero()[0] + first_row
    cyclists, pedestrians = len(cyclist_row), len(pedestrian_row)
    if cyclists == 0 or pedestrians == 0:
        return Pairs(cyclist_row, cyclist_row[:0], pedestrian_row[:0])
    if rows.frame[first_row] == rows.frame[-1]:  # one frame: everybody meets everybody
        cyclist = np.arange(cyclists).repeat(pedestrians)
        return Pairs(cyclist_row, cyclist, pedestrian_row[None].repeat(cyclists, axis=0).ravel())
    count = np.bincount(rows.frame[pedestrian_row], minlength=frames)
    start = count.cumsum() - count
    frame = rows.frame[cyclist_row]
    times = count[frame]
    cyclist = np.arange(cyclists).repeat(times)
    # Where a cyclist's first pedestrian stands, less where its first pair does.
    shift = (start[frame] - (times.cumsum() - times)).repeat(times)
    return Pairs(cyclist_row, cyclist, pedestrian_row[shift + np.arange(len(cyclist))])


class RowBuffer:
    """Rows of the last `span_s` seconds (and somewhat more), appended frame by frame.

    The arrays are allocated once and filled from the front; when they are full, the frames that
    still matter move to the front, which happens every few seconds.
    """

    def __init__(self, span_s: float, capacity: int = 512) -> None:
        self._span_s = span_s
        self._starts: list[tuple[float, int]] = []  #: time and first row of each frame held
        self._used = 0
        self._frame: IndexArray = np.zeros(capacity, np.intp)
        self._time_s: FloatArray = np.zeros(capacity)
        self._id: IntArray = np.zeros(capacity, np.int64)
        self._kind: KindArray = np.zeros(capacity, np.int8)
        self._xy_m: FloatArray = np.zeros((capacity, 2))
        self._previous: IndexArray = np.zeros(capacity, np.intp)

    @property
    def frames(self) -> int:
        """How many frames are held."""
        return len(self._starts)

    def append(
        self, time_s: float, ids: IntArray, kind: KindArray, xy_m: FloatArray
    ) -> tuple[TrackRows, int]:
        """All rows held after a frame at `time_s`, and the first row of that frame.

        `ids` ascend. The rows are views, good until the next call. ValueError when time does not
        advance.
        """
        if self._starts and time_s <= self._starts[-1][0]:
            raise ValueError(
                f"time_s: {time_s} is not after the last frame's {self._starts[-1][0]}"
            )
        count = len(ids)
        # Empty frames fill no rows, but they count: a night without anybody has a million of them.
        if self._used + count > len(self._frame) or len(self._starts) >= len(self._frame):
            self._make_room(time_s, count)
        last = self._starts[-1][1] if self._starts else 0
        first, end = self._used, self._used + count
        before = self._id[last:first]
        if count and len(before):
            place = np.minimum(before.searchsorted(ids), len(before) - 1)
            self._previous[first:end] = np.where(before[place] == ids, place + last, -1)
        else:
            self._previous[first:end] = -1
        self._frame[first:end] = len(self._starts)
        self._time_s[first:end] = time_s
        self._id[first:end] = ids
        self._kind[first:end] = kind
        self._xy_m[first:end] = xy_m
        self._starts.append((time_s, first))
        self._used = end
        return (
            TrackRows(
                self._frame[:end],
                self._time_s[:end],
                self._id[:end],
                self._kind[:end],
                self._xy_m[:end],
                self._previous[:end],
            ),
            first,
        )

    def _make_room(self, time_s: float, count: int) -> None:
        """Moves the frames within the span to the front, into larger arrays where they need it."""
        starts = self._starts
        # One frame beyond the span is kept: the older neighbour of an interpolation.
        drop = 0
        while drop + 2 < len(starts) and starts[drop + 1][0] < time_s - self._span_s - 1e-6:
            drop += 1
        cut = starts[drop][1] if starts else 0
        kept = self._used - cut
        capacity = max(len(self._frame), 4 * (kept + count))

        def moved(array: Any, shift: int = 0) -> Any:
            new = np.zeros((capacity, *array.shape[1:]), array.dtype)
            new[:kept] = array[cut : self._used] - shift
            return new

        self._frame, self._time_s = moved(self._frame, drop), moved(self._time_s)
        self._id, self._kind, self._xy_m = moved(self._id), moved(self._kind), moved(self._xy_m)
        self._previous = np.maximum(moved(self._previous, cut), -1)
        self._starts = [(t, row - cut) for t, row in starts[drop:]]
        self._used = kept
