"""The bodies of road users: parts that fill, and never leave, the object's box.

Body coordinates are forward, left, up from the object's ground centre, in metres for the standard
size and stretched to the agent's own.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from bikeped.conformance.scenario import SIZES_M
from bikeped.demo.pen import Face, Limb, Part, Placer, Rgb, Wire, facing, subdivided, tinted
from bikeped.types import FloatArray

_SKIN: tuple[Rgb, ...] = ((226, 180, 150), (150, 104, 78), (202, 152, 118), (112, 78, 60))
_TOPS: tuple[Rgb, ...] = ((196, 62, 58), (58, 110, 176), (232, 170, 48), (70, 140, 92))
_LEGS: tuple[Rgb, ...] = ((52, 60, 84), (66, 58, 52), (84, 88, 96), (40, 44, 50))
_PAINT: tuple[Rgb, ...] = ((60, 104, 150), (196, 200, 204), (150, 52, 48), (70, 90, 74))
_RUBBER: Rgb = (28, 28, 30)
_GLASS: Rgb = (48, 62, 74)
_STRIDE_M = 1.45  #: way of a walker in one full step cycle
_WHEEL_M = 0.32


def body(
    kind: str,
    number: int,
    size_m: tuple[float, float, float],
    xy_m: FloatArray,
    heading_rad: float,
    travelled_m: float,
    eye: FloatArray,
) -> list[Part]:
    """The parts of one road user of `kind` and `size_m` (length, width, height) at `xy_m` [2].

    `travelled_m` drives legs, pedals and wheels, so that a standing figure stands still; `eye` [3]
    is where the camera is.
    """
    shape = "cyclist" if kind == "motorcycle" else kind  # no body of its own: a rider, stretched
    usual = SIZES_M[shape]
    stretch = (size_m[0] / usual[0], size_m[1] / usual[1], size_m[2] / usual[2])
    place = _placer(xy_m, heading_rad, stretch)
    if shape == "car":
        return _car(number, place, eye)
    if shape in {"bus", "truck"}:
        return _box_vehicle(number, shape, place, eye)
    draw = _walker if shape == "pedestrian" else _rider
    girth = min(stretch)  # a child is not only shorter but slighter
    return [_slighter(part, girth) for part in draw(number, travelled_m, place)]


def _placer(xy_m: FloatArray, heading_rad: float, stretch: tuple[float, float, float]) -> Placer:
    """Body to world for an object at `xy_m` [2]; `stretch` scales length, width, height."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    sf, sl, su = stretch

    def place(forward: float, left: float, up: float) -> FloatArray:
        f, n = forward * sf, left * sl
        return np.array([xy_m[0] + c * f - s * n, xy_m[1] + s * f + c * n, up * su])

    return place


def _slighter(part: Part, girth: float) -> Part:
    if isinstance(part, Limb) and girth != 1:
        return replace(part, radius_a=part.radius_a * girth, radius_b=part.radius_b * girth)
    return part


def _walker(number: int, travelled_m: float, at: Placer) -> list[Part]:
    skin, top, legs = (c[number % len(c)] for c in (_SKIN, _TOPS, _LEGS))
    swing = math.sin(2 * math.pi * travelled_m / _STRIDE_M)
    parts: list[Part] = []
    for side, way in ((1, swing), (-1, -swing)):
        hip, knee = at(0, 0.075 * side, 0.93), at(0.05 + 0.03 * way, 0.08 * side, 0.5)
        lift = 0.05 * max(way, 0)
        foot = at(0.085 * way, 0.085 * side, 0.1 + lift)
        toe = at(0.085 * way + 0.02, 0.09 * side, 0.05 + lift / 2)
        parts += [Limb(hip, knee, 0.085, 0.06, legs), Limb(knee, foot, 0.06, 0.045, legs)]
        parts.append(Limb(foot, toe, 0.04, 0.04, _RUBBER))
        elbow = at(-0.02 - 0.03 * way, 0.2 * side, 1.13)
        hand = at(-0.085 * way, 0.2 * side, 0.88)
        parts.append(Limb(at(0, 0.175 * side, 1.36), elbow, 0.055, 0.045, tinted(top, 0.92)))
        parts += [Limb(elbow, hand, 0.042, 0.036, tinted(top, 0.92)), _ball(hand, 0.04, skin)]
    parts.append(Limb(at(0, 0, 0.95), at(0, 0, 1.32), 0.125, 0.14, top))
    parts.append(Limb(at(0, 0.14, 1.36), at(0, -0.14, 1.36), 0.075, 0.075, top))
    parts += [
        _ball(at(0.02, 0, 1.555), 0.108, skin),
        _ball(at(-0.025, 0, 1.58), 0.106, (58, 42, 34)),
    ]
    return parts


def _rider(number: int, travelled_m: float, at: Placer) -> list[Part]:
    skin, top, legs = (c[(number + 1) % len(c)] for c in (_SKIN, _TOPS, _LEGS))
    frame = _PAINT[(number + 2) % len(_PAINT)]
    parts: list[Part] = []
    roll = travelled_m / _WHEEL_M
    around = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    for hub in (-0.54, 0.54):
        rim = [at(hub + _WHEEL_M * math.cos(a), 0, 0.345 + _WHEEL_M * math.sin(a)) for a in around]
        parts.append(Wire(np.array(rim), 0.045, _RUBBER, closed=True))
        for spoke in range(4):
            a = roll + spoke * math.pi / 4
            f, u = 0.3 * math.cos(a), 0.3 * math.sin(a)
            ends = np.array([at(hub - f, 0, 0.345 - u), at(hub + f, 0, 0.345 + u)])
            parts.append(Wire(ends, 0.008, (150, 152, 156)))
    crank, seat, head = at(-0.04, 0, 0.30), at(-0.2, 0, 0.86), at(0.38, 0, 0.86)
    rear, front = at(-0.54, 0, 0.345), at(0.54, 0, 0.345)
    for one, other in (
        (crank, seat),
        (crank, head),
        (seat, head),
        (crank, rear),
        (seat, rear),
        (head, front),
    ):
        parts.append(Limb(one, other, 0.024, 0.024, frame))
    parts.append(Limb(at(-0.3, 0, 0.9), at(-0.1, 0, 0.9), 0.05, 0.035, _RUBBER))
    parts.append(Limb(at(0.4, 0.23, 0.98), at(0.4, -0.23, 0.98), 0.02, 0.02, _RUBBER))
    parts.append(Limb(head, at(0.4, 0, 0.98), 0.02, 0.02, _RUBBER))
    for side in (1, -1):
        turn = -roll * 0.42 + (0 if side > 0 else math.pi)  # a usual gear
        pedal_f, pedal_u = -0.04 + 0.16 * math.cos(turn), 0.30 + 0.16 * math.sin(turn)
        knee_f, knee_u = _knee((-0.2, 0.92), (pedal_f, pedal_u + 0.06))
        hip, knee = at(-0.2, 0.09 * side, 0.92), at(knee_f, 0.1 * side, knee_u)
        foot = at(pedal_f, 0.1 * side, pedal_u + 0.06)
        parts += [Limb(hip, knee, 0.085, 0.06, legs), Limb(knee, foot, 0.058, 0.042, legs)]
        parts.append(
            Limb(foot, at(pedal_f + 0.1, 0.1 * side, pedal_u + 0.03), 0.04, 0.035, _RUBBER)
        )
        elbow, hand = at(0.27, 0.225 * side, 1.15), at(0.4, 0.22 * side, 1.01)
        parts.append(Limb(at(0.1, 0.165 * side, 1.35), elbow, 0.055, 0.045, tinted(top, 0.92)))
        parts.append(Limb(elbow, hand, 0.042, 0.036, skin))
    parts.append(Limb(at(-0.2, 0, 0.98), at(0.08, 0, 1.33), 0.13, 0.14, top))
    parts.append(Limb(at(0.1, 0.13, 1.35), at(0.1, -0.13, 1.35), 0.075, 0.075, top))
    parts.append(_ball(at(0.2, 0, 1.535), 0.1, skin))
    parts.append(Limb(at(0.12, 0, 1.59), at(0.22, 0, 1.6), 0.092, 0.088, (238, 240, 236)))
    return parts


def _knee(hip: tuple[float, float], foot: tuple[float, float]) -> tuple[float, float]:
    """Where the knee goes so that thigh and shin (0.40 and 0.42 m) reach from hip to foot."""
    thigh, shin = 0.40, 0.42
    df, du = foot[0] - hip[0], foot[1] - hip[1]
    reach = min(math.hypot(df, du), thigh + shin - 1e-6)
    bend = math.acos(min(max((thigh**2 + reach**2 - shin**2) / (2 * thigh * reach), -1.0), 1.0))
    angle = math.atan2(du, df) + bend
    return hip[0] + thigh * math.cos(angle), hip[1] + thigh * math.sin(angle)


def _ball(centre: FloatArray, radius: float, colour: Rgb) -> Limb:
    return Limb(centre, centre, radius, radius, colour)


#: Side of a car from the rear bumper over the roof to the front: forward, up, what lies after it.
_CAR_SIDE: tuple[tuple[float, float, str], ...] = (
    (-2.18, 0.28, "paint"),
    (-2.22, 0.72, "paint"),
    (-2.08, 0.95, "paint"),
    (-1.62, 1.02, "glass"),
    (-1.02, 1.45, "paint"),
    (0.32, 1.49, "glass"),
    (1.10, 0.98, "paint"),
    (2.00, 0.84, "paint"),
    (2.22, 0.62, "paint"),
    (2.20, 0.28, "under"),
)


def _half_width(up: float) -> float:
    """Cars lean in above the waistline."""
    return 0.87 if up <= 1.0 else 0.87 - 0.34 * (up - 1.0)


def _car(number: int, at: Placer, eye: FloatArray) -> list[Part]:
    paint = _PAINT[number % len(_PAINT)]
    faces: list[Face] = []
    for (f0, u0, what), (f1, u1, _) in zip(_CAR_SIDE, (*_CAR_SIDE[1:], _CAR_SIDE[0]), strict=True):
        w0, w1 = _half_width(u0), _half_width(u1)
        strip = np.array([at(f0, -w0, u0), at(f0, w0, u0), at(f1, w1, u1), at(f1, -w1, u1)])
        slope = 1.06 if u0 > 0.8 and u1 > 0.8 else 0.86
        colour = _GLASS if what == "glass" else tinted(paint, slope)
        faces.append(Face(strip[::-1], (30, 32, 34) if what == "under" else colour))
    for side in (1, -1):
        shape = [at(f, side * _half_width(u), u) for f, u, _ in _CAR_SIDE]
        glass = ((-1.38, 1.04), (-0.95, 1.38), (0.26, 1.41), (0.86, 1.04))
        pane = [at(f, side * (_half_width(u) + 0.004), u) for f, u in glass]
        order = -1 if side < 0 else 1  # counter-clockwise from outside on either side
        faces.append(Face(np.array(shape)[::order], tinted(paint, 0.9)))
        faces.append(Face(np.array(pane)[::order], _GLASS, layer=1))
        faces += _wheels(at, (-1.35, 1.38), 0.32, side * 0.875, order)
        for f, colour in ((2.19, (250, 246, 220)), (-2.19, (190, 40, 40))):
            lamp = [
                at(f, side * w, u)
                for w, u in ((0.5, 0.62), (0.82, 0.62), (0.82, 0.76), (0.5, 0.76))
            ]
            turn = 1 if (f > 0) == (side > 0) else -1
            faces.append(Face(np.array(lamp)[::turn], colour, layer=1))
    return _shown(faces, eye)


def _box_vehicle(number: int, kind: str, at: Placer, eye: FloatArray) -> list[Part]:
    length, width, height = (11.8, 2.4, 2.95) if kind == "bus" else (6.8, 2.4, 2.75)
    paint = _PAINT[(number + 1) % len(_PAINT)]
    f, w, low, top = length / 2, width / 2, 0.35, height
    faces = [
        Face(
            np.array([at(-f, -w, top), at(f, -w, top), at(f, w, top), at(-f, w, top)]),
            tinted(paint, 1.1),
        ),
        Face(np.array([at(f, -w, low), at(f, w, low), at(f, w, top), at(f, -w, top)]), paint),
        Face(
            np.array([at(-f, w, low), at(-f, -w, low), at(-f, -w, top), at(-f, w, top)]),
            tinted(paint, 0.8),
        ),
    ]
    a, b = 0.55 * top, 0.85 * top
    screen = [
        at(f + 0.01, -w * 0.9, a),
        at(f + 0.01, w * 0.9, a),
        at(f + 0.01, w * 0.9, b),
        at(f + 0.01, -w * 0.9, b),
    ]
    faces.append(Face(np.array(screen), _GLASS, layer=1))
    back = -f * 0.95 if kind == "bus" else f * 0.62  # a truck has windows in its cab only
    for side in (1, -1):
        order = -1 if side > 0 else 1
        wall = [
            at(-f, side * w, low),
            at(f, side * w, low),
            at(f, side * w, top),
            at(-f, side * w, top),
        ]
        out = side * (w + 0.01)
        pane = [at(back, out, a), at(f * 0.95, out, a), at(f * 0.95, out, b), at(back, out, b)]
        faces.append(Face(np.array(wall)[::order], tinted(paint, 0.92)))
        faces.append(Face(np.array(pane)[::order], _GLASS, layer=1))
        faces += _wheels(at, (-f * 0.6, f * 0.68), 0.46, side * (w + 0.01), -order)
    return _shown(faces, eye)


def _wheels(
    at: Placer, hubs: tuple[float, float], radius: float, left: float, order: int
) -> list[Face]:
    turn = np.linspace(0, 2 * np.pi, 20, endpoint=False)[::-order]
    discs: list[Face] = []
    for hub in hubs:
        for r, colour, layer in ((radius, _RUBBER, 1), (radius * 0.58, (158, 162, 166), 2)):
            rim = [at(hub + r * math.cos(a), left, radius + 0.01 + r * math.sin(a)) for a in turn]
            discs.append(Face(np.array(rim), colour, layer))
    return discs


def _shown(faces: list[Face], eye: FloatArray) -> list[Part]:
    """The faces turned to the camera, their edges cut up to follow the lens."""
    return [
        Face(
            subdivided(face.points, 8) if len(face.points) < 12 else face.points,
            face.colour,
            face.layer,
        )
        for face in faces
        if facing(face.points, eye)
    ]
