"""Street furniture, trees and houses as meshes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bikeped.lab.rendering.mesh import Mesh, MeshBuilder, Point, Rgb
from bikeped.lab.rendering.street_layout import Fixture, House
from bikeped.lab.rendering.vehicles import vehicle
from bikeped.lab.scenarios.scenario import SIZES_M
from bikeped.types import FloatArray

_STEEL: Rgb = (96, 100, 106)
LAMP_HEAD_M = (1.6, 5.9)  #: how far over the road and how high a street lamp shines
#: Length and width of what stands on the ground.
FOOTPRINT_M = {"car": (4.5, 1.8), "bin": (0.5, 0.5), "tree": (0.5, 0.5)}
POLE_FOOTPRINT_M = (0.2, 0.2)


def fixture(item: Fixture, distance_m: float) -> Mesh:
    """The mesh of a fixture, in the world; a near tree has more and smaller leaves."""
    rng = np.random.default_rng(item.number)
    if item.what == "car":
        mesh = vehicle("car", SIZES_M["car"], item.number)
    elif item.what == "tree":
        mesh = _tree(rng, 1600 if distance_m < 12 else 420)
    else:
        b = MeshBuilder()
        {"lamp": _lamp, "sign": _sign, "signal": _signal, "bin": _bin, "hydrant": _hydrant,
         "bollard": _bollard}[item.what](b, rng)  # fmt: skip
        mesh = b.build()
    return mesh.placed(item.xy_m, item.heading_rad)


def _lamp(b: MeshBuilder, rng: np.random.Generator) -> None:
    b.limb((0, 0, 0.05), (0, 0, 0.8), 0.11, 0.09, _STEEL)
    b.limb((0, 0, 0.8), (0, 0, 6.0), 0.075, 0.05, _STEEL)
    b.limb((0, 0, 6.0), (LAMP_HEAD_M[0], 0, 6.15), 0.045, 0.04, _STEEL)
    b.limb((1.3, 0, 6.12), (1.85, 0, 6.12), 0.09, 0.07, (140, 142, 144))
    b.lamp((1.6, 0, 6.0), (255, 214, 150), 2.2)


def _sign(b: MeshBuilder, rng: np.random.Generator) -> None:
    b.limb((0, 0, 0.02), (0, 0, 2.5), 0.035, 0.03, (150, 152, 156))
    colour = ((200, 40, 40), (30, 80, 170), (240, 200, 40))[int(rng.integers(3))]
    corners = 4 + 4 * int(rng.integers(1, 4))
    for r, shade, x, layer in ((0.32, (240, 240, 236), 0.045, 1), (0.27, colour, 0.05, 2)):
        plate = _disc(x, 2.3, r, corners)
        b.faces(plate, shade, layer=layer)
        if layer == 1:
            b.faces(plate[:, ::-1] * (-1, 1, 1), (120, 122, 126), layer=1)


def _disc(x: float, z: float, radius: float, corners: int) -> FloatArray:
    """Faces [corners, 4, 3] of an upright disc about (x, 0, z) that faces forward."""
    turn = np.linspace(0, 2 * np.pi, corners + 1)[:-1]
    rim = np.stack([np.full(corners, x), radius * np.cos(turn), z + radius * np.sin(turn)], axis=1)
    middle = np.broadcast_to(np.array([x, 0, z]), rim.shape)
    return np.stack([middle, rim, np.roll(rim, -1, axis=0), middle], axis=1)


def _signal(b: MeshBuilder, rng: np.random.Generator) -> None:
    b.limb((0, 0, 0.02), (0, 0, 2.9), 0.06, 0.05, (70, 74, 70))
    b.box((0.04, -0.13, 2.2), (0.2, 0.13, 3.0), (34, 36, 36))
    green = rng.random() < 0.5
    for z, colour, on in (
        (2.82, (235, 50, 40), not green),
        (2.6, (60, 50, 20), False),
        (2.38, (50, 220, 110), green),
    ):
        shade = colour if on else tuple(c * 0.25 for c in colour)
        b.faces(_disc(0.205, z, 0.09, 12), shade, 0.9 if on else 0.0, 1)


def _bin(b: MeshBuilder, rng: np.random.Generator) -> None:
    colour = ((52, 78, 60), (60, 62, 66), (150, 90, 40))[int(rng.integers(3))]
    b.loft(
        [(0, 0, 0.02), (0, 0, 0.85), (0, 0, 0.95)], [[0.22, 0.22], [0.27, 0.27], [0.2, 0.2]], colour
    )


def _hydrant(b: MeshBuilder, rng: np.random.Generator) -> None:
    colour: Rgb = (190, 46, 36) if rng.random() < 0.6 else (214, 180, 50)
    b.limb((0, 0, 0.1), (0, 0, 0.6), 0.11, 0.1, colour)
    b.limb((0, -0.17, 0.45), (0, 0.17, 0.45), 0.06, 0.06, colour)
    b.limb((0, 0, 0.62), (0, 0, 0.72), 0.09, 0.03, colour)


def _bollard(b: MeshBuilder, rng: np.random.Generator) -> None:
    tall = float(rng.uniform(0.8, 1.1))
    b.limb(
        (0, 0, 0.05), (0, 0, tall), 0.07, 0.065, _STEEL if rng.random() < 0.6 else (216, 190, 60)
    )
    b.limb((0, 0, tall - 0.16), (0, 0, tall - 0.1), 0.07, 0.07, (225, 225, 220), 1)


def _tree(rng: np.random.Generator, count: int) -> Mesh:
    """A trunk and a crown of leaves: small faces turned every way about a few lobes."""
    b = MeshBuilder(sides=7)
    tall = float(rng.uniform(4.6, 7.2))
    bark: Rgb = (92, 76, 62)
    b.limb((0, 0, 0.1), (0.1, 0.05, tall * 0.5), 0.17, 0.12, bark)
    wide = float(rng.uniform(1.2, 1.9))
    tone = np.array([78.0, 110, 54]) + rng.normal(0, 10, 3)
    lobes = rng.normal(0, 0.5, (7, 3)) * (wide, wide, 0.8) + (0, 0, tall * 0.76)
    for lobe in lobes:
        b.limb((0.1, 0.05, tall * 0.48), tuple(lobe), 0.08, 0.03, bark)
    middle = lobes[rng.integers(0, 7, count)] + rng.normal(0, 0.42, (count, 3)) * (wide, wide, 1.0)
    middle[:, 2] = np.maximum(middle[:, 2], 2.2)
    size = rng.uniform(0.16, 0.36, count)[:, None] * (420 / count) ** 0.55
    u = rng.normal(0, 1, (count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, rng.normal(0, 1, (count, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    u, v = u * size, v * size
    leaves = np.stack([middle - u, middle - 0.5 * v, middle + u, middle + 0.5 * v], axis=1)
    # Every leaf shows from both sides; higher ones are lighter.
    rise = (middle[:, 2:] - tall * 0.6) / (tall * 0.5)
    colour = np.clip(tone * (0.75 + 0.4 * rise) * rng.uniform(0.75, 1.25, (count, 1)), 12, 235)
    b.faces(leaves, colour)
    b.faces(leaves[:, ::-1], colour)
    return b.build()


def house(item: House, lit_windows: bool) -> Mesh:
    """A house: front and ends in cells of one window each."""
    rng = np.random.default_rng(item.number)
    faces: list[tuple[list[Point], Rgb, float, int]] = []  # corners, colour, glow, layer
    floors = max(int((item.height - 0.8) / 3.0), 1)
    columns = max(int((item.x1 - item.x0) / 2.6), 1)
    pitch, storey = (item.x1 - item.x0) / columns, item.height / floors
    shop = rng.random() < 0.4
    north = item.front > 0
    front_y = item.front if north else item.front + item.depth
    out = -0.02 if north else 0.02
    frame: Rgb = (222, 218, 208) if rng.random() < 0.6 else (70, 66, 62)

    def front(
        x0: float, x1: float, z0: float, z1: float, colour: Rgb, layer: int, glow: float = 0.0
    ) -> None:
        y = front_y + out * layer
        face = [(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)]
        faces.append((face if north else face[::-1], colour, glow, layer))

    xs = [item.x0 + column * pitch for column in range(columns)]
    for floor in range(floors):
        z = floor * storey
        for column, x in enumerate(xs):
            wall = _scaled(item.wall, 1 + float(rng.normal(0, 0.012)))
            front(x, x + pitch, z, z + storey, wall, 0)
            lit = lit_windows and rng.random() < 0.35
            pane: Rgb = (
                (250, 208, 130) if lit else tuple(np.array([74.0, 92, 108]) * rng.uniform(0.7, 1.3))
            )
            m = x + pitch / 2
            if floor == 0 and shop:
                pane, glow = ((250, 224, 170), 0.8) if lit_windows else (pane, 0.0)
                front(x + 0.15, x + pitch - 0.15, 0.4, storey - 0.7, pane, 2, glow)
            elif floor == 0 and column == columns // 2:  # the door
                front(m - 0.6, m + 0.6, 0, 2.3, frame, 1)
                front(m - 0.5, m + 0.5, 0, 2.2, (84, 52, 44), 2)
            else:
                w, low, high = pitch * 0.26, z + storey * 0.3, z + storey * 0.8
                front(m - w - 0.1, m + w + 0.1, low - 0.1, high + 0.1, frame, 1)
                front(m - w, m + w, low, high, pane, 2, 0.75 if lit else 0.0)
                front(m - 0.03, m + 0.03, low, high, frame, 3)
        if floor == 0 and shop:
            band: Rgb = tuple(rng.uniform(40, 210, 3))
            for x in xs:
                front(x, x + pitch, storey - 0.6, storey - 0.1, band, 2)
    for x in xs:
        front(x, x + pitch, item.height - 0.35, item.height, _scaled(item.wall, 0.7), 1)
    ys = np.linspace(item.front, item.front + item.depth, 5).tolist()
    for x, order in ((item.x0, 1), (item.x1, -1)):
        for floor in range(floors):
            z0, z1 = floor * storey, (floor + 1) * storey
            for y0, y1 in pairwise(ys):
                face = [(x, y1, z0), (x, y0, z0), (x, y0, z1), (x, y1, z1)]
                faces.append((face[::order], _scaled(item.wall, 0.9), 0.0, 0))
                if (item.number >> floor) % 2:
                    p, q = y0 + 0.3 * (y1 - y0), y0 + 0.7 * (y1 - y0)
                    e, low, high = x - 0.02 * order, z0 + 1, z1 - 0.7
                    window = [(e, q, low), (e, p, low), (e, p, high), (e, q, high)]
                    faces.append((window[::order], (74, 88, 102), 0.0, 2))
    quads, colours, glows, layers = zip(*faces, strict=True)
    return Mesh(
        np.array(quads, np.float64),
        np.array(colours, np.float64),
        np.array(glows),
        np.array(layers, np.int8),
    )


def _scaled(colour: Rgb, factor: float) -> Rgb:
    r, g, b = colour
    return r * factor, g * factor, b * factor
