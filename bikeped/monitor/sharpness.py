"""How sharp the picture is, as a whole and in its parts.

Sharpness is the energy of slopes along the rows after a narrow smoothing over that after one twice
as wide: about 2 for a sharp picture, 1 for a blurred one, whatever its brightness and contrast.
The energy of noise, known from the change since the last picture, is taken off both.
"""

from __future__ import annotations

import cv2
import numpy as np

from bikeped.monitor.reduced_picture import inside
from bikeped.monitor.reduced_picture import Circle
from bikeped.types import BoolArray, Float32Array, ImageArray

GRID = (15, 20)  #: rows and columns of parts
_SIGMAS = (1.0, 2.0)  #: pixels of `Reduced.lines`
_SMOOTH_S = 0.6
_WEAK = 0.05  #: squared grey levels a pixel: without slopes nothing can be said
_SHARP = 1.3  #: a part that has been sharper than this can be seen to lose it
_PART_LOST = 0.45  #: of a part's usual sharpness, in proportion to the whole picture's
_FEW = 8
_KNOWN_S = 2.0
_FORGET_S = 60.0
_KERNELS = [cv2.getGaussianKernel(2 * int(3 * s) + 1, s).astype(np.float32) for s in _SIGMAS]
_ONE = np.ones(1, np.float32)


class Sharpness:
    """Follows the sharpness of pictures of one size."""

    def __init__(self, circle: Circle | None, aspect: float) -> None:
        self._region: BoolArray = inside(*GRID, circle, aspect)
        self._before: list[Float32Array] = []
        self._energy = np.zeros((2, *GRID), np.float32)
        self._noise = np.zeros(2, np.float32)
        self._pictures = 0
        self._seen_s = 0.0
        self._part_seen_s = np.zeros(GRID, np.float32)
        self._usual = 1.0
        self._usual_part = np.ones(GRID, np.float32)

    @property
    def usual(self) -> float:
        """The site's own sharpness; NaN before it is known."""
        return self._usual if self._seen_s >= _KNOWN_S else float("nan")

    def update(self, lines: ImageArray, passed_s: float, learn: bool) -> tuple[float, float]:
        """Sharpness of the whole picture, and the share of its parts that lost theirs; or NaN.

        `learn`: nothing is wrong with the picture.
        """
        self._measure(lines, passed_s)
        noise = self._noise[:, None, None]
        fine, wide = np.maximum(self._energy - noise, 0.0)
        wide_in = wide[self._region]
        strong = self._region & (wide >= max(float(np.median(wide_in)), float(self._noise[1]), _WEAK))
        if strong.sum() < 2 or self._pictures < 2:
            return float("nan"), float("nan")
        sharp = float(fine[strong].sum() / wide[strong].sum())
        part = fine / np.maximum(wide, 1e-6)
        judged = strong & (self._usual_part >= _SHARP) & (self._part_seen_s >= _KNOWN_S)
        whole = min(1.0, max(sharp - 1.0, 0.0) / max(self._usual - 1.0, 1e-3))
        lost = judged & (part - 1.0 < _PART_LOST * whole * (self._usual_part - 1.0))
        if learn:
            self._seen_s += passed_s
            self._usual += passed_s / min(self._seen_s, _FORGET_S) * (sharp - self._usual)
            self._part_seen_s += np.where(strong & ~lost, np.float32(passed_s), np.float32(0))
            weight = passed_s / np.clip(self._part_seen_s, passed_s, _FORGET_S)
            weight = np.where(strong & ~lost, weight, 0).astype(np.float32)
            self._usual_part += weight * (part - self._usual_part)
        share = float(lost.sum() / judged.sum()) if judged.sum() >= _FEW else float("nan")
        return sharp, share

    def _measure(self, lines: ImageArray, passed_s: float) -> None:
        """Updates the energies of slopes and of noise."""
        slopes = [_slopes(lines, kernel) for kernel in _KERNELS]
        energy = np.stack([_energy(slope) for slope in slopes])
        weight = np.float32(1.0 - np.exp(-passed_s / _SMOOTH_S)) if self._pictures else np.float32(1)
        self._energy += weight * (energy - self._energy)
        if self._before:
            change = [_energy(now - old) for now, old in zip(slopes, self._before, strict=True)]
            noise = np.array([0.5 * np.median(part[self._region]) for part in change], np.float32)
            self._noise += weight * (noise - self._noise)
        self._before = slopes
        self._pictures += 1


def _slopes(lines: ImageArray, kernel: Float32Array) -> Float32Array:
    smooth = cv2.sepFilter2D(lines, cv2.CV_32F, kernel, _ONE)
    return np.asarray(smooth[:, 2:] - smooth[:, :-2], np.float32)


def _energy(slopes: Float32Array) -> Float32Array:
    """Variance of the slopes in every part [15, 20]: an even shading has none."""
    size = GRID[::-1]
    mean = cv2.resize(slopes, size, interpolation=cv2.INTER_AREA)
    square = cv2.resize(np.square(slopes), size, interpolation=cv2.INTER_AREA)
    return np.asarray(square - np.square(mean), np.float32)
