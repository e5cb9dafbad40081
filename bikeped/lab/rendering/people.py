"""Walkers, children and wheelchair users, posed by the distance they have travelled."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bikeped.lab.rendering.mesh import Mesh, MeshBuilder, Point, Rgb, Size

SKINS: tuple[Rgb, ...] = (
    (236, 196, 170), (224, 178, 148), (198, 148, 114), (160, 112, 82), (118, 80, 60), (84, 58, 46),
)  # fmt: skip
HAIRS: tuple[Rgb, ...] = (
    (38, 30, 26), (62, 44, 34), (98, 68, 44), (150, 112, 70), (120, 118, 116), (196, 192, 186),
    (110, 52, 34),
)  # fmt: skip
TOPS: tuple[Rgb, ...] = (
    (188, 52, 50), (46, 92, 160), (224, 160, 44), (62, 128, 84), (232, 232, 228), (40, 42, 48),
    (120, 122, 128), (108, 64, 124), (214, 110, 60), (90, 150, 180), (70, 60, 52), (196, 178, 140),
    (220, 120, 150), (52, 66, 46), (28, 44, 84),
)  # fmt: skip
LEGS: tuple[Rgb, ...] = (
    (48, 58, 86), (36, 40, 50), (62, 54, 48), (92, 94, 100), (150, 134, 104), (30, 30, 32),
    (78, 96, 128), (188, 180, 164),
)  # fmt: skip
SHOES: tuple[Rgb, ...] = ((32, 30, 30), (210, 208, 204), (96, 66, 44), (60, 62, 70))
RUBBER: Rgb = (30, 30, 32)
_STRIDE_M = 1.42  #: an adult in one full step cycle
WHEELCHAIR_MIN_LENGTH_M = 0.7  #: a pedestrian this long sits in a wheelchair
CHILD_MAX_HEIGHT_M = 1.4


@dataclass(frozen=True)
class Appearance:
    """Body and clothes of a person."""

    skin: Rgb
    hair: Rgb
    top: Rgb
    legs: Rgb
    shoes: Rgb
    girth: float
    long_hair: bool
    sleeves: bool
    wear: str  #: trousers, shorts, skirt, coat
    pack: Rgb | None
    hat: Rgb | None
    bag: Rgb | None
    helmet: Rgb | None
    pace: float  #: phase of the step at the start, 0..1

    @staticmethod
    def random(rng: np.random.Generator) -> Appearance:
        """Drawn at random."""

        def pick(choices: tuple[Rgb, ...]) -> Rgb:
            colour = choices[int(rng.integers(len(choices)))]
            change = rng.normal(0, 7, 3)
            r, g, b = (float(np.clip(c + d, 16, 245)) for c, d in zip(colour, change, strict=True))
            return r, g, b

        return Appearance(
            skin=SKINS[int(rng.integers(len(SKINS)))],
            hair=pick(HAIRS),
            top=pick(TOPS),
            legs=pick(LEGS),
            shoes=pick(SHOES),
            girth=float(rng.uniform(0.88, 1.16)),
            long_hair=bool(rng.random() < 0.4),
            sleeves=bool(rng.random() < 0.7),
            wear=str(rng.choice(["trousers", "shorts", "skirt", "coat"], p=[0.6, 0.15, 0.1, 0.15])),
            pack=pick(TOPS) if rng.random() < 0.25 else None,
            hat=pick(TOPS) if rng.random() < 0.15 else None,
            bag=pick(LEGS) if rng.random() < 0.2 else None,
            helmet=pick(TOPS) if rng.random() < 0.65 else None,
            pace=float(rng.random()),
        )


def person(size_m: Size, style: Appearance, travel_m: float, moving: bool, sides: int = 8) -> Mesh:
    """A pedestrian agent's mesh in its own axes: a wheelchair user, a child or an adult.

    `travel_m`: distance travelled, which poses the legs; `sides`: of a limb's cross-section.
    """
    if size_m[0] >= WHEELCHAIR_MIN_LENGTH_M:
        return _wheelchair(size_m, style, travel_m, sides)
    return walker(size_m[2], style, travel_m, moving, sides)


def walker(
    height_m: float, style: Appearance, travel_m: float, moving: bool, sides: int = 8
) -> Mesh:
    """A person on foot; the lower shoe stands on the ground."""
    s = height_m / 1.7
    child = height_m < CHILD_MAX_HEIGHT_M
    phase = 2 * math.pi * (travel_m / (_STRIDE_M * s) + style.pace)
    swing = 0.33 if moving else 0.05
    b = MeshBuilder(sides)
    g = style.girth
    legs = []
    low = math.inf
    for side in (1.0, -1.0):
        at = phase if side > 0 else phase + math.pi
        thigh = swing * math.sin(at)
        knee_bend = (0.12 + 0.62 * max(0.0, math.sin(at + 0.9)) ** 2) if moving else 0.04
        hip = np.array([0.0, 0.09 * side, 0.91])
        knee = hip + 0.43 * np.array([math.sin(thigh), 0.0, -math.cos(thigh)])
        shin = thigh - knee_bend
        ankle = knee + 0.40 * np.array([math.sin(shin), 0.0, -math.cos(shin)])
        pitch = 0.6 * min(0.0, shin) if moving else 0.0
        heel = ankle + np.array([-0.045, 0, -0.045])
        foot = (0.155 * math.cos(pitch), 0.02 * side, -0.05 + 0.155 * math.sin(pitch))
        toe = ankle + np.array(foot)
        low = min(low, float(heel[2]) - 0.042, float(toe[2]) - 0.036)
        legs.append((side, thigh, hip, knee, ankle, heel, toe))

    def at_height(p: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Point:
        return float(p[0]) * s, float(p[1]) * s, float(p[2] - low) * s

    trousers = style.legs if style.wear in {"trousers", "coat"} else style.skin
    thigh_cloth = style.legs if style.wear != "skirt" else style.skin
    for _, _, hip, knee, ankle, heel, toe in legs:
        b.limb(at_height(hip), at_height(knee), 0.085 * g * s, 0.062 * g * s, thigh_cloth)
        b.limb(at_height(knee), at_height(ankle), 0.06 * g * s, 0.045 * s, trousers)
        b.limb(at_height(heel), at_height(toe), 0.042 * s, 0.036 * s, style.shoes)
    up = -low
    lean = 0.03 if moving else 0.0

    def spine(*rows: tuple[float, float, float, float]) -> tuple[list[Point], list[list[float]]]:
        centres = [((x + lean * (z - 0.9)) * s, 0.0, (z + up) * s) for x, z, _, _ in rows]
        return centres, [[w * g * s, d * g * s] for _, _, w, d in rows]

    hips = (0, 0.82, 0.10, 0.08), (0, 0.88, 0.165, 0.115), (0, 1.0, 0.155, 0.105)
    b.loft(*spine(*hips), style.legs if style.wear != "coat" else style.top)
    chest = (
        (0, 0.94, 0.155, 0.108), (0, 1.06, 0.145, 0.102), (0.01, 1.25, 0.172, 0.12),
        (0, 1.36, 0.178, 0.105), (-0.005, 1.425, 0.13, 0.085), (0, 1.46, 0.05, 0.05),
    )  # fmt: skip
    b.loft(*spine(*chest), style.top)
    if style.wear in {"skirt", "coat"}:
        hem = 0.55 if style.wear == "skirt" else 0.62
        cloth = style.legs if style.wear == "skirt" else style.top
        flare = 0.05 * abs(math.sin(phase)) if moving else 0.0
        cone = (0, hem, 0.2, 0.16 + flare), (0, 0.8, 0.18, 0.14), (0, 1.0, 0.15, 0.105)
        b.loft(*spine(*cone), cloth)
    for side, thigh, *_ in legs:
        arm = -1.05 * thigh
        shoulder = np.array([0.0, 0.195 * side * g, 1.375])
        elbow = shoulder + 0.28 * np.array([math.sin(arm), 0.09 * side, -math.cos(arm)])
        fore = arm + (0.35 if moving else 0.15)
        hand = elbow + 0.25 * np.array([math.sin(fore), -0.03 * side, -math.cos(fore)])
        sleeve = style.top if style.sleeves else style.skin
        b.limb(at_height(shoulder), at_height(elbow), 0.054 * g * s, 0.043 * g * s, style.top)
        b.limb(at_height(elbow), at_height(hand), 0.041 * g * s, 0.032 * s, sleeve)
        grip = hand + np.array([0.01, 0, -0.05])
        b.limb(at_height(hand), at_height(grip), 0.033 * s, 0.03 * s, style.skin)
        if style.bag is not None and side > 0:
            x, y, z = at_height(grip)
            low_corner = (x - 0.14 * s, y - 0.05 * s, z - 0.28 * s)
            b.box(low_corner, (x + 0.14 * s, y + 0.05 * s, z), style.bag)
    x, _, z = at_height(np.array([lean * 0.6, 0, 1.45]))
    head(b, (x, 0.0, z), s * (1.18 if child else 1.0), style)
    if style.pack is not None:
        z0 = (1.05 + up) * s
        b.box((-0.26 * s, -0.13 * s, z0), (-0.1 * s, 0.13 * s, z0 + 0.36 * s), style.pack)
    return b.build()


def head(b: MeshBuilder, neck: Point, s: float, style: Appearance, helmet: bool = False) -> None:
    """Neck, face and hair above the point `neck`; 0.25 m high for an adult (`s` 1)."""
    x, y, z = neck
    b.limb((x, y, z - 0.03 * s), (x + 0.01, y, z + 0.06 * s), 0.048 * s, 0.046 * s, style.skin)
    b.ball((x + 0.025 * s, y, z + 0.135 * s), (0.098 * s, 0.078 * s, 0.115 * s), style.skin)
    if helmet and style.helmet is not None:
        b.ball((x + 0.005 * s, y, z + 0.175 * s), (0.135 * s, 0.1 * s, 0.085 * s), style.helmet, 1)
    elif style.hat is not None:
        b.ball((x + 0.005 * s, y, z + 0.18 * s), (0.112 * s, 0.092 * s, 0.075 * s), style.hat, 1)
    else:
        b.ball((x - 0.005 * s, y, z + 0.165 * s), (0.105 * s, 0.09 * s, 0.088 * s), style.hair)
    if style.long_hair:
        b.limb(
            (x - 0.06 * s, y, z + 0.13 * s), (x - 0.075 * s, y, z - 0.03 * s),
            0.07 * s, 0.05 * s, style.hair,
        )  # fmt: skip


def _wheelchair(size_m: Size, style: Appearance, travel_m: float, sides: int) -> Mesh:
    """A wheelchair and its user, 1.1 x 0.65 x 1.3 m, stretched to `size_m`."""
    b = MeshBuilder(sides)
    frame: Rgb = (54, 58, 66) if style.girth < 1 else (120, 40, 44)
    turned = travel_m / 0.3
    for side in (1.0, -1.0):
        y = 0.285 * side
        b.wheel((-0.2, y, 0.3), 0.3, 0.016, RUBBER, spokes=5, turned=turned)
        b.wheel((-0.2, y + 0.035 * side, 0.3), 0.26, 0.009, (170, 172, 176))
        b.wheel((0.33, 0.22 * side, 0.09), 0.09, 0.02, RUBBER, steps=12)
        b.limb((0.33, 0.22 * side, 0.16), (0.25, 0.22 * side, 0.48), 0.014, 0.014, frame)
        b.limb((-0.2, 0.22 * side, 0.3), (0.25, 0.22 * side, 0.34), 0.014, 0.014, frame)
        b.limb((-0.25, 0.21 * side, 0.45), (-0.34, 0.21 * side, 0.98), 0.014, 0.014, frame)
        b.limb((-0.34, 0.21 * side, 0.98), (-0.44, 0.21 * side, 0.96), 0.016, 0.018, RUBBER)
        b.limb((0.25, 0.2 * side, 0.48), (0.42, 0.14 * side, 0.14), 0.014, 0.014, frame)
        inner, outer = sorted((0.03 * side, 0.19 * side))
        b.box((0.38, inner, 0.1), (0.55, outer, 0.12), frame)
        hip, knee = (-0.12, 0.09 * side, 0.56), (0.3, 0.11 * side, 0.58)
        ankle = (0.4, 0.11 * side, 0.2)
        b.limb(hip, knee, 0.085, 0.065, style.legs)
        b.limb(knee, ankle, 0.06, 0.045, style.legs)
        b.limb(ankle, (0.51, 0.11 * side, 0.155), 0.042, 0.036, style.shoes)
        push = 0.16 * math.sin(turned * 0.8)
        elbow, hand = (-0.28 + push * 0.3, 0.28 * side, 0.78), (-0.14 + push, 0.29 * side, 0.6)
        b.limb((-0.2, 0.185 * side, 1.02), elbow, 0.052, 0.042, style.top)
        b.limb(elbow, hand, 0.04, 0.034, style.top if style.sleeves else style.skin)
        b.limb(hand, hand, 0.042, 0.042, style.skin)
    b.box((-0.28, -0.21, 0.44), (0.24, 0.21, 0.49), (44, 44, 48))
    b.loft([(-0.27, 0, 0.46), (-0.36, 0, 0.92)], [[0.2, 0.02], [0.2, 0.02]], (40, 42, 46), sides=8)
    back = ((-0.16, 0.5), (-0.17, 0.62), (-0.19, 0.86), (-0.2, 1.0), (-0.2, 1.07), (-0.19, 1.1))
    b.loft(
        [(x, 0, z) for x, z in back],
        [[0.16, 0.12], [0.155, 0.115], [0.17, 0.12], [0.175, 0.105], [0.13, 0.08], [0.05, 0.05]],
        style.top,
    )
    head(b, (-0.18, 0.0, 1.07), 0.92, style)
    stretch = (size_m[0] / 1.1, size_m[1] / 0.65, size_m[2] / 1.31)
    return b.build().placed((0.0, 0.0), 0.0, stretch)
