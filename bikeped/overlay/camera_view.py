"""The camera's picture with boxes, tracks, the decision's pair, and the state in words."""

from __future__ import annotations

import numpy as np

from bikeped.geometry.boxes import box_area, intersection_area
from bikeped.overlay.drawing import (
    INK,
    KIND_COLOUR,
    PAPER,
    SIGNAL_COLOUR,
    Rect,
    Rgb,
    dashed,
    draw_tag,
    draw_text,
    fill_rect,
    hatch,
    outline,
    place_label,
    polyline,
    readable_on,
    shade,
    text_size,
    wrap_text,
)
from bikeped.overlay.overlay_data import GroundToFrame, OverlayData
from bikeped.types import FloatArray, ImageArray, Kind

#: A coasting track is drawn as a ring of this radius lying on the ground.
RING_M = 0.6
#: Coasting tracks beyond this are not drawn: their labels at the horizon would hide others.
UNSEEN_RANGE_M = 40.0


def draw_overlay(
    rgb: ImageArray,
    data: OverlayData,
    *,
    scale: float = 1.0,
    ground_to_frame: GroundToFrame | None = None,
) -> ImageArray:
    """A copy of `rgb` [h, w, 3] with the frame's results drawn over it.

    `scale`: pixels of `rgb` per pixel of the full frame (boxes are in frame pixels).
    `ground_to_frame`: puts unseen tracks and the pair line where they lie; without it unseen
    tracks are left out and the pair line joins the boxes.
    """
    return _CameraView(rgb, data, scale, ground_to_frame).draw()


def draw_banner(image: ImageArray, data: OverlayData, rect: Rect) -> None:
    """The state's name and the reason for it, on the light's colour, into `rect` of `image`."""
    name = data.shown_name
    colour = SIGNAL_COLOUR.get(name, SIGNAL_COLOUR["OFF"])
    x0, y0, x1, y1 = rect
    tall = y1 - y0
    big, small = max(round(tall * 0.38), 9), max(round(tall * 0.23), 8)
    pad = tall * 0.32
    wide = text_size(name, big, True)[0] + 2 * pad
    if name == "FAULT":
        hatch(image, rect, colour, INK, max(round(tall * 0.4), 4))
        fill_rect(image, (x0 + pad, y0 + 3, x0 + pad + wide, y1 - 3), INK)
        fill_rect(image, (x0 + pad + wide, y0 + 3, x1 - pad, y1 - 3), INK, 0.88)
        draw_text(image, name, (x0 + 2 * pad, y0 + (tall - big) / 2), big, colour, bold=True)
        left = x0 + pad + wide + pad / 2
    else:
        fill_rect(image, rect, INK)
        fill_rect(image, (x0, y0, x0 + wide, y1), colour)
        fill_rect(image, (x0, y1 - max(tall * 0.06, 2), x1, y1), colour)
        ink = readable_on(colour)
        draw_text(image, name, (x0 + pad, y0 + (tall - big) / 2), big, ink, bold=True)
        left = x0 + wide + pad
        decision = data.decision
        rule = (decision.state if decision.raw is None else decision.raw).name
        if rule != name and name != "OFF":
            # The light holds ALERT for a while: show the rule's present state too.
            note = f"rule now: {rule}"
            room = text_size(note, small)[0] + pad
            at = (x1 - pad, y0 + (tall - small) / 2)
            draw_text(image, note, at, small, PAPER, anchor="right")
            x1 -= room
    lines = wrap_text(_reason(data), small, x1 - pad - left, 2)
    step = small * 1.7
    first = y0 + (tall - small - step * (len(lines) - 1)) / 2
    for i, words in enumerate(lines):
        draw_text(image, words, (left, first + i * step), small, PAPER)


def _reason(data: OverlayData) -> str:
    """The sentence without the state's name, which is shown beside it."""
    head, colon, rest = data.sentence.partition(": ")
    if not colon or head != data.decision.state.name:
        return data.sentence
    return rest[:1].upper() + rest[1:]


def _text_height(w: int, h: int) -> int:
    """Height of capitals in pixels: readable in a 432-line clip, not too large at 1080 lines."""
    return int(np.clip(round(min(h, w * 9 / 16) / 58), 9, 22))


class _CameraView:
    """One picture in the making; pixels are those of the drawn picture."""

    def __init__(
        self,
        rgb: ImageArray,
        data: OverlayData,
        scale: float,
        ground_to_frame: GroundToFrame | None,
    ) -> None:
        self.image = np.ascontiguousarray(rgb).copy()
        self.h, self.w = self.image.shape[:2]
        self.data, self.scale, self.ground_to_frame = data, scale, ground_to_frame
        self.size = _text_height(self.w, self.h)
        self.line_px = max(round(self.size / 6), 2)
        self.boxes = data.detections.box_px.astype(np.float64) * scale
        self.rows = data.pair_rows()
        self.taken: list[Rect] = []  #: covered by text already
        self.labels: list[tuple[str, Rect, Rgb]] = []

    def draw(self) -> ImageArray:
        """The finished picture."""
        w, h = self.w, self.h
        self.bounds: Rect = (2, 2, w - 2, h - 2)
        footer_text, footer_rect = self._footer()
        line = self._pair_line()
        if line is not None:
            wide = max(round(self.size / 5), 2)
            polyline(self.image, line, INK, wide + 3)
            polyline(self.image, line, self.data.pair_colour, wide)
        self._draw_unseen()
        self._draw_boxes()
        self._draw_distance(line)
        shown = [
            label
            for label in self.labels
            if intersection_area(np.array(label[1]), np.array([0, 0, w, h])) > 0
        ]
        avoid = [box for _, box, _ in shown]
        for text, box, colour in shown:
            self._draw_label(text, box, colour, avoid)
        fill_rect(self.image, footer_rect, INK, 0.72)
        at = (self.size, footer_rect[1] + 0.6 * self.size)
        draw_text(self.image, footer_text, at, self.size, PAPER)
        return self.image

    def _draw_boxes(self) -> None:
        """Boxes, small ones over large ones; adds their self.labels, those of the pair first."""
        tracks = self.data.tracks
        row_of = {int(d): i for i, d in enumerate(tracks.detection) if d >= 0}
        line = self.line_px
        entries: list[tuple[bool, str, Rect, Rgb]] = []
        for d in np.argsort(-box_area(self.boxes), kind="stable").tolist():
            x0, y0, x1, y1 = box = tuple(self.boxes[d].tolist())
            row = row_of.get(d)
            kind = Kind(int(self.data.detections.kind[d]))
            colour = KIND_COLOUR[kind]
            paired = row is not None and self.rows is not None and row in self.rows
            if paired and self.data.alerting:
                halo = line * 2 + 1
                box = (x0 - halo, y0 - halo, x1 + halo, y1 + halo)
                outline(self.image, box, PAPER, line + 3)
                outline(self.image, box, SIGNAL_COLOUR["ALERT"], line + 1)
            outline(self.image, (x0, y0, x1, y1), INK, line + 2)
            outline(self.image, (x0, y0, x1, y1), colour, line)
            if row is None:
                text = f"{kind.label} {self.data.detections.confidence[d]:.2f}"
                colour = shade(colour, 0.7)
            else:
                speed = float(np.hypot(*tracks.velocity_mps[row]))
                text = f"{Kind(int(tracks.kind[row])).label} {tracks.id[row]}  {speed:.1f} m/s"
            entries.append((paired, text, box, colour))
        entries.reverse()
        entries.sort(key=lambda item: not item[0])
        self.labels[:0] = [(text, box, colour) for _, text, box, colour in entries]

    def _draw_unseen(self) -> None:
        """A dashed ring on the ground at the predicted place of each track without a detection."""
        if self.ground_to_frame is None:
            return
        tracks = self.data.tracks
        turn = np.linspace(0, 2 * np.pi, 49)
        ring = RING_M * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        near = np.hypot(tracks.xy_m[:, 0], tracks.xy_m[:, 1]) <= UNSEEN_RANGE_M
        for row in np.flatnonzero((tracks.detection < 0) & near).tolist():
            kind = Kind(int(tracks.kind[row]))
            points = self.ground_to_frame(tracks.xy_m[row] + ring) * self.scale
            if not np.isfinite(points).any():
                continue
            line = self.line_px
            # Eight dashes a turn, but never shorter than a dot.
            dash = max(self.size * 0.3, float(np.nansum(np.hypot(*np.diff(points, axis=0).T))) / 16)
            polyline(self.image, points, INK, 1)
            dashed(self.image, points, INK, line + 2, dash)
            dashed(self.image, points, KIND_COLOUR[kind], line, dash)
            low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
            text = f"{kind.label} {tracks.id[row]}  unseen {tracks.unseen_s[row]:.1f} s"
            rect: Rect = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
            self.labels.append((text, rect, shade(KIND_COLOUR[kind], 0.75)))

    def _pair_line(self) -> FloatArray | None:
        """The pair line in pixels [n, 2]: straight on the ground, so bent in a fisheye picture."""
        if self.rows is None:
            return None
        tracks = self.data.tracks
        if self.ground_to_frame is not None:
            share = np.linspace(0, 1, 25)[:, None]
            xy_m = tracks.xy_m[self.rows[0]] * (1 - share) + tracks.xy_m[self.rows[1]] * share
            line = self.ground_to_frame(xy_m) * self.scale
            return line if np.isfinite(line).all(axis=1).sum() > 1 else None
        detection = tracks.detection[list(self.rows)]
        if (detection < 0).any():
            return None
        pair = self.boxes[detection]
        return np.stack([(pair[:, 0] + pair[:, 2]) / 2, pair[:, 3]], axis=1)

    def _draw_distance(self, line: FloatArray | None) -> None:
        """The pair's distance at the middle of its line."""
        pair = self.data.decision.pair
        if line is None or pair is None:
            return
        shown = line[np.isfinite(line).all(axis=1)]
        inside = (shown >= self.bounds[:2]).all(axis=1) & (shown <= self.bounds[2:]).all(axis=1)
        if not inside.any():
            return
        u, v = shown[inside][int(inside.sum()) // 2]
        height = self.size + 1
        text = f"{pair.distance_m:.1f} m"
        half = (text_size(text, height, True)[0] + height) / 2 + 1
        fill_rect(self.image, (u - half, v - height - 1, u + half, v + height + 1), INK)
        self.taken.append(draw_tag(self.image, text, (u, v), height, self.data.pair_colour))

    def _draw_label(self, text: str, box: Rect, colour: Rgb, avoid: list[Rect]) -> None:
        w, h = text_size(text, self.size)[0] + self.size, round(self.size * 1.9)
        spot = place_label((w, h), box, self.taken, self.bounds, avoid=avoid)
        self.taken.append(spot)
        fill_rect(self.image, (spot[0] - 1, spot[1] - 1, spot[2] + 1, spot[3] + 1), INK)
        fill_rect(self.image, spot, colour)
        at = (spot[0] + self.size / 2, spot[1] + (h - self.size) / 2)
        draw_text(self.image, text, at, self.size, readable_on(colour))

    def _footer(self) -> tuple[str, Rect]:
        """The footer's text and its place at the lower left edge, which is taken."""
        data = self.data
        parts = [data.clock] if data.clock else []
        parts += [f"{data.time_s:.2f} s", f"frame {data.frame_number}"]
        if data.latency_s is not None:
            parts.append(f"latency {data.latency_s * 1000:.0f} ms")
        text = "   ".join(parts)
        width = text_size(text, self.size)[0] + 2 * self.size
        bottom = self.bounds[3] + 2
        rect: Rect = (0, bottom - 2.2 * self.size, float(width), bottom)
        self.taken.append(rect)
        return text, rect
