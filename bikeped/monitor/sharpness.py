"""How sharp the picture is, as a whole and in its parts.

Sharpness is the energy of slopes along the rows after a narrow smoothing over that after one twice
as wide: about 2 for a sharp picture, 1 for a blurred one, whatever its brightness and contrast.
Only what two pictures, one after the other, have in common counts: not noise, not falling rain.
"""

from __future__ import annotations

import cv2
import numpy as np

from bikeped.monitor.reduced_picture import Circle, inside
from bikeped.types import BoolArray, Float32Array, ImageArray

GRID = (20, 32)  #: rows and columns of parts
_SIGMAS = (1.0, 2.0)  #: pixels of `Reduced.lines`
_ROWS = 80  #: lines that are enough
_SMOOTH_S = 0.3  #: time constant of the whole picture's sharpness,
_PARTS_SMOOTH_S = 1.5  #: and of the parts', which is noisier
_WEAK = 0.05  #: squared grey levels a pixel: without slopes nothing can be said
_SHARP = 1.3  #: a part that has been sharper than this can be seen to lose it
#: A part is blurred below these shares, of its usual sharpness and of its usual energy of fine
#: slopes; both in proportion to the whole picture's: light and weather change them everywhere.
_PART_SHARP, _PART_LEFT = 0.85, 0.65
_ABOVE_NOISE = 1.0  #: energy of a part that can be judged, over that of noise and rain
_SMOOTH = 0.2  #: of the newest noise in its mean
_FEW = 8
_KNOWN_S = 2.0
_FORGET_S = 60.0
_PARTS, _PARTS_ABOVE = 0.08, 0.05  #: share of blurred parts that is too much, see `parts_limit`
_KERNELS = [cv2.getGaussianKernel(2 * int(3 * s) + 1, s).astype(np.float32) for s in _SIGMAS]
_ONE = np.ones(1, np.float32)


class Sharpness:
    """Follows the sharpness of pictures of one size."""

    def __init__(self, circle: Circle | None, aspect: float) -> None:
        self._region: BoolArray = inside(*GRID, circle, aspect)
        self._before: list[Float32Array] = []
        self._energy = np.zeros((2, *GRID), np.float32)
        self._parts = np.zeros((2, *GRID), np.float32)
        self._noise = 0.0  #: energy of the fine slopes that two pictures do not have in common
        self._pictures = 0
        self._seen_s = 0.0
        self._usual = 1.0
        self._usual_share = 0.0
        self._usual_energy = np.zeros((2, *GRID), np.float32)

    @property
    def usual(self) -> float:
        """The site's own sharpness; NaN before it is known."""
        return self._usual if self._seen_s >= _KNOWN_S else float("nan")

    @property
    def parts_limit(self) -> float:
        """Share of blurred parts that is too much here: the site's own in rain and noise counts."""
        return max(_PARTS, _PARTS_ABOVE + self._usual_share)

    def update(self, lines: ImageArray, passed_s: float, learn: bool) -> tuple[float, float]:
        """Sharpness of the whole picture, and the share of its parts that lost theirs; or NaN.

        `learn`: nothing is wrong with the picture.
        """
        self._measure(lines, passed_s)
        fine, wide = energy = np.maximum(self._energy, 0.0)
        strong = self._strong(wide)
        if strong.sum() < 2 or self._pictures < 2:
            return float("nan"), float("nan")
        best = strong & (wide >= np.quantile(wide[strong], 0.5))
        sharp = float(fine[best].sum() / wide[best].sum())
        share, lost = self._lost(np.maximum(self._parts, 0.0), sharp)
        if learn:
            self._seen_s += passed_s
            # The mean of the first seconds, then slowly: drops come within a second.
            constant_s = self._seen_s if self._seen_s <= _KNOWN_S else _FORGET_S
            weight = min(1.0, passed_s / constant_s)
            self._usual += weight * (sharp - self._usual)
            if share < 0.6 * self.parts_limit:  # not while drops gather; never with NaN
                quick = min(1.0, passed_s / min(self._seen_s, _FORGET_S))
                self._usual_share += quick * (share - self._usual_share)
            self._usual_energy += weight * np.where(lost, 0, energy - self._usual_energy)
        return sharp, share

    def _strong(self, wide: Float32Array) -> BoolArray:
        """Parts with edges: the better half of those inside the circle."""
        least = max(float(np.median(wide[self._region])), _WEAK)
        return np.asarray(self._region & (wide >= least))

    def _lost(self, energy: Float32Array, sharp: float) -> tuple[float, BoolArray]:
        """Share of the parts with edges that are blurred more than the picture, and where."""
        usual_fine, usual_wide = self._usual_energy
        usual_part = usual_fine / np.maximum(usual_wide, 1e-6)
        judged = self._strong(usual_wide) & (usual_part >= _SHARP)
        judged &= usual_fine >= _ABOVE_NOISE * self._noise
        if self._seen_s < _KNOWN_S or judged.sum() < _FEW:
            return float("nan"), np.zeros(GRID, np.bool_)
        whole = min(1.0, max(sharp - 1.0, 0.0) / max(self._usual - 1.0, 1e-3))
        blurred = energy[0] / np.maximum(energy[1], 1e-6) - 1.0 < _PART_SHARP * whole * (
            usual_part - 1.0
        )
        left = energy[0] / np.maximum(usual_fine, 1e-6)
        # Where the camera sways, some parts gain the edges that others lose.
        gained = judged & (left > 1.0 / _PART_LEFT)
        left = left / min(1.0, max(float(np.median(left[judged])), 1e-6))
        lost = judged & blurred & (left < _PART_LEFT)
        share = (float(lost.sum()) - float(gained.sum())) / float(judged.sum())
        return max(share, 0.0), lost

    def _measure(self, lines: ImageArray, passed_s: float) -> None:
        """Updates the energies of slopes."""
        few = np.asarray(lines[:: max(1, lines.shape[0] // _ROWS)])
        slopes = [_slopes(few, kernel) for kernel in _KERNELS]
        if self._before:
            pairs = zip(slopes, self._before, strict=True)
            energy = np.stack([_common_energy(now, before) for now, before in pairs])
            noise = float(cv2.norm(slopes[0], cv2.NORM_L2SQR)) / slopes[0].size - energy[0].mean()
            self._noise += _SMOOTH * (noise / self._region.mean() - self._noise)
            for mean, time_s in ((self._energy, _SMOOTH_S), (self._parts, _PARTS_SMOOTH_S)):
                first = self._pictures == 1
                mean += np.float32(1.0 if first else 1.0 - np.exp(-passed_s / time_s)) * (
                    energy - mean
                )
        self._before = slopes
        self._pictures += 1


def _slopes(lines: ImageArray, kernel: Float32Array) -> Float32Array:
    smooth = cv2.sepFilter2D(lines, cv2.CV_32F, kernel, _ONE)
    return np.asarray(smooth[:, 2:] - smooth[:, :-2], np.float32)


def _common_energy(now: Float32Array, before: Float32Array) -> Float32Array:
    """Covariance of the slopes of two pictures in every part [20, 32]; even shading has none."""
    tall, wide = now.shape[0] // GRID[0], now.shape[1] // GRID[1]
    cut = (slice(tall * GRID[0]), slice(wide * GRID[1]))
    now, before = now[cut], before[cut]
    means = [_mean_of_parts(part) for part in (now, before, now * before)]
    return means[2] - means[0] * means[1]


def _mean_of_parts(values: Float32Array) -> Float32Array:
    return np.asarray(cv2.resize(values, GRID[::-1], interpolation=cv2.INTER_AREA), np.float32)
