"""Whether the picture still shows the structures that it showed before.

The reduced picture is cut into tiles. Each tile remembers two looks of its own (a street and the
van that parks on it, a day and a night), compared by correlation: brightness and contrast do not
matter. A look is kept up to date only while it is recognised.
"""

from __future__ import annotations

import cv2
import numpy as np

from bikeped.monitor.reduced_picture import tiles
from bikeped.types import BoolArray, Float32Array, ImageArray

_STRUCTURE = 1.2  #: grey levels of deviation within a tile, from which it can be recognised
_RECOGNISED = 0.4  #: correlation with a remembered look
_VANISHED = 0.15  #: of the remembered deviation, below which a likeness is that of a fading echo
_BLANK = 0.4  #: of the remembered deviation: what is there now has no structure
_KNOWN_S = 2.0  #: a look counts when it has been seen for so long
_FORGET_S = 15.0  #: time constant with which a recognised look follows the scene
_NEW_LOOK_S = 60.0  #: something else with structure is a second look after this time,
_NEW_LOOK_COVERED_S = 600.0  #: and after this one while the picture counts as covered
_SMOOTH_S = 0.4  #: time constant of the picture that is compared: takes off noise
#: A tile without structure has changed when its brightness, in proportion to that of the tiles
#: that are recognised, is off by so many grey levels and by this share.
_CHANGED, _CHANGED_SHARE = 25.0, 0.3
#: An even patch (within so many grey levels) hides the scene when it covers so much of the picture,
#: and hides this share of the known structures, or has another brightness over this share of the
#: picture.
_PATCH_LEVELS, _PATCH_AREA, _PATCH_STRUCTURES, _PATCH_CHANGED = 15.0, 0.38, 0.12, 0.3
_FEW = 8  #: tiles with structure, below which nothing can be said


class KnownScene:
    """Compares pictures of one size with what they showed before."""

    def __init__(self, coarse: ImageArray, region: BoolArray) -> None:
        """`coarse` [8 m, 8 n] as in `Reduced`; `region` [m, n]: the tiles that count."""
        self._region = region
        self._smooth = coarse.astype(np.float32)
        look, deviation = self._look()
        self._looks = np.stack([look, np.zeros_like(look)])
        self._deviations = np.stack([deviation, np.zeros_like(deviation)])
        self._seen_s = np.zeros(self._deviations.shape, np.float32)
        self._lost_s = np.zeros(deviation.shape, np.float32)
        self._means = tiles(self._smooth).mean(axis=-1)

    def _look(self) -> tuple[Float32Array, Float32Array]:
        """Structures of a few pixels [m, n, 64] around zero, and their deviation [m, n]."""
        fine = cv2.GaussianBlur(self._smooth, (0, 0), 1.5)
        band = tiles(np.asarray(fine - cv2.GaussianBlur(self._smooth, (0, 0), 4.0), np.float32))
        band = band - band.mean(axis=-1, keepdims=True)
        return band, np.sqrt(np.square(band).mean(axis=-1))

    def update(self, coarse: ImageArray, passed_s: float, covered: bool, learn: bool) -> float:
        """How much of the scene is hidden: 0.5 is half of the known structures.

        Those hidden by something blank count half as much again; an even patch over 38 % of the
        picture counts as half of them.
        `passed_s` since the last picture; `covered`: the picture counts as covered already;
        `learn`: nothing is wrong with it. NaN where too little is known.
        """
        weight = 1.0 - np.exp(-passed_s / _SMOOTH_S)
        self._smooth += np.float32(weight) * (coarse - self._smooth)
        look, deviation = self._look()
        scale = np.maximum(self._deviations * deviation, 1e-6)
        likeness = (self._looks * look).mean(axis=-1) / scale
        likeness[deviation < _VANISHED * self._deviations] = 0.0
        likeness[(self._deviations < _STRUCTURE) & (deviation < _STRUCTURE)] = 1.0
        best = np.where(self._seen_s[1] > 0, likeness.argmax(axis=0), 0)
        found = np.take_along_axis(likeness, best[None], axis=0)[0] >= _RECOGNISED
        known = self._seen_s[0] >= _KNOWN_S
        judged = known & (self._deviations[0] >= _STRUCTURE) & self._region
        lost = judged & ~found
        blank = lost & (deviation < _BLANK * self._deviations[0])
        means = tiles(self._smooth).mean(axis=-1)
        seen = judged & found
        gain = np.median(means[seen] / np.maximum(self._means[seen], 1.0)) if seen.any() else 1.0
        usual = np.maximum(gain * self._means, 1.0)
        off = np.abs(means - usual) > np.maximum(_CHANGED, _CHANGED_SHARE * usual)
        flat = known & ~judged & self._region & (deviation < _STRUCTURE)
        hidden = blank | (flat & off)
        self._lost_s = np.where(found & ~off, 0.0, self._lost_s + passed_s).astype(np.float32)
        patience_s = _NEW_LOOK_COVERED_S if covered else _NEW_LOOK_S
        self._adopt(look, deviation, 0, ~known & ~found)
        if learn or covered:
            strange = known & ~found & (deviation >= _STRUCTURE) & (self._lost_s > patience_s)
            self._adopt(look, deviation, 1, strange)
        if learn or covered:
            keep = off & known & (self._lost_s < patience_s)
            weights = np.where(keep, 0.0, min(1.0, passed_s / _FORGET_S)).astype(np.float32)
            self._means += weights * (means - self._means)
        if learn:
            for slot in (0, 1):
                self._follow(look, slot, found & (best == slot), passed_s)
        if judged.sum() < _FEW:
            return float("nan")
        share = (lost.sum() + 0.5 * blank.sum()) / judged.sum()
        return float(max(share, self._patch(hidden, blank, deviation, means, int(judged.sum()))))

    def _patch(
        self,
        hidden: BoolArray,
        blank: BoolArray,
        deviation: Float32Array,
        means: Float32Array,
        judged: int,
    ) -> float:
        """As `update`, of the largest even patch that hides something."""
        if not hidden.any():
            return 0.0
        level = np.median(means[hidden])
        even = self._region & (deviation < _STRUCTURE) & (np.abs(means - level) < _PATCH_LEVELS)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(even.astype(np.uint8))
        if len(stats) < 2:
            return 0.0
        patch = labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
        area = patch.sum() / self._region.sum() / _PATCH_AREA
        lost = (patch & blank).sum() / judged / _PATCH_STRUCTURES
        changed = (patch & hidden).sum() / self._region.sum() / _PATCH_CHANGED
        return 0.5 * float(min(area, max(lost, changed)))

    def _adopt(
        self, look: Float32Array, deviation: Float32Array, slot: int, where: BoolArray
    ) -> None:
        """Begins a look anew in some tiles."""
        self._looks[slot][where] = look[where]
        self._deviations[slot][where] = deviation[where]
        self._seen_s[slot][where] = _KNOWN_S if slot else 0.0

    def _follow(self, look: Float32Array, slot: int, where: BoolArray, passed_s: float) -> None:
        """Keeps a recognised look up to date: its mean at first, then a slow one."""
        seen_s = self._seen_s[slot] + passed_s
        weight = np.where(where, passed_s / np.minimum(seen_s, _FORGET_S), 0.0)
        self._looks[slot] += weight[..., None].astype(np.float32) * (look - self._looks[slot])
        self._deviations[slot] = np.sqrt(np.square(self._looks[slot]).mean(axis=-1))
        self._seen_s[slot] = np.where(where, seen_s, self._seen_s[slot])
