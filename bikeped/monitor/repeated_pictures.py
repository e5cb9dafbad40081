"""Finds a stream that repeats itself: one picture, or a loop of up to 30.

A new picture differs from all kept ones by its sensor noise. Where a codec has stirred that noise,
a loop still shows: the change from one frame to the next is that of some frames ago, and of no
frame beside it; real movement and sway are like those of the frames beside it, too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from bikeped.monitor.reduced_picture import Reduced
from bikeped.types import Float32Array, ImageArray

_SIDE = 56  #: samples are taken at 56 x 56 places, in pairs of neighbours
_KEPT = 32  #: new pictures that are remembered
_LAGS = 32  #: changes that are remembered; a loop of 30 and its neighbours
_MIN_REPEATS = 4  #: frames, so that a slow stream or a gap is not taken for a frozen one
_REPEAT_SHARE = 0.1  #: of the usual change, below which a picture is a repeated one
_EPS = (0.02, 0.2)  #: grey levels: bounds of that
_NOISY_SHARE = 0.25  #: of the samples change at every frame where there is noise
_MOVED = 8.0  #: grey levels of one pixel of the coarse picture, where there is no noise
_LOOP = 0.2  #: correlation above that of the neighbouring lags
_SMOOTH = 0.3  #: of the newest correlations in the mean


class RepeatedPictures:
    """Tells new pictures from repeated ones, frame by frame."""

    def __init__(self) -> None:
        self._kept: deque[tuple[ImageArray, ImageArray | None]] = deque(maxlen=_KEPT)
        self._changes: deque[Float32Array] = deque(maxlen=_LAGS)
        self._last: ImageArray | None = None
        self._lag_match = np.zeros(_LAGS)
        self._usual = 0.5  #: change between pictures, mean grey levels; of new pictures only
        self._noisy = 0.0  #: share of samples that change in the quietest new pictures
        self._new_s: deque[float] = deque(maxlen=2)
        self._repeats: deque[int] = deque(maxlen=2)

    def update(self, rgb: ImageArray, time_s: float, reduced: Callable[[], Reduced]) -> float:
        """Seconds that brought at most one new picture; 0 while that is too few frames to tell.

        One is let pass: an encoder draws a frozen picture anew at its next key frame. `reduced`
        gives the picture's reduced copies, where they are needed.
        """
        samples = _samples(rgb)
        looped = self._looped(samples)
        new, coarse = self._is_new(reduced, samples, looped)
        self._last = samples
        if new or not self._new_s:
            self._kept.append((samples, coarse))
            self._new_s.append(time_s)
            self._repeats.append(0)
        else:
            self._repeats[-1] += 1
        if sum(self._repeats) < _MIN_REPEATS:
            return 0.0
        return max(0.0, time_s - self._new_s[0])

    def _is_new(
        self, reduced: Callable[[], Reduced], samples: ImageArray, looped: bool
    ) -> tuple[bool, ImageArray | None]:
        """Whether the picture is new, and its coarse copy where that was needed."""
        eps = min(max(_REPEAT_SHARE * self._usual, _EPS[0]), _EPS[1])
        apart = [cv2.norm(samples, kept, cv2.NORM_L1) / samples.size for kept, _ in self._kept]
        nearest = min(apart, default=np.inf)
        if nearest > eps and not looped and self._last is not None:
            changed = float((samples != self._last).mean())
            self._usual += (0.3 if nearest < self._usual else 0.02) * (nearest - self._usual)
            self._noisy += (0.3 if changed < self._noisy else 0.02) * (changed - self._noisy)
        if self._noisy > _NOISY_SHARE:
            return nearest > eps and not looped, None
        # Without noise only movement makes a picture new, and samples may miss a small one.
        coarse = reduced().coarse
        same = (
            other is not None and gap <= eps and cv2.norm(coarse, other, cv2.NORM_INF) <= _MOVED
            for gap, (_, other) in zip(apart, self._kept, strict=True)
        )
        return not looped and not any(same), coarse

    def _looped(self, samples: ImageArray) -> bool:
        """Whether the changes since the last frame are those of a loop."""
        if self._last is None:
            return False
        # Neighbours' difference: flicker of lamps and clouds, which are periodic, cancel out.
        now, before = samples.astype(np.float32), self._last.astype(np.float32)
        change = now[0] - now[1] - before[0] + before[1]
        noisy = float((change != 0).mean()) > 0.5 * _NOISY_SHARE  # more than a walker
        limit = 1.0 + 4.0 * float(np.abs(change).mean())
        change = np.clip(change, -limit, limit)
        change -= change.mean()
        size = float(np.linalg.norm(change))
        change = change / max(size, 1e-6)
        if size > _SIDE * _EPS[0] and self._changes:
            match = np.zeros(_LAGS)
            match[: len(self._changes)] = np.stack(self._changes) @ change
            self._lag_match += _SMOOTH * (match - self._lag_match)
        else:
            change = np.zeros_like(change)
        self._changes.appendleft(change)
        between = self._lag_match[1:-1]
        beside = np.maximum(np.maximum(self._lag_match[:-2], self._lag_match[2:]), 0.0)
        return noisy and bool((between - beside).max() > _LOOP)


def _samples(rgb: ImageArray) -> ImageArray:
    """Green at places all over the picture and two pixels beside them [2, n]."""
    rows, columns = _places(*rgb.shape[:2])
    return np.asarray(rgb[rows, columns, 1], np.uint8)


@lru_cache(maxsize=4)
def _places(height: int, width: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    share = (np.arange(_SIDE) + 0.5) / _SIDE
    rows = (share * height).astype(np.intp)[:, None]
    columns = (share * (width - 2)).astype(np.intp)[None]
    grid = np.broadcast_arrays(rows, columns)
    flat = [part.ravel() for part in grid]
    return np.stack([flat[0], flat[0]]), np.stack([flat[1], flat[1] + 2])
