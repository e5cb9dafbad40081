"""Cyclists and riders of e-scooters and motorcycles."""

from __future__ import annotations

import math

from bikeped.lab.rendering.mesh import Mesh, MeshBuilder, Point, Rgb, Size
from bikeped.lab.rendering.people import RUBBER, Appearance, head

#: A cyclist agent shorter than this stands on an e-scooter.
SCOOTER_MAX_LENGTH_M = 1.5
PAINTS: tuple[Rgb, ...] = (
    (170, 40, 40), (40, 78, 140), (28, 30, 34), (214, 214, 210), (60, 120, 80), (220, 150, 40),
    (90, 94, 100), (120, 170, 180),
)  # fmt: skip
_WHEEL_M = 0.335
_LAMP: Rgb = (255, 250, 225)
_TAIL: Rgb = (230, 30, 26)


def rider(
    kind: str, size_m: Size, style: Appearance, paint: int, travel_m: float, sides: int = 8
) -> Mesh:
    """A cyclist or motorcycle agent's mesh in its own axes."""
    if kind == "motorcycle":
        return _motorcycle(size_m, style, paint, travel_m, sides)
    if size_m[0] < SCOOTER_MAX_LENGTH_M:
        return _scooter(size_m, style, paint, sides)
    return _bicycle(size_m, style, paint, travel_m, sides)


def _bicycle(size_m: Size, style: Appearance, paint: int, travel_m: float, sides: int) -> Mesh:
    b = MeshBuilder(sides)
    frame = PAINTS[paint % len(PAINTS)]
    sporty = paint % 3 == 0  # bent low over the bars, or upright
    roll = travel_m / _WHEEL_M
    rear, front, crank = (-0.53, 0.0, _WHEEL_M), (0.54, 0.0, _WHEEL_M), (-0.06, 0.0, 0.29)
    for hub in (rear, front):
        b.wheel(hub, _WHEEL_M, 0.022, RUBBER, spokes=7, turned=-roll)
        b.limb((hub[0], -0.05, hub[2]), (hub[0], 0.05, hub[2]), 0.025, 0.025, (110, 112, 116))
    seat, low, top = (-0.2, 0.0, 0.9), (0.37, 0.0, 0.64), (0.33, 0.0, 0.84)
    for one, other in ((crank, (-0.18, 0.0, 0.82)), (crank, low), ((-0.17, 0.0, 0.78), top)):
        b.limb(one, other, 0.02, 0.02, frame)
    b.limb(low, top, 0.022, 0.022, frame)
    for y in (0.05, -0.05):
        b.limb((rear[0], y, rear[2]), (crank[0], y * 0.6, crank[2]), 0.011, 0.011, frame)
        b.limb((rear[0], y, rear[2]), (-0.17, y * 0.4, 0.78), 0.011, 0.011, frame)
        b.limb((front[0], y, front[2]), (0.39, y * 0.7, 0.62), 0.014, 0.014, frame)
    b.limb((-0.18, 0, 0.8), seat, 0.014, 0.014, (150, 150, 154))
    b.limb((-0.32, 0, 0.93), (-0.06, 0, 0.93), 0.055, 0.028, RUBBER)
    bar = (0.4, 0.0, 0.98) if sporty else (0.3, 0.0, 1.06)
    b.limb(top, bar, 0.016, 0.016, (60, 62, 66))
    b.limb((bar[0], 0.26, bar[2]), (bar[0], -0.26, bar[2]), 0.015, 0.015, (50, 52, 56))
    if not sporty:  # mudguard and rack
        b.limb((-0.78, 0, 0.7), (-0.34, 0, 0.72), 0.02, 0.02, (70, 72, 76))
        if paint % 2:
            b.box((-0.82, -0.14, 0.42), (-0.42, -0.06, 0.7), style.legs)
    b.limb((bar[0] + 0.05, 0, bar[2] - 0.1), (bar[0] + 0.08, 0, bar[2] - 0.1), 0.03, 0.03, _LAMP)
    b.lamp((bar[0] + 0.1, 0, bar[2] - 0.1), _LAMP, 0.35)
    b.lamp((-0.3, 0, 0.8), _TAIL, 0.15)
    b.limb((-0.28, 0, 0.8), (-0.29, 0, 0.8), 0.022, 0.022, _TAIL)
    hip = (-0.2, 0.0, 0.97)
    chest = (0.13, 0.0, 1.31) if sporty else (0.0, 0.0, 1.4)
    g = style.girth
    for side in (1.0, -1.0):
        turn = -roll * 0.42 + (0 if side > 0 else math.pi)  # a usual gear
        pedal = (crank[0] + 0.165 * math.cos(turn), crank[2] + 0.165 * math.sin(turn))
        axle = (crank[0], 0.08 * side, crank[2])
        b.limb(axle, (pedal[0], 0.09 * side, pedal[1]), 0.012, 0.012, (130, 132, 136))
        ankle = (pedal[0] - 0.05, pedal[1] + 0.11)
        knee_x, knee_z = _knee((hip[0], hip[2] - 0.02), ankle, 0.42, 0.41)
        y = 0.1 * side
        thigh, knee = (hip[0], 0.085 * side, hip[2] - 0.02), (knee_x, y * 1.2, knee_z)
        shin = style.legs if style.wear != "shorts" else style.skin
        b.limb(thigh, knee, 0.088 * g, 0.064 * g, style.legs)
        b.limb(knee, (ankle[0], y, ankle[1]), 0.06, 0.043, shin)
        heel, toe = (ankle[0] - 0.03, y, ankle[1] - 0.05), (pedal[0] + 0.1, y, pedal[1] + 0.04)
        b.limb(heel, toe, 0.038, 0.032, style.shoes)
        shoulder = (chest[0] + 0.02, 0.185 * side * g, chest[2])
        hand = (bar[0], 0.24 * side, bar[2] + 0.03)
        middle_x, middle_z = (shoulder[0] + hand[0]) / 2, (shoulder[2] + hand[2]) / 2
        elbow = (middle_x - 0.04, 0.27 * side, middle_z - 0.06)
        _arm(b, shoulder, elbow, hand, style)
    _torso(b, hip, chest, style)
    neck = (chest[0] + 0.07, 0.0, chest[2] + 0.07)
    head(b, neck, 1.0, style, helmet=True)
    top_m = neck[2] + 0.26
    return b.build().placed((0, 0), 0.0, (size_m[0] / 1.76, size_m[1] / 0.6, size_m[2] / top_m))


def _torso(b: MeshBuilder, hip: Point, chest: Point, style: Appearance) -> None:
    """From the seat to the shoulders, along a leaning spine."""
    g = style.girth

    def along(part: float) -> Point:
        return tuple(h + (c - h) * part for h, c in zip(hip, chest, strict=True))  # type: ignore[return-value]

    rows = ((-0.18, 0.11, 0.09), (0.0, 0.165, 0.12), (0.3, 0.15, 0.11), (0.75, 0.172, 0.122),
            (1.0, 0.178, 0.105), (1.14, 0.12, 0.08), (1.22, 0.05, 0.05))  # fmt: skip
    bands = [style.legs] * 2 + [style.top] * 4
    b.loft([along(p) for p, _, _ in rows], [[w * g, d * g] for _, w, d in rows], bands)
    if style.pack is not None:
        p, q = along(0.35), along(0.95)
        b.limb((p[0] - 0.15, 0, p[2] + 0.05), (q[0] - 0.16, 0, q[2] + 0.05), 0.12, 0.1, style.pack)


def _arm(b: MeshBuilder, shoulder: Point, elbow: Point, hand: Point, style: Appearance) -> None:
    g = style.girth
    b.limb(shoulder, elbow, 0.055 * g, 0.044 * g, style.top)
    b.limb(elbow, hand, 0.042 * g, 0.033, style.top if style.sleeves else style.skin)
    b.limb(hand, hand, 0.042, 0.042, style.skin)


def _knee(
    hip: tuple[float, float], foot: tuple[float, float], thigh: float, shin: float
) -> tuple[float, float]:
    """Where the knee goes, forward and up, so that thigh and shin reach from hip to foot."""
    df, du = foot[0] - hip[0], foot[1] - hip[1]
    reach = min(math.hypot(df, du), thigh + shin - 1e-6)
    bend = math.acos(min(max((thigh**2 + reach**2 - shin**2) / (2 * thigh * reach), -1.0), 1.0))
    angle = math.atan2(du, df) + bend
    return hip[0] + thigh * math.cos(angle), hip[1] + thigh * math.sin(angle)


def _scooter(size_m: Size, style: Appearance, paint: int, sides: int) -> Mesh:
    """A rider standing on an e-scooter, 1.2 x 0.5 x 1.75 m."""
    b = MeshBuilder(sides)
    frame = PAINTS[(paint + 2) % len(PAINTS)]
    for x in (-0.47, 0.47):
        b.wheel((x, 0, 0.115), 0.115, 0.03, RUBBER, steps=14)
        b.disc((x, 0.03, 0.115), 0.06, 1, (120, 122, 126))
        b.disc((x, -0.03, 0.115), 0.06, -1, (120, 122, 126))
    b.box((-0.42, -0.08, 0.11), (0.32, 0.08, 0.16), frame, pieces=2)
    b.limb((-0.6, 0, 0.2), (-0.4, 0, 0.25), 0.02, 0.03, frame)
    b.limb((0.32, 0, 0.14), (0.44, 0, 0.3), 0.03, 0.03, frame)
    b.limb((0.47, 0, 0.12), (0.36, 0, 1.12), 0.026, 0.022, frame)
    b.limb((0.35, 0.24, 1.13), (0.35, -0.24, 1.13), 0.016, 0.016, RUBBER)
    b.limb((0.4, 0, 1.0), (0.42, 0, 1.0), 0.03, 0.03, _LAMP)
    b.lamp((0.44, 0, 1.0), _LAMP, 0.3)
    b.lamp((-0.6, 0, 0.25), _TAIL, 0.12)
    hip = (-0.1, 0.0, 1.02)
    chest = (-0.04, 0.0, 1.47)
    for side, foot in ((1.0, 0.1), (-1.0, -0.24)):
        ankle = (foot - 0.04, 0.25)
        knee = _knee((hip[0], hip[2] - 0.06), ankle, 0.41, 0.4)
        y = 0.055 * side
        shin = style.legs if style.wear != "shorts" else style.skin
        b.limb((hip[0], 0.085 * side, 0.96), (knee[0], y * 1.4, knee[1]), 0.085, 0.062, style.legs)
        b.limb((knee[0], y * 1.4, knee[1]), (ankle[0], y, ankle[1]), 0.058, 0.044, shin)
        b.limb((ankle[0] - 0.03, y, 0.2), (ankle[0] + 0.16, y, 0.2), 0.042, 0.036, style.shoes)
        elbow, hand = (0.1, 0.26 * side, 1.22), (0.33, 0.2 * side, 1.15)
        _arm(b, (chest[0], 0.19 * side, 1.45), elbow, hand, style)
    _torso(b, hip, chest, style)
    head(b, (0.0, 0.0, 1.56), 1.0, style, helmet=True)
    return b.build().placed((0, 0), 0.0, (size_m[0] / 1.2, size_m[1] / 0.52, size_m[2] / 1.82))


def _motorcycle(size_m: Size, style: Appearance, paint: int, travel_m: float, sides: int) -> Mesh:
    b = MeshBuilder(sides)
    colour = PAINTS[(paint + 1) % len(PAINTS)]
    for x in (-0.72, 0.74):
        b.wheel((x, 0, 0.31), 0.31, 0.07, RUBBER, spokes=5, turned=-travel_m / 0.31)
        b.limb((x, -0.06, 0.31), (x, 0.06, 0.31), 0.1, 0.1, (100, 102, 106))
    b.limb((-0.25, 0, 0.42), (0.25, 0, 0.42), 0.17, 0.19, (52, 54, 58))
    b.limb((-0.1, 0, 0.75), (0.3, 0, 0.78), 0.13, 0.17, colour)
    b.limb((-0.85, 0, 0.82), (-0.15, 0, 0.78), 0.08, 0.13, RUBBER)
    b.limb((-0.72, 0, 0.31), (-0.2, 0, 0.36), 0.04, 0.06, (70, 72, 76))
    b.limb((-0.9, -0.16, 0.36), (-0.3, -0.16, 0.32), 0.05, 0.04, (150, 150, 154))
    for y in (0.09, -0.09):
        b.limb((0.74, y, 0.31), (0.5, y, 0.95), 0.03, 0.03, (140, 142, 146))
    b.limb((0.5, 0, 0.88), (0.58, 0, 0.88), 0.13, 0.1, colour)
    b.limb((0.62, 0, 0.86), (0.66, 0, 0.86), 0.08, 0.07, _LAMP, 1)
    b.lamp((0.72, 0, 0.86), _LAMP, 0.8)
    b.lamp((-0.95, 0, 0.8), _TAIL, 0.3)
    b.limb((0.42, 0.36, 1.02), (0.42, -0.36, 1.02), 0.02, 0.02, RUBBER)
    hip, chest = (-0.22, 0.0, 0.9), (0.0, 0.0, 1.28)
    for side in (1.0, -1.0):
        knee, ankle = (0.15, 0.22 * side, 0.78), (-0.08, 0.2 * side, 0.4)
        b.limb((hip[0], 0.1 * side, hip[2]), knee, 0.09, 0.07, style.legs)
        b.limb(knee, ankle, 0.065, 0.05, style.legs)
        b.limb((ankle[0], ankle[1], 0.34), (0.1, 0.2 * side, 0.32), 0.045, 0.04, style.shoes)
        _arm(b, (0.02, 0.19 * side, 1.26), (0.2, 0.32 * side, 1.08), (0.4, 0.3 * side, 1.05), style)
    _torso(b, hip, chest, style)
    b.ball((0.09, 0, 1.5), (0.15, 0.13, 0.145), style.helmet or (40, 42, 46))
    b.ball((0.17, 0, 1.5), (0.09, 0.1, 0.06), (24, 28, 34), 1)
    return b.build().placed((0, 0), 0.0, (size_m[0] / 2.1, size_m[1] / 0.76, size_m[2] / 1.645))
