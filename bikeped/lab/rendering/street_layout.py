"""Layout of a street and its fixtures, by number. Pure.

The road runs along the world's x axis; layout 0 has a crosswalk at x = 5 and a side street to the
west, as the bundled scenarios have it. Widths, markings, colours, houses and furniture vary.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.lab.rendering.mesh import Rgb

CROSSING_X_M = 5.0


@dataclass(frozen=True)
class Fixture:
    """`what` (lamp, sign, tree, bin, hydrant, signal, bollard, car), place [x, y], the direction it
    faces, and a number for its shape and colours."""

    what: str
    xy_m: tuple[float, float]
    heading_rad: float
    number: int


@dataclass(frozen=True)
class House:
    """A block between two corners, `front` toward smaller y, with `floors` of windows."""

    x0: float
    x1: float
    front: float
    depth: float
    height: float
    wall: Rgb
    number: int


@dataclass(frozen=True)
class StreetLayout:
    """Everything static, metres in the world frame."""

    number: int
    kerb: float  #: the road reaches from -kerb to kerb
    walk: float  #: width of the sidewalks
    side_street: tuple[float, float] | None  #: x from, to
    crosswalk: tuple[float, float]
    crosswalk_style: str
    bike_lanes: bool
    green_lanes: bool
    lane_m: float  #: where the bicycle lane's inner line lies
    asphalt: Rgb
    paving: Rgb
    verge: Rgb
    slab_m: float
    yellow_centre: bool
    houses: tuple[House, ...]
    fixtures: tuple[Fixture, ...]


_WALLS: tuple[Rgb, ...] = (
    (168, 104, 84), (206, 192, 168), (150, 158, 166), (188, 150, 110), (128, 104, 96),
    (222, 214, 204), (142, 88, 72), (176, 180, 160), (196, 170, 140), (110, 116, 124),
)  # fmt: skip


_PAVINGS: tuple[Rgb, ...] = (
    (168.0, 164.0, 156.0), (150.0, 148.0, 146.0), (176.0, 150.0, 130.0), (188.0, 184.0, 176.0),
)  # fmt: skip
_VERGES: tuple[Rgb, ...] = (
    (104.0, 128.0, 74.0), (128.0, 126.0, 92.0), (158.0, 154.0, 148.0), (86.0, 110.0, 64.0),
)  # fmt: skip


def street_layout(number: int, clutter: int = 0) -> StreetLayout:
    """The layout of this number, always the same, with `clutter` more fixtures near the camera."""
    rng = np.random.default_rng((number, 5))
    plain = number == 0
    kerb = 6.1 if plain else float(rng.uniform(4.9, 8.0))
    walk = 4.0 if plain else float(rng.uniform(2.6, 5.0))
    side = (-7.6, -1.2) if plain or rng.random() < 0.6 else None
    if side is not None and not plain:
        middle, half = float(rng.uniform(-18, -6)), float(rng.uniform(2.8, 4.2))
        middle = middle if rng.random() < 0.6 else 10 - middle
        side = (middle - half, middle + half)
    half_walk = 1.7 if plain else float(rng.uniform(1.3, 2.2))
    cross = CROSSING_X_M + (0.0 if plain else float(rng.uniform(-6, 6)))
    grey = float(rng.uniform(-16, 14)) if not plain else 0.0
    asphalt = (98 + grey, 100 + grey, 104 + grey)
    paving = _PAVINGS[0 if plain else int(rng.integers(4))]
    verge = _VERGES[0 if plain else int(rng.integers(4))]
    return StreetLayout(
        number=number,
        kerb=kerb,
        walk=walk,
        side_street=side,
        crosswalk=(cross - half_walk, cross + half_walk),
        crosswalk_style="bars" if plain else str(rng.choice(["bars", "ladder", "lines", "worn"])),
        bike_lanes=plain or bool(rng.random() < 0.7),
        green_lanes=plain or bool(rng.random() < 0.4),
        lane_m=2.2 if plain else float(rng.uniform(0.36, 0.42)) * kerb,
        asphalt=asphalt,
        paving=paving,
        verge=verge,
        slab_m=0.9 if plain else float(rng.choice([0.5, 0.75, 1.2, 1.5])),
        yellow_centre=plain or bool(rng.random() < 0.5),
        houses=_houses(rng, kerb + walk, side),
        fixtures=_fixtures(rng, plain, kerb, walk, side, cross) + _clutter(number, clutter, kerb),
    )


def _houses(
    rng: np.random.Generator, edge: float, side: tuple[float, float] | None
) -> tuple[House, ...]:
    """A row north of the street, and one south behind the camera far to both sides."""
    houses = []
    setback = float(rng.uniform(0.5, 6.0))
    low = float(rng.uniform(4.5, 8.0))
    for row in ("north", "south"):
        x = -95.0
        while x < 105.0:
            wide = float(rng.uniform(7, 16))
            tall = low + float(rng.uniform(0, 10))
            gap = 0.0 if rng.random() < 0.7 else float(rng.uniform(2, 6))
            wall = _WALLS[int(rng.integers(len(_WALLS)))]
            if side is not None and x < side[1] + 2.5 and x + wide > side[0] - 2.5:
                if x < side[0] - 2.5 - 4:
                    wide = side[0] - 2.5 - x
                else:
                    x = side[1] + 2.5
                    continue
            front = edge + setback + float(rng.uniform(0, 0.8))
            number = int(rng.integers(1 << 20))
            if row == "north":
                houses.append(House(x, x + wide, front, 10.0, tall, wall, number))
            elif x > 30 or x + wide < -20:
                houses.append(House(x, x + wide, -front - 14.0, 8.0, tall, wall, number))
            x += wide + gap
    return tuple(houses)


def _fixtures(
    rng: np.random.Generator,
    plain: bool,
    kerb: float,
    walk: float,
    side: tuple[float, float] | None,
    cross: float,
) -> tuple[Fixture, ...]:
    """Lamps, trees, signs, bins and parked cars."""
    out: list[Fixture] = []

    def put(what: str, x: float, y: float, heading: float = 0.0) -> None:
        if side is not None and side[0] - 1.0 < x < side[1] + 1.0 and abs(y) < 40:
            return
        out.append(Fixture(what, (x, y), heading, int(rng.integers(1 << 20))))

    for x in np.arange(-40, 50, float(rng.uniform(14, 22))).tolist():
        put("lamp", x + 9.5, kerb + 0.6, -np.pi / 2)
    trees = 9.0 if plain else float(rng.uniform(6, 26))
    for x in np.arange(-60, 70, trees).tolist():
        x += float(rng.uniform(-1.5, 1.5)) + 2.0
        if abs(x - cross) > 3.2:
            put("tree", x, kerb + walk - 0.5)
    put("signal", cross + 2.9, kerb + 0.5, -np.pi / 2)
    if plain or rng.random() < 0.6:
        put("signal", cross - 2.9, -kerb - 0.5, np.pi / 2)
    put("bin", float(rng.uniform(8, 14)), kerb + walk - 0.4)
    put("hydrant", float(rng.uniform(9, 16)), kerb + 0.5)
    if plain or rng.random() < 0.6:
        put("sign", cross + float(rng.uniform(3.5, 9)), -kerb - 0.5, np.pi)
    parked = [(14.0, 1), (20.5, 1), (-14.5, 1)] if plain else []
    if not plain:
        for way in (1, -1):
            if rng.random() < 0.55:
                parked += [
                    (float(x) + float(rng.uniform(-0.6, 0.6)), way)
                    for x in np.arange(-38, 45, 6.4)
                    if rng.random() < 0.5 and abs(float(x) - cross) > 6
                ]
        for _ in range(int(rng.integers(0, 4))):  # street furniture close to the camera
            what = str(rng.choice(["bollard", "sign", "bin", "tree", "lamp"]))
            x = CROSSING_X_M + float(rng.choice([-1, 1])) * float(rng.uniform(1.2, 9.0))
            put(what, x, float(rng.uniform(-11.0, -kerb - 0.6)), float(rng.uniform(-3, 3)))
    for x, way in parked:
        put("car", x, way * (kerb - 1.05), 0.0 if way < 0 else np.pi)
    return tuple(out)


def _clutter(number: int, count: int, kerb: float) -> tuple[Fixture, ...]:
    """Fixtures of a person's size near the default camera, also at unlikely spots."""
    rng = np.random.default_rng((number, 97))
    return tuple(
        Fixture(
            str(rng.choice(["bollard", "bin", "sign", "hydrant"], p=[0.36, 0.3, 0.24, 0.1])),
            (CROSSING_X_M + float(rng.uniform(-9, 9)), float(rng.uniform(-12.0, -kerb - 0.5))),
            float(rng.uniform(-3, 3)),
            int(rng.integers(1 << 20)),
        )
        for _ in range(count)
    )
