"""The camera's picture with boxes, tracks, the decision's pair, and the state in words."""

from __future__ import annotations

import numpy as np

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
    overlap,
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
    banner: bool = True,
) -> ImageArray:
    """A copy of `rgb` [h, w, 3] with the frame's results drawn over it.

    `scale`: pixels of `rgb` per pixel of the full frame (boxes are in frame pixels).
    `ground_to_frame`: puts unseen tracks and the pair line where they lie; without it unseen
    tracks are left out and the pair line joins the boxes.
    """
    image = np.ascontiguousarray(rgb).copy()
    h, w = image.shape[:2]
    size = _text_height(w, h)
    top = _banner_height(w, h) if banner else 0
    bounds: Rect = (2, top + 2, w - 2, h - 2)
    footer = _footer_rect(data, size, bounds)
    taken: list[Rect] = [footer]
    labels: list[tuple[str, Rect, Rgb]] = []

    boxes = data.detections.box_px.astype(np.float64) * scale
    rows = data.pair_rows()
    ends = _pair_points(data, rows, boxes, scale, ground_to_frame)
    if ends is not None:
        _draw_pair(image, ends, data.pair_colour, size)
    _draw_unseen(image, data, scale, ground_to_frame, size, labels)
    _draw_boxes(image, data, boxes, rows, size, labels)
    _draw_distance(image, data, ends, taken, bounds, size)
    shown = [label for label in labels if overlap(label[1], (0, 0, w, h)) > 0]
    avoid = [box for _, box, _ in shown]
    for text, box, colour in shown:
        _draw_label(image, text, box, colour, taken, avoid, bounds, size)
    _draw_footer(image, data, footer, size)
    if banner:
        draw_banner(image, data, (0, 0, w, top))
    return image


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
        rule = data.decision.state.name
        if rule != name and name != "OFF":
            # The light holds ALERT for a while: show the rule's present state too.
            note = f"rule now: {rule}"
            room = text_size(note, small)[0] + pad
            draw_text(
                image, note, (x1 - pad, y0 + (tall - small) / 2), small, PAPER, anchor="right"
            )
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


def _banner_height(w: int, h: int) -> int:
    return int(np.clip(round(min(h, w * 9 / 16) * 0.085), 30, 96))


def _draw_boxes(
    image: ImageArray,
    data: OverlayData,
    boxes: FloatArray,
    rows: tuple[int, int] | None,
    size: int,
    labels: list[tuple[str, Rect, Rgb]],
) -> None:
    """Boxes, small ones over large ones; adds their labels, those of the pair first."""
    tracks = data.tracks
    row_of = {int(d): i for i, d in enumerate(tracks.detection) if d >= 0}
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    line = max(round(size / 6), 2)
    entries: list[tuple[bool, str, Rect, Rgb]] = []
    for d in np.argsort(-area, kind="stable").tolist():
        x0, y0, x1, y1 = boxes[d].tolist()
        box: Rect = (x0, y0, x1, y1)
        row = row_of.get(d)
        kind = Kind(int(data.detections.kind[d]))
        colour = KIND_COLOUR[kind]
        paired = row is not None and rows is not None and row in rows
        if paired and data.alerting:
            halo = line * 2 + 1
            wide: Rect = (x0 - halo, y0 - halo, x1 + halo, y1 + halo)
            outline(image, wide, PAPER, line + 3)
            outline(image, wide, SIGNAL_COLOUR["ALERT"], line + 1)
            box = wide
        outline(image, (x0, y0, x1, y1), INK, line + 2)
        outline(image, (x0, y0, x1, y1), colour, line)
        if row is None:
            text = f"{kind.label} {data.detections.confidence[d]:.2f}"
            colour = shade(colour, 0.7)
        else:
            speed = float(np.hypot(*tracks.velocity_mps[row]))
            text = f"{Kind(int(tracks.kind[row])).label} {tracks.id[row]}  {speed:.1f} m/s"
        entries.append((paired, text, box, colour))
    entries.reverse()
    entries.sort(key=lambda item: not item[0])
    labels[:0] = [(text, box, colour) for _, text, box, colour in entries]


def _draw_unseen(
    image: ImageArray,
    data: OverlayData,
    scale: float,
    ground_to_frame: GroundToFrame | None,
    size: int,
    labels: list[tuple[str, Rect, Rgb]],
) -> None:
    """A dashed ring on the ground at the predicted place of each track without a detection."""
    if ground_to_frame is None:
        return
    tracks = data.tracks
    turn = np.linspace(0, 2 * np.pi, 49)
    ring = RING_M * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    near = np.hypot(tracks.xy_m[:, 0], tracks.xy_m[:, 1]) <= UNSEEN_RANGE_M
    for row in np.flatnonzero((tracks.detection < 0) & near).tolist():
        kind = Kind(int(tracks.kind[row]))
        points = ground_to_frame(tracks.xy_m[row] + ring) * scale
        if not np.isfinite(points).any():
            continue
        line = max(round(size / 6), 2)
        # Eight dashes a turn, but never shorter than a dot.
        dash = max(size * 0.3, float(np.nansum(np.hypot(*np.diff(points, axis=0).T))) / 16)
        polyline(image, points, INK, 1)
        dashed(image, points, INK, line + 2, dash)
        dashed(image, points, KIND_COLOUR[kind], line, dash)
        low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        text = f"{kind.label} {tracks.id[row]}  unseen {tracks.unseen_s[row]:.1f} s"
        rect: Rect = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        labels.append((text, rect, shade(KIND_COLOUR[kind], 0.75)))


def _pair_points(
    data: OverlayData,
    rows: tuple[int, int] | None,
    boxes: FloatArray,
    scale: float,
    ground_to_frame: GroundToFrame | None,
) -> FloatArray | None:
    """The pair line in pixels [n, 2]: straight on the ground, hence bent in a fisheye picture."""
    if rows is None:
        return None
    tracks = data.tracks
    if ground_to_frame is not None:
        share = np.linspace(0, 1, 25)[:, None]
        xy_m = tracks.xy_m[rows[0]] * (1 - share) + tracks.xy_m[rows[1]] * share
        line = ground_to_frame(xy_m) * scale
        return line if np.isfinite(line).all(axis=1).sum() > 1 else None
    detection = tracks.detection[list(rows)]
    if (detection < 0).any():
        return None
    pair = boxes[detection]
    return np.stack([(pair[:, 0] + pair[:, 2]) / 2, pair[:, 3]], axis=1)


def _draw_pair(image: ImageArray, line: FloatArray, colour: Rgb, size: int) -> None:
    wide = max(round(size / 5), 2)
    polyline(image, line, INK, wide + 3)
    polyline(image, line, colour, wide)


def _draw_distance(
    image: ImageArray,
    data: OverlayData,
    line: FloatArray | None,
    taken: list[Rect],
    bounds: Rect,
    size: int,
) -> None:
    """The pair's distance at the middle of its line."""
    pair = data.decision.pair
    if line is None or pair is None:
        return
    shown = line[np.isfinite(line).all(axis=1)]
    inside = (shown >= bounds[:2]).all(axis=1) & (shown <= bounds[2:]).all(axis=1)
    if not inside.any():
        return
    u, v = shown[inside][int(inside.sum()) // 2]
    height = size + 1
    text = f"{pair.distance_m:.1f} m"
    half = (text_size(text, height, True)[0] + height) / 2 + 1
    fill_rect(image, (u - half, v - height - 1, u + half, v + height + 1), INK)
    taken.append(draw_tag(image, text, (u, v), height, data.pair_colour))


def _draw_label(
    image: ImageArray,
    text: str,
    box: Rect,
    colour: Rgb,
    taken: list[Rect],
    avoid: list[Rect],
    bounds: Rect,
    size: int,
) -> None:
    w, h = text_size(text, size)[0] + size, round(size * 1.9)
    spot = place_label((w, h), box, taken, bounds, avoid=avoid)
    taken.append(spot)
    fill_rect(image, (spot[0] - 1, spot[1] - 1, spot[2] + 1, spot[3] + 1), INK)
    fill_rect(image, spot, colour)
    draw_text(
        image, text, (spot[0] + size / 2, spot[1] + (h - size) / 2), size, readable_on(colour)
    )


def _footer_text(data: OverlayData) -> str:
    parts = [data.clock] if data.clock else []
    parts += [f"{data.time_s:.2f} s", f"frame {data.frame_number}"]
    if data.latency_s is not None:
        parts.append(f"latency {data.latency_s * 1000:.0f} ms")
    return "   ".join(parts)


def _footer_rect(data: OverlayData, size: int, bounds: Rect) -> Rect:
    width = text_size(_footer_text(data), size)[0] + 2 * size
    return (0, bounds[3] + 2 - 2.2 * size, float(width), bounds[3] + 2)


def _draw_footer(image: ImageArray, data: OverlayData, rect: Rect, size: int) -> None:
    fill_rect(image, rect, INK, 0.72)
    draw_text(image, _footer_text(data), (size, rect[1] + 0.6 * size), size, PAPER)
