"""Solids of coloured quads: limbs, lofts, boxes and wheels. Pure.

Body axes are x forward, y left, z up, in metres. Faces run counter-clockwise seen from outside,
for back-face culling.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from bikeped.types import FloatArray

Rgb = tuple[float, float, float]
Point = tuple[float, float, float]
Size = tuple[float, float, float]  #: length, width, height in metres


@dataclass(frozen=True)
class Lamp:
    """A light: place [3] in metres, colour, strength (a headlight is 1)."""

    at: FloatArray
    colour: Rgb
    strength: float


@dataclass(frozen=True)
class Mesh:
    """`quads` [n, 4, 3] metres; `colours` [n, 3] reflected share in 0..255; `glow` [n] 0..1, the
    share that shines by itself; `layer` [n], higher is drawn later (a window on its wall)."""

    quads: FloatArray
    colours: FloatArray
    glow: FloatArray
    layer: npt.NDArray[np.int8]
    lamps: tuple[Lamp, ...] = ()

    def placed(
        self, xy_m: npt.ArrayLike, heading_rad: float, stretch: Sequence[float] = (1, 1, 1)
    ) -> Mesh:
        """The mesh stretched, turned to `heading_rad` and set at `xy_m` [2] of the world."""
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag(np.asarray(stretch, float))
        shift = np.array([*np.asarray(xy_m, float), 0.0])
        lamps = tuple(
            Lamp(turn @ lamp.at + shift, lamp.colour, lamp.strength) for lamp in self.lamps
        )
        return Mesh(self.quads @ turn.T + shift, self.colours, self.glow, self.layer, lamps)


_Faces = tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.int8]]  #: as `Mesh` has them


@dataclass
class MeshBuilder:
    """Collects faces; `sides` is how many a round limb has."""

    sides: int = 8
    _faces: list[_Faces] = field(default_factory=list)
    _limbs: list[tuple[Point, Point, float, float, Rgb, int]] = field(default_factory=list)
    _lamps: list[Lamp] = field(default_factory=list)

    def faces(
        self, quads: npt.ArrayLike, colour: npt.ArrayLike, glow: float = 0.0, layer: int = 0
    ) -> None:
        """Faces [n, 4, 3] in one colour [3] or one a face [n, 3]."""
        array = np.asarray(quads, np.float64).reshape(-1, 4, 3)
        count = len(array)
        colours = np.broadcast_to(np.asarray(colour, np.float64), (count, 3))
        self._faces.append((array, colours, np.full(count, glow), np.full(count, layer, np.int8)))

    def limb(
        self, a: Point, b: Point, radius_a: float, radius_b: float, colour: Rgb, layer: int = 0
    ) -> None:
        """A round tapering limb with round ends of these radii about `a` and `b`."""
        self._limbs.append((a, b, radius_a, radius_b, colour, layer))

    def loft(
        self,
        centres: npt.ArrayLike,
        radii: npt.ArrayLike,
        colour: npt.ArrayLike,
        *,
        layer: int = 0,
        sides: int | None = None,
    ) -> None:
        """A skin over ellipses about `centres` [r, 3] and normal to the line from the first to the
        last, with half axes `radii` [r, 2] (left, and the other one); `colour` [3] or one a band
        [r - 1, 3]."""
        c, r = np.asarray(centres, np.float64), np.asarray(radii, np.float64)
        sides = sides or self.sides + 2
        way = c[-1] - c[0]
        u = np.array([0.0, 1.0, 0.0])
        v = cross_product(way / max(math.sqrt(float(way @ way)), 1e-9), u)
        turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
        ring = c[:, None] + r[:, :1, None] * np.cos(turn)[:, None] * u
        ring += r[:, 1:, None] * np.sin(turn)[:, None] * v
        bands = np.broadcast_to(np.asarray(colour, np.float64), (len(c) - 1, 3))
        self.faces(_bands(ring), np.repeat(bands, sides, axis=0), layer=layer)

    def ball(self, at: Point, radii: Point, colour: npt.ArrayLike, layer: int = 0) -> None:
        """An ellipsoid of half axes `radii` (forward, left, up)."""
        rings = 7 if self.sides > 5 else 5
        up = np.sin(np.linspace(-np.pi / 2, np.pi / 2, rings))
        wide = np.sqrt(1 - up**2)
        centres = np.zeros((rings, 3))
        centres[:, 2] = up * radii[2]
        centres += at
        across = np.stack([wide * radii[1], wide * radii[0]], axis=1)
        self.loft(centres, across, colour, layer=layer)

    def box(self, low: Point, high: Point, colour: Rgb, pieces: int = 1) -> None:
        """A box between two corners, its sides cut `pieces` times along x."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        xs = np.linspace(x0, x1, pieces + 1)
        quads = []
        for a, b in pairwise(xs):
            quads += [
                [(a, y0, z0), (b, y0, z0), (b, y0, z1), (a, y0, z1)],
                [(b, y1, z0), (a, y1, z0), (a, y1, z1), (b, y1, z1)],
                [(a, y0, z1), (b, y0, z1), (b, y1, z1), (a, y1, z1)],
                [(a, y1, z0), (b, y1, z0), (b, y0, z0), (a, y0, z0)],
            ]
        quads += [
            [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
            [(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)],
        ]
        self.faces(quads, colour)

    def wheel(
        self,
        hub: Point,
        radius: float,
        tube: float,
        colour: Rgb,
        *,
        spokes: int = 0,
        turned: float = 0.0,
        steps: int = 22,
    ) -> None:
        """A tyre standing along x about `hub`, with spokes; radius to the outside, tube half."""
        if self.sides <= 5:
            steps, spokes = min(steps, 14), min(spokes, 4)
        turn = np.linspace(0, 2 * np.pi, steps, endpoint=False)
        rings = []
        # Out, left, in, right about the tube; outside is where the ring order runs to the left.
        for along, left in ((1.0, 0.0), (0.0, -1.0), (-1.0, 0.0), (0.0, 1.0)):
            r = radius - tube + along * tube
            rings.append(_circle((hub[0], hub[1] + left * tube, hub[2]), r, turn))
        closed = np.stack([*rings, rings[0]])
        self.faces(_bands(closed)[:, ::-1], colour)
        for i in range(spokes):
            a = turned + i * math.pi / spokes
            f, u = (radius - tube) * math.cos(a), (radius - tube) * math.sin(a)
            spoke = np.array([f, 0, u])
            one, other = np.array(hub) - spoke, np.array(hub) + spoke
            half = np.array([-0.006 * math.sin(a), 0, 0.006 * math.cos(a)])
            ribbon = np.array([one - half, other - half, other + half, one + half])
            self.faces(np.stack([ribbon, ribbon[::-1]]), (150, 152, 156))

    def disc(
        self, hub: Point, radius: float, left: float, colour: Rgb, layer: int = 1, steps: int = 16
    ) -> None:
        """A round plate facing left (`left` 1) or right (-1)."""
        turn = np.linspace(0, 2 * np.pi, steps + 1)
        rim = _circle(hub, radius, turn)
        middle = np.broadcast_to(np.array(hub), rim[:-1].shape)
        quads = np.stack([middle, rim[1:], rim[:-1], middle], axis=1)
        self.faces(quads if left > 0 else quads[:, ::-1], colour, layer=layer)

    def lamp(self, at: Point, colour: Rgb, strength: float) -> None:
        """A light of this strength at a point."""
        self._lamps.append(Lamp(np.array(at), colour, strength))

    def build(self) -> Mesh:
        """All that was collected."""
        if self._limbs:
            self._build_limbs()
        quads, colours, glow, layer = (
            np.concatenate(part) for part in zip(*self._faces, strict=True)
        )
        return Mesh(quads, colours, glow, layer, tuple(self._lamps))

    def _build_limbs(self) -> None:
        """All limbs at once: six rings each, the outer ones shrunk to the rounded ends."""
        ends_a, ends_b, radii_a, radii_b, colours, layers = zip(*self._limbs, strict=True)
        a, b = np.array(ends_a, np.float64), np.array(ends_b, np.float64)
        ra, rb = np.array(radii_a), np.array(radii_b)
        colour, layer = np.array(colours, np.float64), np.array(layers, np.int8)
        self._limbs = []
        way = b - a
        length = np.linalg.norm(way, axis=1, keepdims=True)
        d = np.where(length > 1e-9, way / np.maximum(length, 1e-9), (0.0, 0.0, 1.0))
        helper = np.where(np.abs(d[:, 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
        u = cross_product(helper, d)
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        v = cross_product(d, u)
        zero, end = np.zeros_like(ra), length[:, 0]
        if self.sides > 5:
            radius = np.stack([zero, 0.75 * ra, ra, rb, 0.75 * rb, zero], axis=1)
            along = np.stack([-ra, -0.66 * ra, zero, end, end + 0.66 * rb, end + rb], axis=1)
        else:
            radius = np.stack([zero, ra, rb, zero], axis=1)
            along = np.stack([-ra, -0.3 * ra, end + 0.3 * rb, end + rb], axis=1)
        centre = a[:, None] + along[..., None] * d[:, None]
        turn = np.linspace(0, 2 * np.pi, self.sides, endpoint=False)
        # [m, sides, 3]
        spread = np.cos(turn)[:, None] * u[:, None] + np.sin(turn)[:, None] * v[:, None]
        ring = centre[:, :, None] + radius[:, :, None, None] * spread[:, None]
        quads = _bands(ring)
        per = len(quads) // len(a)
        glow = np.zeros(len(quads))
        self._faces.append((quads, np.repeat(colour, per, axis=0), glow, np.repeat(layer, per)))


def cross_product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product of [..., 3]; several times as fast as NumPy's on few vectors."""
    out: FloatArray = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def _circle(middle: Point, radius: float, turn: npt.NDArray[np.floating]) -> FloatArray:
    """Points [n, 3] of an upright circle along x, at the angles `turn` [n]."""
    x, y, z = middle
    return np.stack(
        [x + radius * np.cos(turn), np.full(len(turn), y), z + radius * np.sin(turn)], axis=1
    )


def normals(quads: FloatArray) -> FloatArray:
    """Outward directions [n, 3] of faces [n, 4, 3], not of unit length."""
    return cross_product(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])


def _bands(rings: FloatArray) -> FloatArray:
    """Faces [n * (r - 1) * s, 4, 3] between neighbouring rings [..., r, s, 3]."""
    low, high = rings[..., :-1, :, :], rings[..., 1:, :, :]
    corners = [low, np.roll(low, -1, axis=-2), np.roll(high, -1, axis=-2), high]
    return np.stack(corners, axis=-2).reshape(-1, 4, 3)
