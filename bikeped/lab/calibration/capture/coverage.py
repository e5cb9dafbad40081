"""Which parts of the image circle the boards have covered, and what to photograph next, in words.

The circle is cut into a middle and rings of sectors, each about twenty degrees wide: a lens is only
known where corners were seen, and the rim is where people forget to hold the board.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bikeped.geometry import Lens
from bikeped.lab.calibration.board_view import BoardView
from bikeped.types import BoolArray, FloatArray

#: A part is covered by so many corners, from at least so many pictures.
WANTED_CORNERS, WANTED_PICTURES = 12, 2
_RING_DEG = 20.0
_SECTORS = 8
_WAYS = (
    "right",
    "lower right",
    "bottom",
    "lower left",
    "left",
    "upper left",
    "top",
    "upper right",
)
_EXISTS = 0.4  # of a part must lie on the picture


@dataclass(frozen=True)
class Part:
    """One part of the circle: angles from the axis and round it (clockwise from right), radians."""

    from_rad: float
    to_rad: float
    start_rad: float
    stop_rad: float
    where: str  #: `the middle`, `upper left, near the rim`
    corners: int = 0
    pictures: int = 0

    @property
    def covered(self) -> bool:
        return self.corners >= WANTED_CORNERS and self.pictures >= WANTED_PICTURES

    @property
    def missing(self) -> float:
        """1 where nothing was seen, 0 where it is covered."""
        return 1 - min(self.corners / WANTED_CORNERS, self.pictures / WANTED_PICTURES, 1.0)


@dataclass(frozen=True)
class Coverage:
    """All parts of the circle that lie on the picture."""

    parts: Sequence[Part]

    @property
    def share(self) -> float:
        """Share of the parts that are covered."""
        return sum(part.covered for part in self.parts) / max(len(self.parts), 1)

    @property
    def gaps(self) -> list[Part]:
        """Parts that are not covered, those to photograph first at the start: the emptiest, and of
        these the ones next to the rim."""
        open_parts = [part for part in self.parts if not part.covered]
        return sorted(open_parts, key=lambda part: (-part.missing, -part.to_rad))

    def advice(self, most: int = 4) -> list[str]:
        """What to photograph next, at most so many lines, for the person with the board."""
        return [_advice(part) for part in self.gaps[:most]]


def cover(
    views: Iterable[BoardView],
    lens: Lens,
    centre_px: tuple[float, float],
    window_px: tuple[float, float, float, float],
) -> Coverage:
    """The coverage by `views` of what a lens shows; all in the views' pixels.

    `lens.max_theta_rad` is half the field of view; `window_px` (u0, v0, u1, v1) is what exists of
    the picture. A lens that is only about right serves as well.
    """
    parts = empty_parts(lens, centre_px, window_px)
    corners, pictures = np.zeros(len(parts), np.int64), np.zeros(len(parts), np.int64)
    for view in views:
        offset = view.uv_px - np.array(centre_px)
        theta = lens.theta(np.hypot(offset[:, 0], offset[:, 1]))
        phi = np.arctan2(offset[:, 1], offset[:, 0])
        for number, part in enumerate(parts):
            count = int(inside(part, theta, phi).sum())
            corners[number] += count
            pictures[number] += count > 0
    return Coverage(
        [
            Part(p.from_rad, p.to_rad, p.start_rad, p.stop_rad, p.where, int(c), int(n))
            for p, c, n in zip(parts, corners, pictures, strict=True)
        ]
    )


def inside(part: Part, theta: FloatArray, phi: FloatArray) -> BoolArray:
    """Which directions lie in a part."""
    width = part.stop_rad - part.start_rad
    turned = np.mod(phi - part.start_rad, 2 * math.pi)
    with np.errstate(invalid="ignore"):
        ring = (theta >= part.from_rad) & (theta < part.to_rad)
    return np.asarray(ring & (turned < width))


def empty_parts(
    lens: Lens, centre_px: tuple[float, float], window_px: tuple[float, float, float, float]
) -> list[Part]:
    """The parts of the circle that lie on the picture, nothing seen in any."""
    half = lens.max_theta_rad
    rings = max(2, round(math.degrees(half) / _RING_DEG))
    edges = np.linspace(0, half, rings + 1)
    parts = [Part(0.0, float(edges[1]), 0.0, 2 * math.pi, "the middle")]
    step = 2 * math.pi / _SECTORS
    for ring in range(1, rings):
        for sector, way in enumerate(_WAYS):
            start = (sector - 0.5) * step
            where = f"{way}, {_depth(ring, rings)}"
            parts.append(
                Part(float(edges[ring]), float(edges[ring + 1]), start, start + step, where)
            )
    return [part for part in parts if _on_picture(part, lens, centre_px, window_px) > _EXISTS]


def _depth(ring: int, rings: int) -> str:
    if ring == rings - 1:
        return "at the rim"
    if ring == rings - 2 and rings > 3:
        return "near the rim"
    return "beside the middle" if ring == 1 else "half-way out"


def _on_picture(
    part: Part,
    lens: Lens,
    centre_px: tuple[float, float],
    window_px: tuple[float, float, float, float],
) -> float:
    share = (np.arange(8) + 0.5) / 8
    theta, phi = np.meshgrid(
        part.from_rad + share * (part.to_rad - part.from_rad),
        part.start_rad + share * (part.stop_rad - part.start_rad),
    )
    radius = lens.radius(theta)
    u, v = centre_px[0] + radius * np.cos(phi), centre_px[1] + radius * np.sin(phi)
    u0, v0, u1, v1 = window_px
    return float(np.mean((u >= u0) & (u < u1) & (v >= v0) & (v < v1)))


def _advice(part: Part) -> str:
    low, high = math.degrees(part.from_rad), math.degrees(part.to_rad)
    seen = "no corner yet"
    if part.corners:
        seen = f"{_count(part.corners, 'corner')} in {_count(part.pictures, 'picture')}"
    how = "close, and turned toward the lens" if high > 60 else "tilted by some 30 degrees"
    return (
        f"{part.where} ({low:.0f} to {high:.0f} degrees from the axis): {seen}; hold the board "
        f"there, {how}"
    )


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
