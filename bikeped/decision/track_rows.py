"""Track positions over time as parallel rows: the input of the rules.

One row is one track in one frame; `previous` is the index of the same track's row one frame
earlier. The device holds the rows of the last fraction of a second and evaluates the newest frame;
the simulation holds a suite of scenarios and evaluates all frames at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.types import FloatArray, IntArray, Kind, KindArray

IndexArray = npt.NDArray[np.intp]

# Plain integers: numpy looks up an enum's attributes at every comparison.
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

    @staticmethod
    def zeros(count: int) -> TrackRows:
        """`count` rows to be filled in."""
        return TrackRows(
            np.zeros(count, np.intp),
            np.zeros(count),
            np.zeros(count, np.int64),
            np.zeros(count, np.int8),
            np.zeros((count, 2)),
            np.zeros(count, np.intp),
        )

    def view(self, first: int, end: int) -> TrackRows:
        """The rows from `first` to before `end`; the arrays are shared."""
        return TrackRows(*(array[first:end] for array in vars(self).values()))


@dataclass(frozen=True)
class Pairs:
    """Cyclist-pedestrian pairs in track order.

    `cyclist_row` [c]: rows of the cyclists; `cyclist` [m]: each pair's index into it;
    `pedestrian_row` [m]: each pair's pedestrian.
    """

    cyclist_row: IndexArray
    cyclist: IndexArray
    pedestrian_row: IndexArray

    def __len__(self) -> int:
        return len(self.cyclist)


def pair_rows(rows: TrackRows, frames: int, first_row: int = 0) -> Pairs:
    """All cyclist-pedestrian pairs within each frame, of the rows from `first_row` on.

    `frames` is greater than the last frame's number.
    """
    kind = rows.kind[first_row:]
    cyclist_row = (kind == CYCLIST).nonzero()[0] + first_row
    pedestrian_row = (kind == PEDESTRIAN).nonzero()[0] + first_row
    cyclists, pedestrians = len(cyclist_row), len(pedestrian_row)
    if cyclists == 0 or pedestrians == 0:
        return Pairs(cyclist_row, cyclist_row[:0], pedestrian_row[:0])
    if rows.frame[first_row] == rows.frame[-1]:  # one frame: all combinations
        cyclist = np.arange(cyclists).repeat(pedestrians)
        return Pairs(cyclist_row, cyclist, pedestrian_row[None].repeat(cyclists, axis=0).ravel())
    count = np.bincount(rows.frame[pedestrian_row], minlength=frames)
    start = count.cumsum() - count
    frame = rows.frame[cyclist_row]
    times = count[frame]
    cyclist = np.arange(cyclists).repeat(times)
    # A cyclist's first pedestrian's index minus its first pair's.
    shift = (start[frame] - (times.cumsum() - times)).repeat(times)
    return Pairs(cyclist_row, cyclist, pedestrian_row[shift + np.arange(len(cyclist))])


class RowBuffer:
    """Rows of at least the last `span_s` seconds, appended frame by frame.

    The arrays are allocated once and filled from the front; when they are full, every few seconds,
    the frames within the span move to the front.
    """

    def __init__(self, span_s: float, capacity: int = 512) -> None:
        self._span_s = span_s
        self._starts: list[tuple[float, int]] = []  #: time and first row of each frame held
        self._used = 0
        self._rows = TrackRows.zeros(capacity)

    @property
    def frames(self) -> int:
        """Number of frames held."""
        return len(self._starts)

    def append(
        self, time_s: float, ids: IntArray, kind: KindArray, xy_m: FloatArray
    ) -> tuple[TrackRows, int]:
        """Adds the frame at `time_s`; returns all rows held and the index of its first row.

        `ids` [n] ascending, `kind` [n], `xy_m` [n, 2] (m). The rows are views, valid until the next
        call. ValueError when time does not advance.
        """
        if self._starts and time_s <= self._starts[-1][0]:
            raise ValueError(
                f"time_s: {time_s} is not after the last frame's {self._starts[-1][0]}"
            )
        count = len(ids)
        # Empty frames fill no rows, but they count: a quiet night has a million of them.
        if self._used + count > len(self._rows) or len(self._starts) >= len(self._rows):
            self._make_room(time_s, count)
        last = self._starts[-1][1] if self._starts else 0
        first, end = self._used, self._used + count
        before, new = self._rows.id[last:first], self._rows.view(first, end)
        new.previous[:] = -1
        if count and len(before):
            place = np.minimum(before.searchsorted(ids), len(before) - 1)
            new.previous[:] = np.where(before[place] == ids, place + last, -1)
        new.frame[:] = len(self._starts)
        new.time_s[:] = time_s
        new.id[:], new.kind[:], new.xy_m[:] = ids, kind, xy_m
        self._starts.append((time_s, first))
        self._used = end
        return self._rows.view(0, end), first

    def _make_room(self, time_s: float, count: int) -> None:
        """Moves the frames within the span to the front, into larger arrays where needed."""
        starts = self._starts
        # One frame beyond the span is kept: the older neighbour of an interpolation.
        drop = 0
        while drop + 2 < len(starts) and starts[drop + 1][0] < time_s - self._span_s - 1e-6:
            drop += 1
        cut = starts[drop][1] if starts else 0
        kept = self._used - cut
        old = self._rows.view(cut, self._used)
        self._rows = TrackRows.zeros(max(len(self._rows), 4 * (kept + count)))
        new = self._rows.view(0, kept)
        new.frame[:] = old.frame - drop
        new.time_s[:], new.id[:] = old.time_s, old.id
        new.kind[:], new.xy_m[:] = old.kind, old.xy_m
        new.previous[:] = np.maximum(old.previous - cut, -1)
        self._starts = [(t, row - cut) for t, row in starts[drop:]]
        self._used = kept
