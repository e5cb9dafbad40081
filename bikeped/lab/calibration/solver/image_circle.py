"""The image circle: how far from the optical centre a lens throws light."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from bikeped.types import FloatArray

_SECTORS = 180
#: Dark is below this share of what the middle of the pictures reaches.
_DARK_SHARE = 0.5
#: The rim must show in so many sectors, and dark outside it for so many pixels.
_FEWEST_SECTORS = 12
_DARK_PX = 4


def brightest(grays: Iterable[npt.NDArray[np.uint8]]) -> npt.NDArray[np.uint8]:
    """[h, w] each pixel's brightest value over the pictures: dark only where no light comes."""
    out: npt.NDArray[np.uint8] | None = None
    for gray in grays:
        out = gray.copy() if out is None else np.maximum(out, gray, out=out)
    if out is None:
        raise ValueError("brightest: no pictures")
    return out


def circle_radius_px(bright: npt.NDArray[np.uint8], centre_px: FloatArray) -> float | None:
    """Radius of the image circle about `centre_px`; None when the pictures do not show its rim.

    Along 180 directions the light is followed outwards to where it stays dark. Directions in which
    the picture ends first say nothing; the rim is the upper quartile of the others, for a dark
    object at the rim ends some directions early.
    """
    height, width = bright.shape
    level = float(np.percentile(bright, 90)) * _DARK_SHARE
    reach = int(np.hypot(width, height))
    step = np.arange(reach)
    rims = []
    for angle in np.arange(_SECTORS) * 2 * np.pi / _SECTORS:
        u = np.rint(centre_px[0] + step * np.cos(angle)).astype(np.int64)
        v = np.rint(centre_px[1] + step * np.sin(angle)).astype(np.int64)
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        lit = bright[v[inside], u[inside]] > level
        if not lit.any():
            continue
        last = int(np.flatnonzero(lit)[-1])
        if last + _DARK_PX < int(inside.sum()):
            rims.append(last + 0.5)
    if len(rims) < _FEWEST_SECTORS:
        return None
    return float(np.percentile(rims, 75))
