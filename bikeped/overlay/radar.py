"""A polar bird's-eye view: the camera low in the middle, forward up, rings every 5 m."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bikeped.overlay.drawing import (
    KIND_COLOUR,
    PAPER,
    SIGNAL_COLOUR,
    Rect,
    Rgb,
    arrow,
    circle,
    dashed,
    draw_tag,
    draw_text,
    fill_rect,
    place_label,
    polygon,
    polyline,
    shade,
    text_size,
)
from bikeped.overlay.overlay_data import OverlayData
from bikeped.types import BoolArray, FloatArray, ImageArray, Kind

RING_STEP_M = 5.0
#: An arrow shows where its object will be after this long.
ARROW_S = 1.0
_GROUND: Rgb = (18, 24, 32)
_SEEN: Rgb = (30, 42, 55)
_RING: Rgb = (74, 92, 110)
_FAINT: Rgb = (150, 164, 178)
#: Share of the range that is shown behind the camera: a 198-degree lens sees little of it.
_BEHIND = 0.2


@dataclass(frozen=True)
class RadarProjection:
    """Where ground metres lie in a radar picture of `width` x `height` pixels."""

    width: int
    height: int
    range_m: float
    u0: float  #: the camera's pixel
    v0: float
    px_per_m: float

    @staticmethod
    def fit(width: int, height: int, range_m: float = 25.0) -> RadarProjection:
        """The largest radar that fits, `range_m` ahead and to both sides, a fifth of it behind."""
        margin = max(round(min(width, height) * 0.03), 6)
        side = (width / 2 - margin) / range_m
        tall = (height - 2 * margin) / (range_m * (1 + _BEHIND))
        scale = min(side, tall)
        top = margin + max(0.0, (tall - scale) * range_m * (1 + _BEHIND)) * 0.25
        return RadarProjection(width, height, range_m, width / 2, top + scale * range_m, scale)

    def pixels(self, xy_m: npt.ArrayLike) -> FloatArray:
        """Radar pixels [..., 2] of camera ground positions [..., 2] (x forward, y right)."""
        xy = np.asarray(xy_m, dtype=np.float64)
        return np.stack(
            [self.u0 + self.px_per_m * xy[..., 1], self.v0 - self.px_per_m * xy[..., 0]], axis=-1
        )


def draw_radar(
    data: OverlayData,
    size: tuple[int, int],
    *,
    range_m: float = 25.0,
    fov_deg: float = 198.0,
    heading_deg: float = 0.0,
) -> ImageArray:
    """The radar as a picture of `size` (width, height).

    `heading_deg`: the optical axis, to the right of the ground frame's x axis; it turns the
    field of view's wedge. Tracks beyond `range_m` are drawn as marks on the outermost ring.
    """
    frame = RadarProjection.fit(size[0], size[1], range_m)
    image = _base(frame, fov_deg, heading_deg).copy()
    text = _text_height(size)
    tracks = data.tracks
    rows = data.pair_rows()
    reach = np.hypot(tracks.xy_m[:, 0], tracks.xy_m[:, 1])
    near = reach <= range_m
    taken: list[Rect] = []
    paired = rows if rows is not None and near[list(rows)].all() else None

    _draw_trails(image, frame, data, near)
    if paired is not None:
        _draw_pair(image, frame, data, paired)
    labels: list[tuple[bool, int, FloatArray]] = []
    for row in range(len(tracks)):
        kind = Kind(int(tracks.kind[row]))
        at = frame.pixels(tracks.xy_m[row])
        if not near[row]:
            rim = frame.pixels(tracks.xy_m[row] / max(reach[row], 1e-9) * range_m)
            circle(image, rim, text * 0.35, shade(KIND_COLOUR[kind], 0.7))
            continue
        in_pair = rows is not None and row in rows
        if in_pair and data.alerting:
            circle(image, at, text * 1.45, SIGNAL_COLOUR["ALERT"], max(round(text / 4), 2))
        velocity = tracks.velocity_mps[row]
        if np.hypot(*velocity) > 0.3:
            tip = frame.pixels(tracks.xy_m[row] + velocity * ARROW_S)
            arrow(image, at, tip, KIND_COLOUR[kind], max(round(text / 7), 1), text * 0.6)
        heading = math.atan2(velocity[1], velocity[0])
        _symbol(image, kind, at, text * 0.62, heading, unseen=bool(tracks.detection[row] < 0))
        labels.append((in_pair, row, at))
    if paired is not None:
        _draw_distance(image, frame, data, paired, text, taken)
    labels.sort(key=lambda item: not item[0])
    for _, row, at in labels:
        _draw_label(image, data, row, at, text, taken)
    _draw_list(image, frame, data, reach, text)
    return image


def _text_height(size: tuple[int, int]) -> int:
    return int(np.clip(round(min(size) / 41), 9, 18))


@functools.lru_cache(maxsize=8)
def _base(frame: RadarProjection, fov_deg: float, heading_deg: float) -> ImageArray:
    """Rings, spokes, field of view and camera: drawn once, as they stay the same."""
    image: ImageArray = np.empty((frame.height, frame.width, 3), np.uint8)
    image[:] = _GROUND
    text = _text_height((frame.width, frame.height))
    half = math.radians(min(fov_deg, 360.0)) / 2
    turn = math.radians(heading_deg) + np.linspace(-half, half, 181)
    arc = frame.range_m * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    wedge = np.concatenate([np.zeros((1, 2)), arc])
    polygon(image, frame.pixels(wedge), _SEEN)
    full = np.linspace(-np.pi, np.pi, 721)
    unit = np.stack([np.cos(full), np.sin(full)], axis=1)
    for degrees in range(-90, 91, 30):
        a = math.radians(degrees)
        spoke = np.array([[0.0, 0.0], [frame.range_m * math.cos(a), frame.range_m * math.sin(a)]])
        polyline(image, frame.pixels(spoke), shade(_RING, 0.6), 1)
    rings = np.arange(RING_STEP_M, frame.range_m + 1e-6, RING_STEP_M)
    for ring in rings.tolist():
        shown = np.where((ring * unit[:, :1]) >= -frame.range_m * _BEHIND, ring * unit, np.nan)
        polyline(image, frame.pixels(shown), _RING, 1)
    for ring in rings.tolist():
        # On the 15-degree ray, between the spokes, where neither the way ahead nor a spoke is hit.
        at = frame.pixels([ring * math.cos(math.radians(15)), ring * math.sin(math.radians(15))])
        word = f"{ring:.0f} m"
        wide = text_size(word, text)[0]
        u, v = at[0], at[1]
        back = (u - wide / 2 - 2, v - text / 2 - 3, u + wide / 2 + 2, v + text / 2 + 3)
        fill_rect(image, back, _SEEN if ring < frame.range_m else _GROUND)
        draw_text(image, word, (at[0], at[1] - text / 2), text, _FAINT, anchor="centre")
    edge = frame.pixels(np.stack([arc[0], np.zeros(2), arc[-1]]))
    dashed(image, edge, _FAINT, 1, 5.0)
    camera = frame.pixels([0.0, 0.0])
    body = np.array([[-0.9, 0.75], [-0.9, -0.75], [0.35, -0.4], [0.35, 0.4]]) * text
    turned = body @ _rotation(math.radians(heading_deg))
    polygon(image, camera + np.stack([turned[:, 1], -turned[:, 0]], axis=1), PAPER)
    draw_text(image, "camera", (camera[0], camera[1] + text * 1.4), text, _FAINT, anchor="centre")
    image.setflags(write=False)
    return image


def _draw_trails(
    image: ImageArray, frame: RadarProjection, data: OverlayData, near: BoolArray
) -> None:
    tracks = data.tracks
    kinds = dict(zip(tracks.id[near].tolist(), tracks.kind[near].tolist(), strict=True))
    for track_id, trail in data.history.items():
        if track_id not in kinds or len(trail) < 2:
            continue
        points = frame.pixels(trail)
        colour = KIND_COLOUR[Kind(kinds[track_id])]
        # Older parts are darker, so that the trail shows the direction.
        for part, fade in (
            (points[: len(points) // 2 + 1], 0.4),
            (points[len(points) // 2 :], 0.65),
        ):
            polyline(image, part, shade(colour, fade), 2)


def _draw_pair(
    image: ImageArray, frame: RadarProjection, data: OverlayData, rows: tuple[int, int]
) -> None:
    ends = frame.pixels(data.tracks.xy_m[list(rows)])
    colour = data.pair_colour
    if data.alerting:
        polyline(image, ends, PAPER, 5)
        polyline(image, ends, colour, 3)
    else:
        dashed(image, ends, colour, 2, 6.0)


def _draw_distance(
    image: ImageArray,
    frame: RadarProjection,
    data: OverlayData,
    rows: tuple[int, int],
    text: int,
    taken: list[Rect],
) -> None:
    """The pair's distance on its line, above arrows and symbols."""
    pair = data.decision.pair
    if pair is None:
        return
    ends = frame.pixels(data.tracks.xy_m[list(rows)])
    word = f"{pair.distance_m:.1f} m"
    if np.hypot(*(ends[1] - ends[0])) < text_size(word, text, True)[0] + 4 * text:
        return  # no room on the line; the list below has the distance
    u, v = ends.mean(axis=0)
    taken.append(draw_tag(image, word, (u, v), text, data.pair_colour))


def _rotation(angle_rad: float) -> FloatArray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, s], [-s, c]])


def _symbol(
    image: ImageArray, kind: Kind, at: FloatArray, radius: float, heading: float, *, unseen: bool
) -> None:
    """Disc: pedestrian; arrowhead: cyclist; square: vehicle. Hollow while unseen."""
    colour = KIND_COLOUR[kind]
    if kind is Kind.PEDESTRIAN:
        circle(image, at, radius + 1.5, _GROUND)
        circle(image, at, radius, colour)
        if unseen:
            circle(image, at, radius * 0.55, _GROUND)
        return
    if kind is Kind.CYCLIST:
        shape = np.array([[1.5, 0.0], [-1.0, 1.05], [-0.45, 0.0], [-1.0, -1.05]])
    else:
        shape = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    turned = shape @ _rotation(heading)
    offset = np.stack([turned[:, 1], -turned[:, 0]], axis=1)
    polygon(image, at + offset * (radius * 1.15 + 1.5), _GROUND)
    polygon(image, at + offset * radius * 1.15, colour)
    if unseen:
        polygon(image, at + offset * radius * 0.6, _GROUND)


def _draw_label(
    image: ImageArray, data: OverlayData, row: int, at: FloatArray, text: int, taken: list[Rect]
) -> None:
    word = str(data.tracks.id[row])
    reach = text * 1.1
    box: Rect = (at[0] - reach, at[1] - reach, at[0] + reach, at[1] + reach)
    h, w = image.shape[:2]
    size = (float(text_size(word, text, True)[0] + 4), text + 4.0)
    spot = place_label(size, box, taken, (0, 0, w, h), gap=0)
    taken.append(spot)
    kind = Kind(int(data.tracks.kind[row]))
    draw_text(image, word, (spot[0] + 2, spot[1] + 2), text, KIND_COLOUR[kind], bold=True)


def _draw_list(
    image: ImageArray, frame: RadarProjection, data: OverlayData, reach: FloatArray, text: int
) -> None:
    """Table of the tracks below the radar, nearest first, as many as fit."""
    tracks = data.tracks
    top = frame.v0 + frame.range_m * frame.px_per_m * _BEHIND + text * 1.6
    line = text * 2.1
    room = int((frame.height - top - text * 0.6) / line)
    if room < 2:
        return
    left = frame.u0 - frame.range_m * frame.px_per_m
    width = 2 * frame.range_m * frame.px_per_m
    columns = [left + text * 2.2, left + width * 0.56, left + width * 0.78, left + width]
    for x, word in zip(columns[1:], ("distance", "speed", ""), strict=True):
        draw_text(image, word, (x, top), text, _FAINT, anchor="right")
    draw_text(image, "track", (columns[0], top), text, _FAINT)
    order = np.argsort(reach, kind="stable").tolist()
    for i, row in enumerate(order[: room - 1]):
        y = top + (i + 1) * line
        kind = Kind(int(tracks.kind[row]))
        unseen = bool(tracks.detection[row] < 0)
        at = np.array([left + text * 0.8, y + text / 2])
        _symbol(image, kind, at, text * 0.55, 0.0, unseen=unseen)
        draw_text(image, f"{kind.label} {tracks.id[row]}", (columns[0], y), text, PAPER)
        far = f"{reach[row]:.1f} m"
        draw_text(image, far, (columns[1], y), text, PAPER, anchor="right")
        speed = f"{np.hypot(*tracks.velocity_mps[row]):.1f} m/s"
        draw_text(image, speed, (columns[2], y), text, PAPER, anchor="right")
        if unseen:
            draw_text(image, "unseen", (columns[3], y), text, _FAINT, anchor="right")
