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
from bikeped.types import FloatArray, ImageArray, Kind

#: Shown ahead and to both sides.
RANGE_M = 25.0
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
    u0: float  #: the camera's pixel
    v0: float
    px_per_m: float

    @staticmethod
    def fit(width: int, height: int) -> RadarProjection:
        """The largest radar that fits, `RANGE_M` ahead and to both sides, a fifth of it behind."""
        margin = max(round(min(width, height) * 0.03), 6)
        side = (width / 2 - margin) / RANGE_M
        tall = (height - 2 * margin) / (RANGE_M * (1 + _BEHIND))
        scale = min(side, tall)
        top = margin + max(0.0, (tall - scale) * RANGE_M * (1 + _BEHIND)) * 0.25
        return RadarProjection(width, height, width / 2, top + scale * RANGE_M, scale)

    def pixels(self, xy_m: npt.ArrayLike) -> FloatArray:
        """Radar pixels [..., 2] of camera ground positions [..., 2] (x forward, y right)."""
        xy = np.asarray(xy_m, dtype=np.float64)
        return np.stack(
            [self.u0 + self.px_per_m * xy[..., 1], self.v0 - self.px_per_m * xy[..., 0]], axis=-1
        )


def draw_radar(
    data: OverlayData, size: tuple[int, int], *, fov_deg: float = 198.0, heading_deg: float = 0.0
) -> ImageArray:
    """The radar as a picture of `size` (width, height).

    `heading_deg`: the optical axis, to the right of the ground frame's x axis; it turns the
    field of view's wedge. Tracks beyond `RANGE_M` are drawn as marks on the outermost ring.
    """
    return _RadarView(data, size, fov_deg, heading_deg).draw()


class _RadarView:
    """One radar picture in the making."""

    def __init__(
        self, data: OverlayData, size: tuple[int, int], fov_deg: float, heading_deg: float
    ) -> None:
        self.frame = RadarProjection.fit(*size)
        self.image = _base(self.frame, fov_deg, heading_deg).copy()
        self.data, self.tracks, self.text = data, data.tracks, _text_height(size)
        self.at = self.frame.pixels(data.tracks.xy_m)
        self.reach = np.hypot(*data.tracks.xy_m.T)
        self.near = self.reach <= RANGE_M
        self.taken: list[Rect] = []

    def draw(self) -> ImageArray:
        """The finished picture."""
        image, text, data, tracks = self.image, self.text, self.data, self.tracks
        rows = data.pair_rows() or ()
        ends = self.at[list(rows)] if rows and self.near[list(rows)].all() else None
        self._draw_trails()
        if ends is not None and data.alerting:
            polyline(image, ends, PAPER, 5)
            polyline(image, ends, data.pair_colour, 3)
        elif ends is not None:
            dashed(image, ends, data.pair_colour, 2, 6.0)
        for row in range(len(tracks)):
            kind, at = Kind(int(tracks.kind[row])), self.at[row]
            if not self.near[row]:
                rim = tracks.xy_m[row] / max(self.reach[row], 1e-9) * RANGE_M
                circle(image, self.frame.pixels(rim), text * 0.35, shade(KIND_COLOUR[kind], 0.7))
                continue
            if row in rows and data.alerting:
                circle(image, at, text * 1.45, SIGNAL_COLOUR["ALERT"], max(round(text / 4), 2))
            velocity = tracks.velocity_mps[row]
            if np.hypot(*velocity) > 0.3:
                tip = self.frame.pixels(tracks.xy_m[row] + velocity * ARROW_S)
                arrow(image, at, tip, KIND_COLOUR[kind], max(round(text / 7), 1), text * 0.6)
            heading = math.atan2(velocity[1], velocity[0])
            _symbol(image, kind, at, text * 0.62, heading, unseen=bool(tracks.detection[row] < 0))
        if ends is not None:
            self._draw_distance(ends)
        for row in sorted(np.flatnonzero(self.near).tolist(), key=lambda row: row not in rows):
            self._draw_label(row)
        self._draw_list()
        return image

    def _draw_trails(self) -> None:
        tracks = self.tracks
        kinds = dict(
            zip(tracks.id[self.near].tolist(), tracks.kind[self.near].tolist(), strict=True)
        )
        for track_id, trail in self.data.history.items():
            if track_id not in kinds or len(trail) < 2:
                continue
            points, middle = self.frame.pixels(trail), len(trail) // 2
            colour = KIND_COLOUR[Kind(kinds[track_id])]
            # Older parts are darker, so that the trail shows the direction.
            polyline(self.image, points[: middle + 1], shade(colour, 0.4), 2)
            polyline(self.image, points[middle:], shade(colour, 0.65), 2)

    def _draw_distance(self, ends: FloatArray) -> None:
        """The pair's distance on its line, above arrows and symbols."""
        pair = self.data.decision.pair
        if pair is None:
            return
        word = f"{pair.distance_m:.1f} m"
        if np.hypot(*(ends[1] - ends[0])) < text_size(word, self.text, True)[0] + 4 * self.text:
            return  # no room on the line; the list below has the distance
        u, v = ends.mean(axis=0)
        self.taken.append(draw_tag(self.image, word, (u, v), self.text, self.data.pair_colour))

    def _draw_label(self, row: int) -> None:
        text, word, (u, v) = self.text, str(self.tracks.id[row]), self.at[row]
        reach = text * 1.1
        size = (float(text_size(word, text, True)[0] + 4), text + 4.0)
        bounds: Rect = (0, 0, self.frame.width, self.frame.height)
        box: Rect = (u - reach, v - reach, u + reach, v + reach)
        spot = place_label(size, box, self.taken, bounds, gap=0)
        self.taken.append(spot)
        colour = KIND_COLOUR[Kind(int(self.tracks.kind[row]))]
        draw_text(self.image, word, (spot[0] + 2, spot[1] + 2), text, colour, bold=True)

    def _draw_list(self) -> None:
        """Table of the tracks below the radar, nearest first, as many as fit."""
        image, frame, tracks, text = self.image, self.frame, self.tracks, self.text
        top = frame.v0 + RANGE_M * frame.px_per_m * _BEHIND + text * 1.6
        line = text * 2.1
        room = int((frame.height - top - text * 0.6) / line)
        if room < 2:
            return
        left = frame.u0 - RANGE_M * frame.px_per_m
        width = 2 * RANGE_M * frame.px_per_m
        name_x, columns = left + text * 2.2, [left + width * share for share in (0.56, 0.78, 1)]

        def draw_row(y: float, name: str, words: tuple[str, str], ink: Rgb) -> None:
            draw_text(image, name, (name_x, y), text, ink)
            for x, word in zip(columns, words, strict=False):
                draw_text(image, word, (x, y), text, ink, anchor="right")

        draw_row(top, "track", ("distance", "speed"), _FAINT)
        order = np.argsort(self.reach, kind="stable").tolist()
        for i, row in enumerate(order[: room - 1]):
            y = top + (i + 1) * line
            kind, unseen = Kind(int(tracks.kind[row])), bool(tracks.detection[row] < 0)
            at = np.array([left + text * 0.8, y + text / 2])
            _symbol(image, kind, at, text * 0.55, 0.0, unseen=unseen)
            speed = f"{np.hypot(*tracks.velocity_mps[row]):.1f} m/s"
            name = f"{kind.label} {tracks.id[row]}"
            draw_row(y, name, (f"{self.reach[row]:.1f} m", speed), PAPER)
            if unseen:
                draw_text(image, "unseen", (columns[2], y), text, _FAINT, anchor="right")


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
    arc = RANGE_M * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    wedge = np.concatenate([np.zeros((1, 2)), arc])
    polygon(image, frame.pixels(wedge), _SEEN)
    full = np.linspace(-np.pi, np.pi, 721)
    unit = np.stack([np.cos(full), np.sin(full)], axis=1)
    for degrees in range(-90, 91, 30):
        a = math.radians(degrees)
        spoke = np.array([[0.0, 0.0], [RANGE_M * math.cos(a), RANGE_M * math.sin(a)]])
        polyline(image, frame.pixels(spoke), shade(_RING, 0.6), 1)
    rings = np.arange(RING_STEP_M, RANGE_M + 1e-6, RING_STEP_M)
    for ring in rings.tolist():
        shown = np.where((ring * unit[:, :1]) >= -RANGE_M * _BEHIND, ring * unit, np.nan)
        polyline(image, frame.pixels(shown), _RING, 1)
    for ring in rings.tolist():
        # On the 15-degree ray, between the spokes, where neither the way ahead nor a spoke is hit.
        at = frame.pixels([ring * math.cos(math.radians(15)), ring * math.sin(math.radians(15))])
        word = f"{ring:.0f} m"
        wide = text_size(word, text)[0]
        u, v = at[0], at[1]
        back = (u - wide / 2 - 2, v - text / 2 - 3, u + wide / 2 + 2, v + text / 2 + 3)
        fill_rect(image, back, _SEEN if ring < RANGE_M else _GROUND)
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
