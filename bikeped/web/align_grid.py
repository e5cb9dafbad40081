"""The ground grid in a picture: metre lines, range rings, bearings, horizon, image circle.

All lines are projected by `GroundCamera.project`, as the service's positions are. The page draws
them itself; `draw_grid` is for `bikeped align --grid` and for documents.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import numpy.typing as npt

from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.overlay.drawing import INK, Rgb, draw_text, fill_rect, polyline, text_size
from bikeped.types import BoolArray, FloatArray, ImageArray

RINGS_M = (5.0, 10.0, 15.0, 20.0, 25.0)
#: Lines every metre out to here, every five metres out to the largest ring.
METRE_LINES_M = 10.0
REACH_M = RINGS_M[-1]
_BEARINGS_DEG = tuple(range(-90, 91, 15))
_FAR_M = 1e7  #: distance that stands for the horizon
_LABEL_BEARINGS_DEG = (-7.0, -45.0, 38.0)  #: beside the lines, not on them
#: Colour and width (in sixteen-hundredths of the picture's width) of each kind of line, in order.
_STYLE: dict[str, tuple[Rgb, float]] = {
    "circle": ((255, 255, 255), 1.0),
    "metre": ((230, 236, 240), 0.8),
    "five": ((255, 255, 255), 1.3),
    "bearing": ((130, 215, 255), 1.0),
    "ring": ((255, 208, 40), 2.0),
    "ahead": ((255, 255, 255), 2.6),
    "horizon": ((255, 110, 240), 2.0),
}
_MARK: Rgb = (255, 80, 60)


@dataclass(frozen=True)
class Label:
    """A text at a frame pixel; `kind` is that of the line it belongs to."""

    u: float
    v: float
    text: str
    kind: str


@dataclass(frozen=True)
class GroundGrid:
    """Polylines by kind, each as u, v, u, v, ... in frame pixels, and labels.

    Kinds: metre, five, ahead, ring, bearing, horizon, circle. `centre` is the optical centre,
    `foot` the ground below the lens where the lens model has it.
    """

    lines: dict[str, list[list[float]]]
    labels: list[Label]
    centre: tuple[float, float]
    foot: tuple[float, float] | None


def ground_grid(camera: GroundCamera, framing: Framing) -> GroundGrid:
    """The grid of `camera` in frames of `framing` (see `Framing.for_frame`).

    Lines are not clipped at the picture's edges: they go as far as the lens sees.
    """
    open_camera = replace(camera, window_px=None)
    kinds, points, ends = _ground_lines()
    uv, seen = open_camera.project(points)
    frame_uv = framing.crop_to_frame(uv)
    lines: dict[str, list[list[float]]] = {}
    for kind, start, end in zip(kinds, ends[:-1], ends[1:], strict=True):
        lines.setdefault(kind, []).extend(_runs(frame_uv[start:end], seen[start:end]))
    lines["horizon"] = _horizon(open_camera, framing)
    angle = np.linspace(0, 2 * math.pi, 181)
    circle = camera.lens.max_radius_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rim = framing.crop_to_frame(circle + np.array([camera.cx, camera.cy]))
    lines["circle"] = _runs(rim, np.ones(len(rim), np.bool_))
    centre = framing.crop_to_frame((camera.cx, camera.cy)).tolist()
    foot, foot_seen = open_camera.project([[0.0, 0.0]])
    foot_px = framing.crop_to_frame(foot[0]).tolist() if foot_seen[0] else None
    return GroundGrid(
        lines, _labels(open_camera, framing), tuple(centre), foot_px and tuple(foot_px)
    )


@cache
def _ground_lines() -> tuple[list[str], FloatArray, list[int]]:
    """Kind of each line, all points [n, 3] on the ground, and where each line begins and ends."""
    kinds: list[str] = []
    parts: list[FloatArray] = []

    def add(kind: str, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> None:
        x, y = np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))
        kinds.append(kind)
        parts.append(np.stack([x, y, np.zeros_like(x)], axis=1))

    near = METRE_LINES_M
    for metre in range(-int(near), int(near) + 1):
        if metre % 5 == 0:
            continue
        add("metre", np.linspace(0, near, 81), float(metre))
        if metre > 0:
            add("metre", float(metre), np.linspace(-near, near, 121))
    for five in range(-int(REACH_M), int(REACH_M) + 1, 5):
        half = math.sqrt(REACH_M**2 - five**2)
        if half == 0:
            continue
        add("ahead" if five == 0 else "five", np.linspace(0, half, 121), float(five))
        if five >= 0:
            add("five", float(five), np.linspace(-half, half, 201))
    for ring in RINGS_M:
        angle = np.radians(np.linspace(-180, 180, 241))
        add("ring", ring * np.cos(angle), ring * np.sin(angle))
    for bearing in _BEARINGS_DEG:
        if bearing:
            along = np.linspace(2.0, REACH_M, 41)
            turn = math.radians(bearing)
            add("bearing", along * math.cos(turn), along * math.sin(turn))
    ends = [0, *np.cumsum([len(part) for part in parts]).tolist()]
    return kinds, np.concatenate(parts), ends


def _horizon(camera: GroundCamera, framing: Framing) -> list[list[float]]:
    angle = np.radians(np.linspace(-180, 180, 241))
    level = np.full_like(angle, camera.height_m)
    far = np.stack([_FAR_M * np.cos(angle), _FAR_M * np.sin(angle), level], axis=1)
    uv, seen = camera.project(far)
    return _runs(framing.crop_to_frame(uv), seen)


def _labels(camera: GroundCamera, framing: Framing) -> list[Label]:
    """Labels of rings and bearings that are in view."""
    # bearing in degrees, range and height in metres, text, kind
    labels = [
        (bearing, ring, 0.0, f"{ring:g} m", "ring")
        for bearing in _LABEL_BEARINGS_DEG
        for ring in RINGS_M
    ]
    for bearing in _BEARINGS_DEG:
        text = f"{abs(bearing)}\u00b0 {'L' if bearing < 0 else 'R'}" if bearing else "ahead"
        labels.append((bearing, _FAR_M, camera.height_m, text, "horizon"))
    angle, range_m, height_m = np.array([label[:3] for label in labels]).T
    angle = np.radians(angle)
    xyz = np.stack([range_m * np.cos(angle), range_m * np.sin(angle), height_m], axis=1)
    uv, seen = camera.project(xyz)
    frame_uv = framing.crop_to_frame(uv).round(1).tolist()
    return [
        Label(u, v, text, kind)
        for (u, v), (*_, text, kind), visible in zip(frame_uv, labels, seen, strict=True)
        if visible
    ]


def _runs(uv: FloatArray, seen: BoolArray) -> list[list[float]]:
    """The visible parts of a line [n, 2], each as u, v, u, v, ..., to a tenth of a pixel."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    flat = np.round(uv, 1)
    return [
        flat[start:end].ravel().tolist()
        for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        if end - start > 1
    ]


def draw_grid(
    rgb: ImageArray, grid: GroundGrid, marks: tuple[tuple[str, float, float], ...] = ()
) -> ImageArray:
    """A copy of `rgb` [h, w, 3] with the grid and marks (name, u, v) over it."""
    image = np.ascontiguousarray(rgb).copy()
    h, w = image.shape[:2]
    unit = max(w / 1600, 0.5)
    for colour, more in ((INK, 2.0), (None, 0.0)):
        for kind, (own, width) in _STYLE.items():
            for line in grid.lines.get(kind, []):
                thick = max(1, round(unit * (width + more)))
                polyline(image, np.array(line).reshape(-1, 2), colour or own, thick)
    size = max(9, round(11 * unit))
    for label in grid.labels:
        colour = _STYLE[label.kind][0]
        lift = 2.2 * size if label.kind == "horizon" else 0.5 * size
        _tag(image, label.text, (label.u, label.v - lift), size, colour)
    for name, u, v in marks:
        arm = 9 * unit
        for start, end in (((u - arm, v), (u + arm, v)), ((u, v - arm), (u, v + arm))):
            cross = np.array([start, end])
            polyline(image, cross, INK, max(2, round(4 * unit)))
            polyline(image, cross, _MARK, max(1, round(2 * unit)))
        _tag(image, name, (u + 2 * arm, v - arm), size, _MARK)
    return image[:h, :w]


def _tag(image: ImageArray, text: str, at: tuple[float, float], size: int, colour: Rgb) -> None:
    half = text_size(text, size)[0] / 2 + 0.4 * size
    h, w = image.shape[:2]
    u, v = at
    if not (0 <= u < w and 0 <= v < h):
        return
    fill_rect(image, (u - half, v - 0.4 * size, u + half, v + 1.4 * size), INK, 0.7)
    draw_text(image, text, (u, v), size, colour, anchor="centre")
