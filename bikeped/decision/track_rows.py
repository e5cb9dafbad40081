"""Track positions over time as parallel rows: the input of the rules.

One row is one track in one frame; `previous` is the index of the same track's row one frame
earlier. The device holds the rows of the last fraction of a second and evaluates the newest frame;
the simulation holds a suite of scenarios and evaluates all frames at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from bikeped.types import BoolArray, FloatArray, IntArray, Kind, KindArray

IndexArray = npt.NDArray[np.intp]

#: Two frames closer in time than this are the same moment (rounding of i / 30).
EPSILON_S = 1e-6
# Plain integers: numpy looks up an enum's attributes at every comparison.
CYCLIST, PEDESTRIAN = int(Kind.CYCLIST), int(Kind.PEDESTRIAN)


@dataclass(frozen=True)
class TrackRows:
    """Parallel arrays over rows, sorted by frame, within a frame in track order.

    `frame` [r] counts frames; `time_s` [r] is the frame's time; `xy_m` and `velocity_mps` [r, 2]
    are in the camera ground frame; `counts` [r] are tracks that the decision may count
    (`who_counts`); `previous` [r] is a row index or -1.
    """

    frame: IndexArray
    time_s: FloatArray
    id: IntArray
    kind: KindArray
    xy_m: FloatArray
    velocity_mps: FloatArray
    counts: BoolArray
    previous: IndexArray

    def __len__(self) -> int:
        return len(self.frame)


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

    def take(self, index: BoolArray) -> Pairs:
        """The pairs at `index` [m]."""
        return Pairs(self.cyclist_row, self.cyclist[index], self.pedestrian_row[index])


def pair_rows(rows: TrackRows, first_row: int = 0) -> Pairs:
    """All pairs that count within each frame, of the rows from `first_row` on."""
    kind = np.where(rows.counts[first_row:], rows.kind[first_row:], -1)
    cyclist_row = (kind == CYCLIST).nonzero()[0] + first_row
    pedestrian_row = (kind == PEDESTRIAN).nonzero()[0] + first_row
    cyclists, pedestrians = len(cyclist_row), len(pedestrian_row)
    if cyclists == 0 or pedestrians == 0:
        return Pairs(cyclist_row, cyclist_row[:0], pedestrian_row[:0])
    if rows.frame[first_row] == rows.frame[-1]:  # one frame: all combinations
        cyclist = np.arange(cyclists).repeat(pedestrians)
        return Pairs(cyclist_row, cyclist, pedestrian_row[None].repeat(cyclists, axis=0).ravel())
    count = np.bincount(rows.frame[pedestrian_row], minlength=rows.frame[-1] + 1)
    start = count.cumsum() - count
    frame = rows.frame[cyclist_row]
    times = count[frame]
    cyclist = np.arange(cyclists).repeat(times)
    # A cyclist's first pedestrian's index minus its first pair's.
    shift = (start[frame] - (times.cumsum() - times)).repeat(times)
    return Pairs(cyclist_row, cyclist, pedestrian_row[shift + np.arange(len(cyclist))])


class RowBuffer:
    """Rows of at least the last `span_s` seconds, appended frame by frame."""

    def __init__(self, span_s: float) -> None:
        self._span_s = span_s
        self._last_s = -math.inf
        self._last_count = 0  #: tracks in the last frame
        none = np.zeros(0, np.intp)
        self._rows = TrackRows(
            none,
            np.zeros(0),
            np.zeros(0, np.int64),
            np.zeros(0, np.int8),
            np.zeros((0, 2)),
            np.zeros((0, 2)),
            np.zeros(0, np.bool_),
            none,
        )

    def append(
        self,
        time_s: float,
        ids: IntArray,
        kind: KindArray,
        xy_m: FloatArray,
        velocity_mps: FloatArray,
        counts: BoolArray,
    ) -> tuple[TrackRows, int]:
        """Adds the frame at `time_s`; returns all rows held and the index of its first row.

        `ids` [n] ascending; the other arrays are those of `TrackRows`. ValueError when time does
        not advance.
        """
        if time_s <= self._last_s:
            raise ValueError(f"time_s: {time_s} is not after the last frame's {self._last_s}")
        old, count = self._rows, len(ids)
        # One frame beyond the span is kept: the older neighbour of an interpolation.
        cut = int(old.time_s.searchsorted(time_s - self._span_s - EPSILON_S))
        if cut:
            cut = int(old.time_s.searchsorted(old.time_s[cut - 1]))
        first = len(old) - cut
        before = old.id[len(old) - self._last_count :]
        previous: IndexArray = np.full(count, -1, np.intp)
        if count and len(before):
            place = np.minimum(before.searchsorted(ids), len(before) - 1)
            previous = np.where(before[place] == ids, place + first - len(before), -1)
        frame = old.frame[-1] + 1 if len(old) else 0
        new = TrackRows(
            np.full(count, frame),
            np.full(count, time_s),
            ids,
            kind,
            xy_m,
            velocity_mps,
            counts,
            previous,
        )
        kept = replace(old, previous=np.maximum(old.previous - cut, -1))
        pairs = zip(vars(kept).values(), vars(new).values(), strict=True)
        self._rows = TrackRows(*(np.concatenate([past[cut:], now]) for past, now in pairs))
        self._last_s, self._last_count = time_s, count
        return self._rows, first
