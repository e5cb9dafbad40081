"""Coverage of the image circle by the boards, and advice on what to photograph next.

The circle is divided into a middle and rings of sectors, each about twenty degrees wide: a lens is
only known where corners were observed, and boards at the rim are the ones most often missing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bikeped.geometry.lens import Lens
from bikeped.lab.calibration.board_view import BoardView
from bikeped.types import FloatArray, IntArray

#: A sector is covered by so many corners, from at least so many images.
WANTED_CORNERS, WANTED_IMAGES = 12, 2
_RING_DEG = 20.0
#: Around the axis, clockwise from the right.
_DIRECTIONS = (
    *("right", "lower right", "bottom", "lower left"),
    *("left", "upper left", "top", "upper right"),
)
_EXISTS = 0.4  # of a sector must lie on the image


@dataclass(frozen=True)
class CircleSector:
    """One part of the circle: angles from and around the axis (clockwise from right), radians."""

    from_rad: float
    to_rad: float
    start_rad: float
    stop_rad: float
    where: str  #: `the middle`, `upper left, near the rim`
    corners: int = 0
    images: int = 0

    @property
    def covered(self) -> bool:
        return self.corners >= WANTED_CORNERS and self.images >= WANTED_IMAGES

    @property
    def missing(self) -> float:
        """1 without any corner, 0 where it is covered."""
        return 1 - min(self.corners / WANTED_CORNERS, self.images / WANTED_IMAGES, 1.0)

    def advice(self) -> str:
        """What to photograph here, in one line."""
        low, high = math.degrees(self.from_rad), math.degrees(self.to_rad)
        known = "no corner yet"
        if self.corners:
            known = f"{_count(self.corners, 'corner')} in {_count(self.images, 'picture')}"
        how = "close, and turned toward the lens" if high > 60 else "tilted by some 30 degrees"
        return (
            f"{self.where} ({low:.0f} to {high:.0f} degrees from the axis): {known}; hold the "
            f"board there, {how}"
        )


@dataclass(frozen=True)
class Coverage:
    """All sectors of the circle that lie on the image."""

    sectors: Sequence[CircleSector]

    @property
    def share(self) -> float:
        """Share of the sectors that are covered."""
        return sum(sector.covered for sector in self.sectors) / max(len(self.sectors), 1)

    @property
    def gaps(self) -> list[CircleSector]:
        """Sectors that are not covered: the emptiest first, of these those at the rim."""
        gaps = [sector for sector in self.sectors if not sector.covered]
        return sorted(gaps, key=lambda sector: (-sector.missing, -sector.to_rad))

    def advice(self, most: int = 4) -> list[str]:
        """What to photograph next, at most so many lines."""
        return [sector.advice() for sector in self.gaps[:most]]


def measure_coverage(
    views: Iterable[BoardView],
    lens: Lens,
    centre_px: tuple[float, float],
    window_px: tuple[float, float, float, float],
) -> Coverage:
    """The coverage by `views` of what a lens shows; all in the views' pixels.

    `lens.max_theta_rad` is half the field of view; `window_px` (u0, v0, u1, v1) is the part of the
    image that exists. An approximate lens will do.
    """
    sectors = circle_sectors(lens, centre_px, window_px)
    counts = [corner_counts(sectors, view.uv_px, lens, centre_px) for view in views]
    found = np.array(counts, np.int64).reshape(-1, len(sectors))
    corners, images = found.sum(0), (found > 0).sum(0)
    return Coverage(
        [
            replace(sector, corners=int(c), images=int(n))
            for sector, c, n in zip(sectors, corners, images, strict=True)
        ]
    )


def corner_counts(
    sectors: Sequence[CircleSector], uv_px: FloatArray, lens: Lens, centre_px: tuple[float, float]
) -> IntArray:
    """[sectors] how many of the corners `uv_px` [n, 2] lie in each sector."""
    offset = uv_px - np.array(centre_px)
    theta = lens.theta(np.hypot(offset[:, 0], offset[:, 1]))
    phi = np.arctan2(offset[:, 1], offset[:, 0])
    bounds = [(s.from_rad, s.to_rad, s.start_rad, s.stop_rad) for s in sectors]
    low, high, start, stop = np.array(bounds).reshape(-1, 4).T[..., None]
    with np.errstate(invalid="ignore"):
        ring = (theta >= low) & (theta < high)
    return np.asarray((ring & (np.mod(phi - start, 2 * math.pi) < stop - start)).sum(1))


def circle_sectors(
    lens: Lens, centre_px: tuple[float, float], window_px: tuple[float, float, float, float]
) -> list[CircleSector]:
    """The sectors of the circle that lie on the image, without corners."""
    half = lens.max_theta_rad
    rings = max(2, round(math.degrees(half) / _RING_DEG))
    edges = [float(edge) for edge in np.linspace(0, half, rings + 1)]
    depths = ["the middle", "beside the middle", *["half-way out"] * (rings - 4), "near the rim"]
    depths = [*depths[: rings - 1], "at the rim"]
    step = 2 * math.pi / len(_DIRECTIONS)
    sectors = [CircleSector(0.0, edges[1], 0.0, 2 * math.pi, depths[0])]
    for ring in range(1, rings):
        for number, direction in enumerate(_DIRECTIONS):
            start = (number - 0.5) * step
            where = f"{direction}, {depths[ring]}"
            sectors.append(CircleSector(edges[ring], edges[ring + 1], start, start + step, where))
    return [s for s in sectors if _share_on_image(s, lens, centre_px, window_px) > _EXISTS]


def _share_on_image(
    sector: CircleSector,
    lens: Lens,
    centre_px: tuple[float, float],
    window_px: tuple[float, float, float, float],
) -> float:
    share = (np.arange(8) + 0.5) / 8
    theta, phi = np.meshgrid(
        sector.from_rad + share * (sector.to_rad - sector.from_rad),
        sector.start_rad + share * (sector.stop_rad - sector.start_rad),
    )
    radius = lens.radius(theta)
    u, v = centre_px[0] + radius * np.cos(phi), centre_px[1] + radius * np.sin(phi)
    u0, v0, u1, v1 = window_px
    return float(np.mean((u >= u0) & (u < u1) & (v >= v0) & (v < v1)))


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
