"""Track positions over time as parallel rows: what the rules read.

One row is one track in one frame; `previous` leads to the same track's row one frame earlier.
The pole holds the rows of the last fraction of a second and asks about the newest frame; the
simulation holds a whole suite of scenarios and asks about every frame at once.
"""

from __future__ import annotations

from dataclasses import dataclass

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


def pair_rows(rows: TrackRows, frames: int, first_frame: int = 0) -> Pairs:
    """All cyclist-pedestrian pairs of each of the frames first_frame..frames-1."""
    asked = rows.frame >= first_frame
    cyclist_row = (asked & (rows.kind == CYCLIST)).nonzero()[0]
    pedestrian_row = (asked & (rows.kind == PEDESTRIAN)).nonzero()[0]
    count = np.bincount(rows.frame[pedestrian_row], minlength=frames)
    start = count.cumsum() - count
    frame = rows.frame[cyclist_row]
    times = count[frame]
    cyclist = np.arange(len(cyclist_row)).repeat(times)
    # Where a cyclist's first pedestrian stands, less where its first pair does.
    shift = (start[frame] - (times.cumsum() - times)).repeat(times)
    return Pairs(cyclist_row, cyclist, pedestrian_row[shift + np.arange(len(cyclist))])
