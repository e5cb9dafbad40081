"""Whether the picture can be trusted: frozen, of one colour, covered, blurred, sprayed."""

from __future__ import annotations

import math
from functools import lru_cache

import cv2
import numpy as np

from bikeped.monitor.known_scene import KnownScene
from bikeped.monitor.reduced_picture import (
    Circle,
    Reduced,
    inside,
    reduce,
    tile_grid,
    tiles,
    usable,
)
from bikeped.monitor.repeated_pictures import RepeatedPictures
from bikeped.monitor.sharpness import Sharpness
from bikeped.monitor.verdicts import Hold, Verdict
from bikeped.types import BoolArray, Float32Array, ImageArray

_EVERY_S = 0.2  #: all but repeated pictures is judged this often
_JUMP_S = 5.0  #: a longer gap begins the holds anew
_FROZEN_S = 1.2
_FLAT = (
    3.0,
    8.0,
)  #: grey levels between the tiles of a dark, and of another, picture of one colour
_FLAT_PART = 4.0  #: the same, where much of the picture is black
_DARK, _BRIGHT, _BORDER = 20.0, 235.0, 8.0
_LOST = 0.45  #: of the known structures (`KnownScene`)
_BLURRED = 1.25  #: sharpness (`Sharpness`) that is too little at any site
_BLURRED_SHARE = 0.4  #: of the site's own above 1
_UNDEREXPOSED = 25.0  #: grey levels of the brightest tenth
_CLIPPED, _OVEREXPOSED = 250.0, 0.35  #: grey levels, and the share of the picture above them
_CODES = (
    "black",
    "white",
    "one_colour",
    "covered",
    "blurred",
    "spray",
    "underexposed",
    "overexposed",
)


class PictureHealth:
    """Judges the pictures of one camera, one after the other.

    `circle`: centre u, v and radius of the image circle as shares of the picture's width, height
    and width; None for a lens that fills the picture.
    """

    def __init__(self, circle: Circle | None = None) -> None:
        self._circle = circle
        self._restart(())

    def _restart(self, shape: tuple[int, ...]) -> None:
        """Begins anew, for pictures of this shape: nothing is known of their scene."""
        self._shape = shape
        self._time_s = self._judged_s = math.nan
        self._repeated = RepeatedPictures()
        self._sharpness = Sharpness(self._circle, shape[1] / shape[0] if shape else 1.0)
        self._scene: KnownScene | None = None
        holds = (
            Hold("picture.frozen", 0.0, "The picture does not change."),
            Hold("picture.black", 0.5, "The picture is black."),
            Hold("picture.white", 0.5, "The picture is white."),
            Hold("picture.one_colour", 0.5, "The picture has one colour."),
            Hold(
                "picture.covered", 2.0, "What the picture showed is hidden, or the camera turned."
            ),
            Hold("picture.blurred", 2.5, "The picture is blurred."),
            Hold("picture.spray", 4.5, "Parts of the picture are blurred: drops or dirt."),
            Hold("picture.underexposed", 5.0, "The picture is very dark."),
            Hold("picture.overexposed", 5.0, "Much of the picture is overexposed."),
        )
        self._holds = holds
        self._verdicts = tuple(hold.update(math.nan, math.inf, 0.0) for hold in holds)

    def update(self, rgb: ImageArray, time_s: float) -> tuple[Verdict, ...]:
        """The verdicts, always in the same order, with the picture [h, w, 3] uint8 at `time_s`.

        `time_s` is media time. One that is not finite or repeats, or a picture smaller than 48
        pixels, changes nothing; one that runs backwards, or a picture of another shape, begins
        anew.
        """
        if not math.isfinite(time_s) or not usable(rgb) or time_s == self._time_s:
            return self._verdicts
        if rgb.shape != self._shape or time_s < self._time_s:
            self._restart(rgb.shape)
        elif time_s - self._time_s > _JUMP_S:
            for hold in self._holds:
                hold.restart()
            self._repeated = RepeatedPictures()
            self._judged_s = math.nan
        self._time_s = time_s
        reduced = lru_cache(maxsize=1)(lambda: reduce(rgb))  # once, for both checks
        still_s = self._repeated.update(rgb, time_s, reduced)
        frozen = self._holds[0].update(still_s, _FROZEN_S, time_s)
        rest = self._verdicts[1:]
        if not time_s - self._judged_s < _EVERY_S * 0.99:
            passed_s = _EVERY_S if math.isnan(self._judged_s) else time_s - self._judged_s
            self._judged_s = time_s
            rest = self._judge(reduced(), passed_s, still_s)
        self._verdicts = (frozen, *rest)
        return self._verdicts

    def _judge(self, picture: Reduced, passed_s: float, still_s: float) -> tuple[Verdict, ...]:
        """All verdicts but `picture.frozen`."""
        height, width = self._shape[:2]
        grid = tile_grid(height, width)
        region = inside(*grid, self._circle, width / height)
        if self._scene is None:
            self._scene = KnownScene(picture.coarse, region)
        levels = tiles(picture.coarse.astype(np.float32))
        grid_means = levels.mean(axis=-1)
        lit = _lit(grid_means, region)
        means = grid_means[lit]
        levels = levels[region]
        low, middle, high = np.quantile(means, (0.01, 0.5, 0.99)).tolist()
        spread = high - low
        flat = _FLAT[0] if middle < _DARK else _FLAT[1]
        if lit.sum() < region.sum():  # a part of a picture is more even than a whole one
            flat = min(flat, _FLAT_PART)
        # As a share, so that larger is worse: 1 is as even as a picture of one colour.
        even = flat / max(spread, 0.01)
        before = {v.code: v for v in self._verdicts}
        # Never learn a fault as usual. Spray alone may build up to its own limit.
        wrong = even >= 1.0 or still_s > _FROZEN_S / 2
        for code in ("black", "white", "one_colour", "covered", "blurred", "spray"):
            verdict = before[f"picture.{code}"]
            wrong = wrong or verdict.active or (verdict.beyond and code != "spray")
        covered = before["picture.covered"]
        lost = self._scene.update(
            picture.coarse, passed_s, covered.active or covered.beyond, not wrong
        )
        usual = self._sharpness.usual
        sharp, sprayed = self._sharpness.update(picture.lines, passed_s, not wrong)
        blurred = (
            _BLURRED if math.isnan(usual) else max(_BLURRED, 1.0 + _BLURRED_SHARE * (usual - 1.0))
        )
        # A flat picture has no sharpness of its own to be judged by.
        flatness = math.nan if even >= 1.0 else 1.0
        values = {
            "black": (even if middle < _DARK else 0.0, 1.0),
            "white": (even if middle > _BRIGHT else 0.0, 1.0),
            "one_colour": (even if _DARK <= middle <= _BRIGHT else 0.0, 1.0),
            "covered": (lost, _LOST),
            "blurred": (blurred / max(sharp, 0.01) * flatness, 1.0),
            "spray": (sprayed * flatness, self._sharpness.parts_limit),
            "underexposed": (_UNDEREXPOSED / max(float(np.quantile(means, 0.9)), 0.1), 1.0),
            "overexposed": (float((levels > _CLIPPED).mean()), _OVEREXPOSED),
        }
        return tuple(
            hold.update(*values[code], self._time_s)
            for code, hold in zip(_CODES, self._holds[1:], strict=True)
        )


def _lit(means: Float32Array, region: BoolArray) -> BoolArray:
    """The tiles [m, n] of `region` without the black around an image circle or a letter box."""
    bright = (means > _BORDER).astype(np.uint8)
    # One tile further in: those on the edge are part black.
    square = np.ones((3, 3), np.uint8)
    within = cv2.erode(bright, square, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,))
    lit = region & (within > 0)
    return lit if lit.sum() > 0.1 * region.sum() else region
