"""Motion of road-user size where road users move, whatever a detector says.

A background of signs (sigma-delta: Manzanera and Richefeu, Pattern Recognition Letters 28, 2007)
is kept of a small grey picture; what differs from it by more than it usually does is gathered into
blobs. A blob counts when, standing on the ground below it, it has the size of a person, a cyclist
or a car's end, and when it has travelled `TRAVEL_M` in about one direction. Noise, rain, swaying
branches, shadows of clouds and steps of the exposure give blobs of other sizes, or such as go
nowhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np

from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing, road_region
from bikeped.types import FloatArray, ImageArray

EVERY_S = 0.25  #: a picture is taken this often
WINDOW_S = 60.0  #: over which motion is summed
TRAVEL_M = 2.0
JUMP_S = 2.0  #: a longer gap begins anew
_WIDTH = 640  #: pixels of the small picture, if it were of the whole frame
_USUAL_TIMES = 3  #: a pixel belongs to something when it differs so many times as much as usually
_LEAST_GREY, _MOST_GREY = 14, 120  #: bounds of that difference
_STEP_SHARE = 0.3  #: of the road that changes at once: light or exposure
_MOST_BLOBS = 16  #: more of them are weather
#: Least and most width and height, and area in square metres, of what stands upright there.
_WIDTH_M, _HEIGHT_M, _AREA_M2 = (0.2, 3.6), (0.5, 3.2), (0.12, 3.5)
_SPEED_MPS = (0.5, 13.0)
_STRAIGHT = 0.7  #: least share of the way that led away from its start
_LEAST_HITS, _MOST_MISSES = 6, (1, 2)  #: of a mover before it counts, and afterwards
_AREA_RATIO = 2.5  #: by which one thing's blobs differ from picture to picture


@dataclass(frozen=True)
class _Blob:
    """What differs from the background, standing at `at_m` on the ground."""

    at_m: FloatArray
    blur_m: float  #: by which one pixel and a half may put it off
    area_m2: float


@dataclass
class _Mover:
    """A blob that is followed over the ground; metres and seconds."""

    start_s: float
    start_m: FloatArray
    at_m: FloatArray
    seen_s: float
    area_m2: float
    velocity_mps: FloatArray = field(default_factory=lambda: np.zeros(2))
    way_m: float = 0.0
    hits: int = 1
    misses: int = 0
    episode: list[float] | None = None  #: its start and end, once it has travelled

    def gate_m(self, passed_s: float, blur_m: float) -> float:
        if self.hits == 1:
            return _SPEED_MPS[1] * passed_s + blur_m
        return 0.5 + blur_m + 0.25 * float(np.hypot(*self.velocity_mps)) * passed_s

    def hit(self, blob: _Blob, time_s: float) -> None:
        """Follows to where the blob is now; an alpha-beta filter against the pixels' steps."""
        measured_m, blur_m, self.area_m2 = blob.at_m, blob.blur_m, blob.area_m2
        passed_s = time_s - self.seen_s
        expected = self.at_m + self.velocity_mps * passed_s
        error = measured_m - expected
        at_m = expected + 0.5 * error
        self.velocity_mps = self.velocity_mps + (0.8 if self.hits == 1 else 0.3) * error / passed_s
        self.way_m += float(np.hypot(*(at_m - self.at_m)))
        self.at_m, self.seen_s = at_m, time_s
        self.hits, self.misses = self.hits + 1, 0
        away_m = float(np.hypot(*(at_m - self.start_m)))
        speed_mps = float(np.hypot(*self.velocity_mps))
        if self.episode is not None:
            if speed_mps >= _SPEED_MPS[0]:
                self.episode[1] = time_s
        elif (
            self.hits >= _LEAST_HITS
            and away_m >= TRAVEL_M + blur_m
            and away_m >= _STRAIGHT * self.way_m
            and _SPEED_MPS[0] <= away_m / (time_s - self.start_s) <= _SPEED_MPS[1]
        ):
            self.episode = [self.start_s, time_s]


class RoadMotion:
    """Looks for motion in the pictures of one camera, in the order of their times.

    `framing`: of the sensor. `range_m`: how far from the pole the road counts.
    """

    def __init__(self, camera: GroundCamera, framing: Framing, range_m: float) -> None:
        self._camera, self._framing, self._range_m = camera, framing, range_m
        self._region = road_region(camera, framing, range_m)
        self._shape: tuple[int, ...] = ()
        self.restart()

    def restart(self) -> None:
        """Forgets the background and all motion."""
        self._background: ImageArray | None = None
        self._usual: ImageArray = np.zeros((0, 0), np.uint8)
        self._movers: list[_Mover] = []
        self._episodes: list[list[float]] = []
        self._time_s = math.nan

    def due(self, time_s: float) -> bool:
        """Whether a picture of this time would be looked at."""
        return not 0 <= time_s - self._time_s < EVERY_S * 0.99

    def update(self, rgb: ImageArray, time_s: float) -> tuple[float, int]:
        """Takes the picture [h, w, 3] uint8 of `time_s`, a copy of the frame at any scale.

        Returns `motion`. GeometryError for a picture of another camera's proportions.
        """
        self._look(rgb, time_s)
        return self.motion(time_s)

    def _look(self, rgb: ImageArray, time_s: float) -> None:
        if not 0 < time_s - self._time_s <= JUMP_S or rgb.shape != self._shape:
            self.restart()
        if rgb.shape != self._shape:
            self._lay_out(rgb.shape)
        self._time_s = time_s
        grey = self._reduced(rgb)
        if self._background is None:
            self._background = grey
            self._usual = np.full_like(grey, _LEAST_GREY)
            return
        different = np.asarray(cv2.absdiff(grey, self._background), np.uint8)
        above = cv2.compare(different, self._usual, cv2.CMP_GT)
        mask = np.asarray(cv2.bitwise_and(above, self._road), np.uint8)
        share = cv2.countNonZero(mask) / max(1, self._road_px)
        if share > _STEP_SHARE:
            self._background, self._movers = grey, []
            return
        self._learn(grey, different)
        self._follow(self._blobs(mask), time_s)

    def motion(self, time_s: float) -> tuple[float, int]:
        """Seconds of the last `WINDOW_S` in which something travelled, and how many things did."""
        begin_s = time_s - WINDOW_S
        self._episodes = [episode for episode in self._episodes if episode[1] > begin_s]
        covered_s, until_s = 0.0, begin_s
        for first_s, last_s in sorted((a, b) for a, b in self._episodes):
            covered_s += max(0.0, last_s - max(first_s, until_s))
            until_s = max(until_s, last_s)
        return covered_s, len(self._episodes)

    def _lay_out(self, shape: tuple[int, ...]) -> None:
        """The small picture of copies of this shape, and where its pixels lie on the ground."""
        self._shape = shape
        height, width = shape[:2]
        self._part = left, top, right, bottom = self._region.pixels(width, height)
        shrink = max(1.0, width / _WIDTH)
        across = max(1, round((right - left) / shrink))
        down = max(1, round((bottom - top) / shrink))
        self._size = across, down
        frame = self._framing.for_frame(width, height)
        step = np.array([(right - left) / across, (bottom - top) / down])
        u, v = np.meshgrid(np.arange(across + 1.0), np.arange(down + 1.0))
        rays = self._camera.rays(
            frame.frame_to_crop(np.stack([u, v], axis=-1) * step + (left, top))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            self._xy_m = rays[..., :2] * (self._camera.height_m / -rays[..., 2:])
            away_m = np.hypot(self._xy_m[..., 0], self._xy_m[..., 1])
            self._on_road = (rays[..., 2] < 0) & (away_m <= self._range_m)
        #: Radians that a pixel is wide.
        self._pixel_rad = np.linalg.norm(np.diff(rays, axis=1), axis=-1)
        # Road users stand out above the ground: all that the lens shows of the region.
        lit = np.isfinite(rays[:-1, :-1]).all(axis=-1)
        self._road = np.where(lit, 255, 0).astype(np.uint8)
        self._road_px = int(lit.sum())

    def _reduced(self, rgb: ImageArray) -> ImageArray:
        left, top, right, bottom = self._part
        green = cv2.extractChannel(np.asarray(rgb[top:bottom, left:right]), 1)
        # Halving by INTER_AREA is quick; by other ratios it is slow.
        halves = max(0, int(math.log2(max(1.0, (right - left) / self._size[0]))))
        for _ in range(halves):
            green = cv2.resize(green, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        if green.shape != (self._size[1], self._size[0]):
            green = cv2.resize(green, self._size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(cv2.blur(green, (3, 3)), np.uint8)

    def _learn(self, grey: ImageArray, different: ImageArray) -> None:
        """Moves background and usual difference one level toward the picture."""
        assert self._background is not None  # noqa: S101  set by `update`
        one = np.uint8(1)
        back = self._background
        self._background = back + (grey > back) * one - (grey < back) * one
        target = np.asarray(cv2.convertScaleAbs(different, alpha=_USUAL_TIMES), np.uint8)
        usual = self._usual + (target > self._usual) * one - (target < self._usual) * one
        self._usual = np.clip(usual, _LEAST_GREY, _MOST_GREY)

    def _blobs(self, mask: ImageArray) -> list[_Blob]:
        """The blobs of plausible size."""
        closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 3), np.uint8))
        _, _, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
        found = []
        for left, top, width, height, area in stats[1:].tolist():
            row, column = top + height, left + width // 2
            if area < 6 or not self._on_road[row, column]:
                continue
            xy = self._xy_m[row, column]
            sight_m = math.hypot(*xy, self._camera.height_m)
            size_m = sight_m * float(self._pixel_rad[row, column])
            blur_m = 1.5 * size_m * sight_m / self._camera.height_m
            if (
                _WIDTH_M[0] <= width * size_m <= _WIDTH_M[1]
                and _HEIGHT_M[0] <= height * size_m <= _HEIGHT_M[1]
                and _AREA_M2[0] <= area * size_m**2 <= _AREA_M2[1]
            ):
                found.append(_Blob(xy, blur_m, area * size_m**2))
        return found if len(found) <= _MOST_BLOBS else []

    def _follow(self, blobs: list[_Blob], time_s: float) -> None:
        """Gives each mover the nearest blob; what is left over begins new ones."""
        pairs = []
        for mover_index, mover in enumerate(self._movers):
            since_s = time_s - mover.seen_s
            expected = mover.at_m + mover.velocity_mps * since_s
            for blob_index, blob in enumerate(blobs):
                off_m = math.dist(expected, blob.at_m)
                ratio = blob.area_m2 / mover.area_m2
                alike = 1 / _AREA_RATIO <= ratio <= _AREA_RATIO
                if alike and off_m <= mover.gate_m(since_s, blob.blur_m):
                    pairs.append((off_m, mover_index, blob_index))
        movers, free = dict(enumerate(self._movers)), dict(enumerate(blobs))
        for _, mover_index, blob_index in sorted(pairs):
            if mover_index in movers and blob_index in free:
                mover = movers.pop(mover_index)
                begun = mover.episode is not None
                mover.hit(free.pop(blob_index), time_s)
                if mover.episode is not None and not begun:
                    self._episodes.append(mover.episode)
        for mover in movers.values():
            mover.misses += 1
        self._movers = [
            mover
            for mover in self._movers
            if mover.misses <= _MOST_MISSES[mover.episode is not None]
        ]
        self._movers += [
            _Mover(time_s, blob.at_m, blob.at_m, time_s, blob.area_m2) for blob in free.values()
        ]
