"""Cars, buses and trucks: a skin over cross-sections from the rear bumper to the front."""

from __future__ import annotations

import numpy as np

from bikeped.lab.rendering.mesh import Mesh, MeshBuilder, Rgb
from bikeped.lab.rendering.people import RUBBER

PAINTS: tuple[Rgb, ...] = (
    (196, 198, 200), (232, 232, 230), (38, 40, 44), (98, 102, 108), (140, 32, 34), (34, 62, 112),
    (70, 96, 78), (168, 158, 140), (190, 120, 40), (90, 130, 160),
)  # fmt: skip
_GLASS: Rgb = (42, 54, 64)
_DARK: Rgb = (26, 27, 30)
_HEAD: Rgb = (250, 248, 235)
_TAIL: Rgb = (178, 26, 24)
#: Stations of a saloon and of an estate from the rear: x, sill, waist, roof (m), half width there
#: and at the roof, and what the upper side is made of between this station and the next.
_SALOON = (
    (-2.22, 0.42, 0.62, 0.64, 0.70, 0.66, "paint"),
    (-2.15, 0.26, 0.92, 0.94, 0.82, 0.74, "paint"),
    (-1.62, 0.22, 0.97, 1.00, 0.87, 0.74, "screen"),
    (-0.98, 0.22, 0.97, 1.42, 0.89, 0.62, "glass"),
    (-0.30, 0.22, 0.96, 1.49, 0.90, 0.63, "glass"),
    (0.36, 0.22, 0.94, 1.44, 0.90, 0.62, "screen"),
    (1.10, 0.22, 0.90, 0.94, 0.89, 0.74, "paint"),
    (1.75, 0.24, 0.82, 0.85, 0.86, 0.72, "paint"),
    (2.12, 0.28, 0.68, 0.70, 0.78, 0.66, "paint"),
    (2.24, 0.40, 0.56, 0.57, 0.66, 0.60, "paint"),
)
_ESTATE = (
    (-2.20, 0.40, 0.70, 0.74, 0.74, 0.68, "paint"),
    (-2.14, 0.26, 0.96, 1.02, 0.84, 0.76, "screen"),
    (-1.86, 0.22, 0.98, 1.46, 0.88, 0.64, "glass"),
    (-1.00, 0.22, 0.98, 1.50, 0.89, 0.65, "glass"),
    (-0.20, 0.22, 0.97, 1.50, 0.90, 0.65, "glass"),
    (0.42, 0.22, 0.95, 1.46, 0.90, 0.63, "screen"),
    (1.14, 0.22, 0.93, 0.97, 0.89, 0.74, "paint"),
    (1.76, 0.24, 0.86, 0.89, 0.86, 0.72, "paint"),
    (2.12, 0.28, 0.72, 0.74, 0.78, 0.66, "paint"),
    (2.24, 0.42, 0.58, 0.59, 0.66, 0.60, "paint"),
)


def vehicle(kind: str, size_m: tuple[float, float, float], number: int) -> Mesh:
    """A car, bus or truck of this size in its own axes; `number` picks shape and paint."""
    paint = PAINTS[number % len(PAINTS)]
    if kind == "bus":
        mesh, usual = _bus(number), (12.0, 2.5, 3.0)
    elif kind == "truck":
        mesh, usual = _truck(number), (7.0, 2.5, 2.8)
    else:
        mesh, usual = _car(_ESTATE if (number // 3) % 2 else _SALOON, paint), (4.5, 1.84, 1.52)
    stretch = [s / u for s, u in zip(size_m, usual, strict=True)]
    return mesh.placed((0, 0), 0.0, stretch)


def _car(
    stations: tuple[tuple[float, float, float, float, float, float, str], ...], paint: Rgb
) -> Mesh:
    b = MeshBuilder()
    light = tuple(min(c * 1.06 + 4, 250) for c in paint)
    rows = []
    for x, sill, waist, roof, wide, top, _ in stations:
        mid = sill + 0.55 * (waist - sill)
        rows.append(
            [
                (x, -wide * 0.94, sill), (x, -wide, mid), (x, -wide * 0.97, waist),
                (x, -top, roof), (x, 0, roof + 0.025), (x, top, roof),
                (x, wide * 0.97, waist), (x, wide, mid), (x, wide * 0.94, sill),
            ]
        )  # fmt: skip
    rings = np.array(rows)
    for i, station in enumerate(stations[:-1]):
        what = station[6]
        for j in range(8):
            colour: tuple[float, ...] = paint
            if j in {2, 5}:
                colour = _GLASS if what in {"glass", "screen"} else light
            elif j in {3, 4}:
                colour = _GLASS if what == "screen" else light
            quad = [rings[i, j], rings[i + 1, j], rings[i + 1, j + 1], rings[i, j + 1]]
            b.faces([quad], colour)
        # Pillars between the side windows.
        if what == "glass":
            for j, side in ((2, -1), (5, 1)):
                p, q = rings[i, j], rings[i, j + 1]
                w = np.array([0.06, 0.012 * side, 0.0])
                back = w * (-1, 1, 1)
                pillar = [q + back, q + w, p + w, p + back]
                b.faces([pillar], paint, layer=1)
    for x, end in ((0, 1), (-1, -1)):
        ring = rings[x]
        middle = ring.mean(axis=0)
        cap = [[middle, ring[j + 1], ring[j], middle] for j in range(8)]
        cap.append([middle, ring[0], ring[8], middle])
        b.faces(np.array(cap)[:, ::-1] if end > 0 else np.array(cap), paint)
    for side in (1, -1):
        for x, y in ((-1.36, 0.86), (1.38, 0.86)):
            b.disc((x, side * (y + 0.03), 0.36), 0.38, side, _DARK, layer=1)
            b.wheel((x, side * (y - 0.04), 0.325), 0.325, 0.085, RUBBER, steps=18)
            b.disc((x, side * (y + 0.05), 0.325), 0.33, side, RUBBER, layer=2)
            b.disc((x, side * (y + 0.052), 0.325), 0.2, side, (156, 158, 162), layer=3)
            b.disc((x, side * (y + 0.054), 0.325), 0.07, side, (90, 92, 96), layer=4)
        y0, y1 = sorted((side * 0.4, side * 0.78))
        front = [(2.245, y1, 0.6), (2.245, y0, 0.6), (2.2, y0, 0.7), (2.1, y1, 0.7)]
        rear = [(-2.245, y0, 0.7), (-2.245, y1, 0.7), (-2.2, y1, 0.86), (-2.2, y0, 0.86)]
        b.faces([front[::-1]], _HEAD, 0.5, layer=1)
        b.faces([rear[::-1]], _TAIL, 0.35, layer=1)
        b.lamp((2.26, side * 0.6, 0.64), (255, 248, 225), 1.0)
        b.lamp((-2.26, side * 0.6, 0.78), (230, 30, 26), 0.4)
        mirror = (0.72, side * 0.96, 0.98)
        b.limb(mirror, (0.72, side * 0.9, 0.96), 0.075, 0.05, paint)
    _plate(b, 2.25, (-0.36, 0.36), (0.42, 0.58), _DARK)
    plate = [(-2.23, 0.26, 0.62), (-2.23, -0.26, 0.62), (-2.2, -0.26, 0.74), (-2.2, 0.26, 0.74)]
    b.faces([plate], (225, 225, 215), layer=1)
    return b.build()


def _plate(
    b: MeshBuilder,
    x: float,
    y: tuple[float, float],
    z: tuple[float, float],
    colour: Rgb,
    glow: float = 0.0,
) -> None:
    """An upright rectangle across the vehicle at `x`, facing away from the vehicle's middle."""
    (y0, y1), (z0, z1) = y if x > 0 else y[::-1], z
    b.faces([[(x, y0, z0), (x, y1, z0), (x, y1, z1), (x, y0, z1)]], colour, glow, layer=1)


def _panels(
    b: MeshBuilder,
    x: tuple[float, float],
    z: tuple[float, float],
    half: float,
    count: int,
    gap: float,
) -> None:
    """`count` windows along both sides."""
    (x0, x1), (z0, z1) = x, z
    step = (x1 - x0) / count
    for i in range(count):
        a, c = x0 + i * step + gap / 2, x0 + (i + 1) * step - gap / 2
        for y, (p, q) in ((half, (c, a)), (-half, (a, c))):
            b.faces([[(p, y, z0), (q, y, z0), (q, y, z1), (p, y, z1)]], _GLASS, layer=1)


def _big_wheel(b: MeshBuilder, x: float, half: float, radius: float) -> None:
    for side in (1, -1):
        b.disc((x, side * (half + 0.005), radius + 0.04), radius + 0.06, side, _DARK, layer=1)
        b.wheel((x, side * (half - 0.15), radius), radius, 0.14, RUBBER, steps=18)
        b.disc((x, side * (half + 0.01), radius), radius, side, RUBBER, layer=2)
        b.disc((x, side * (half + 0.015), radius), radius * 0.55, side, (150, 152, 156), layer=3)


def _bus(number: int) -> Mesh:
    b = MeshBuilder()
    paint = ((206, 60, 48), (60, 110, 170), (228, 228, 222), (70, 140, 90), (226, 176, 60))[
        number % 5
    ]
    f, w = 6.0, 1.25
    b.box((-f, -w, 0.3), (f, w, 3.0), paint, pieces=12)
    _panels(b, (-5.8, 5.5), (1.15, 2.45), w + 0.005, count=7, gap=0.14)
    _plate(b, f + 0.005, (-1.12, 1.12), (1.0, 2.45), _GLASS)
    _plate(b, f + 0.005, (-0.9, 0.9), (2.55, 2.85), (240, 180, 60), 0.6)
    _plate(b, -f - 0.005, (-1.0, 1.0), (1.5, 2.4), _GLASS)
    for x in (4.6, 0.2):  # doors on the right
        x0, x1, y = x - 0.6, x + 0.6, -w - 0.006
        door = [(x0, y, 0.4), (x1, y, 0.4), (x1, y, 2.45), (x0, y, 2.45)]
        b.faces([door], (60, 74, 84), layer=2)
    _ends(b, f, w, 0.6)
    for x in (-3.6, 3.2):
        _big_wheel(b, x, w, 0.48)
    return b.build()


def _truck(number: int) -> Mesh:
    b = MeshBuilder()
    cab = PAINTS[(number + 3) % len(PAINTS)]
    load = ((226, 226, 222), (176, 180, 184), (90, 120, 150), (196, 150, 90))[number % 4]
    w = 1.25
    b.box((-3.5, -w, 0.75), (1.55, w, 2.8), load, pieces=6)
    b.box((-3.4, -1.0, 0.45), (1.7, 1.0, 0.75), _DARK, pieces=4)
    b.box((1.7, -1.15, 0.35), (3.5, 1.15, 2.45), cab, pieces=3)
    _plate(b, 3.505, (-1.02, 1.02), (1.4, 2.2), _GLASS)
    _panels(b, (2.1, 3.3), (1.4, 2.15), 1.155, count=1, gap=0.0)
    _plate(b, 3.505, (-0.7, 0.7), (0.75, 1.15), _DARK)
    _ends(b, 3.5, 1.1, 0.6)
    for x in (-2.2, 2.55):
        _big_wheel(b, x, 1.2, 0.46)
    return b.build()


def _ends(b: MeshBuilder, f: float, w: float, z: float) -> None:
    """Head and tail lamps at x = `f` and -`f`, `z` above the ground."""
    for side in (1, -1):
        y0, y1 = sorted((side * w * 0.55, side * w * 0.9))
        _plate(b, f + 0.008, (y0, y1), (z, z + 0.2), _HEAD, 0.5)
        _plate(b, -f - 0.008, (y0, y1), (z, z + 0.3), _TAIL, 0.35)
        b.lamp((f + 0.02, side * w * 0.72, z + 0.1), (255, 248, 225), 1.0)
        b.lamp((-f - 0.02, side * w * 0.72, z + 0.15), (230, 30, 26), 0.4)
