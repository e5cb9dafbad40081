"""The ground grid drawn into a picture, for `bikeped align --grid` and for documents."""

from __future__ import annotations

import numpy as np

from bikeped.overlay.drawing import INK, Rgb, draw_text, fill_rect, polyline, text_size
from bikeped.types import ImageArray
from bikeped.web.align_grid import GroundGrid

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
