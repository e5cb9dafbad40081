"""Pictures of drawn boards: every pixel's rays meet the (bent) board, smoothed, with noise.

The truth of each corner is `synthetic.true_corners`; the picture is that scene as a camera would
have it, so that corner finders can be held to hundredths of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from synthetic_boards import FLAT, BoardBend, BoardPose, DrawnCamera

from bikeped.lab.calibration.board_view import BoardPattern
from bikeped.types import FloatArray, ImageArray

_ROWS_AT_ONCE = 128
_STEPS = 8  # of the fixed point that finds a bent board along a ray


@dataclass(frozen=True)
class RenderStyle:
    """How a board image is drawn: grey levels 0 to 255, smoothing and noise.

    `margin` is the paper's white border around the outer squares, in squares. `occluded` hides this
    share of the board's width and a third of its height under a dark patch, at a place that `seed`
    chooses. `shade` darkens the picture toward the rim by this share.
    """

    black: float = 35.0
    white: float = 215.0
    around: float = 120.0
    margin: float = 0.7
    blur_px: float = 0.7  #: standard deviation of the lens's and the sensor's smoothing
    noise: float = 1.5  #: standard deviation, grey levels
    shade: float = 0.3
    occluded: float = 0.0
    clutter: float = 25.0  #: how much the surroundings vary, grey levels
    samples: int = 4  #: rays along each side of a pixel; more for hundredths of a pixel


PLAIN = RenderStyle()


def draw_picture(
    camera: DrawnCamera,
    pattern: BoardPattern,
    pose: BoardPose,
    *,
    style: RenderStyle = PLAIN,
    bend: BoardBend = FLAT,
    seed: int = 0,
) -> ImageArray:
    """Grey picture [height, width] of one board; black outside the image circle."""
    rng = np.random.default_rng(seed)
    picture = _surroundings(camera, style, rng)
    u0, v0, u1, v1 = _bounds(camera, pattern, pose, bend, style.margin + 1)
    hidden = _patch(pattern, style, rng)
    for top in range(v0, v1, _ROWS_AT_ONCE):
        low = min(top + _ROWS_AT_ONCE, v1)
        nodes = _board_positions(camera, pattern, pose, bend, (u0, top, u1, low))
        board, cover = _pixels(nodes, pattern, style, hidden)
        part = picture[top:low, u0:u1]
        part[...] = part * (1 - cover) + board
    for row in range(camera.height):
        out = _radius(camera, row) / camera.lens.max_radius_px
        picture[row] *= (out <= 1) * (1 - style.shade * out * out)
    if style.blur_px > 0:
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), style.blur_px), np.float32)
    picture += np.float32(style.noise) * rng.standard_normal(picture.shape, np.float32)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def _board_positions(
    camera: DrawnCamera,
    pattern: BoardPattern,
    pose: BoardPose,
    bend: BoardBend,
    window: tuple[int, int, int, int],
) -> FloatArray:
    """[rows + 1, columns + 1, 2] where the rays of pixel corners meet the board; NaN beside it.

    In squares from the outer corner of the first printed square.
    """
    u0, v0, u1, v1 = window
    uv = np.empty((v1 - v0 + 1, u1 - u0 + 1, 2))
    uv[..., 0] = np.arange(u0, u1 + 1) - 0.5
    uv[..., 1] = (np.arange(v0, v1 + 1) - 0.5)[:, None]
    ray = camera.rays(uv) @ pose.rotation  # in board axes
    eye = -pose.translation_m @ pose.rotation
    depth = np.zeros(uv.shape[:2])
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(1 if bend == FLAT else _STEPS):
            reach = (depth - eye[2]) / ray[..., 2]
            xy = eye[:2] + ray[..., :2] * reach[..., None]
            if bend != FLAT:
                depth = np.clip(bend.depth_m(pattern, xy), -pattern.square_m, pattern.square_m)
        xy[~(reach > 0)] = np.nan
    outer = np.array([pattern.columns + 1, pattern.rows + 1]) / 2
    return np.asarray(xy / pattern.square_m + outer)


def _pixels(
    nodes: FloatArray,
    pattern: BoardPattern,
    style: RenderStyle,
    hidden: tuple[float, float, float, float] | None,
) -> tuple[FloatArray, FloatArray]:
    """What each pixel [h, w] gets from the board (grey level times cover), and its cover.

    A pixel whose corners all lie in one square is that square's; only the others take
    `style.samples` rays along each side, their board positions bilinear between its corners.
    """
    corner = np.stack([nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]])
    value, covers = _squares(corner, pattern, style, hidden)
    plain = (value == value[0]).all(0) & (covers == covers[0]).all(0)
    board, cover = value[0] * covers[0], covers[0]
    mixed = corner[:, ~plain]
    step = (np.arange(style.samples) + 0.5) / style.samples
    x, y = (side.ravel()[:, None, None] for side in np.meshgrid(step, step))
    fine = mixed[0] * (1 - x) * (1 - y) + mixed[1] * x * (1 - y)
    fine += mixed[2] * (1 - x) * y + mixed[3] * x * y
    value, covers = _squares(fine, pattern, style, hidden)
    board[~plain] = (value * covers).mean(0)
    cover[~plain] = covers.mean(0)
    return board, cover


def _squares(
    xy: FloatArray,
    pattern: BoardPattern,
    style: RenderStyle,
    hidden: tuple[float, float, float, float] | None,
) -> tuple[FloatArray, FloatArray]:
    """Grey levels of board positions, and 1 where there is a board."""
    with np.errstate(invalid="ignore"):
        x, y = xy[..., 0], xy[..., 1]
        column, row = np.floor(x), np.floor(y)
        printed = (column >= 0) & (column <= pattern.columns) & (row >= 0) & (row <= pattern.rows)
        dark = printed & ((column + row) % 2 == 0)
        m = style.margin
        covers = (x > -m) & (x < pattern.columns + 1 + m) & (y > -m) & (y < pattern.rows + 1 + m)
        value = np.where(dark, style.black, style.white)
        if hidden is not None:
            x0, y0, x1, y1 = hidden
            value = np.where((x > x0) & (x < x1) & (y > y0) & (y < y1), style.black * 1.5, value)
    return value, covers.astype(np.float64)


def _patch(
    pattern: BoardPattern, style: RenderStyle, rng: np.random.Generator
) -> tuple[float, float, float, float] | None:
    if style.occluded <= 0:
        return None
    wide, high = (pattern.columns + 1) * style.occluded, (pattern.rows + 1) / 3
    x = rng.uniform(0, pattern.columns + 1 - wide)
    y = rng.uniform(0, pattern.rows + 1 - high)
    return x, y, x + wide, y + high


def _bounds(
    camera: DrawnCamera, pattern: BoardPattern, pose: BoardPose, bend: BoardBend, margin: float
) -> tuple[int, int, int, int]:
    """Pixel window that holds the board with `margin` squares around its inner corners."""
    x = np.linspace(-1, 1, 60) * ((pattern.columns - 1) / 2 + margin) * pattern.square_m
    y = np.linspace(-1, 1, 60) * ((pattern.rows - 1) / 2 + margin) * pattern.square_m
    grid = np.stack([*np.meshgrid(x, y)], axis=-1).reshape(-1, 2)
    edge = np.concatenate([grid, bend.depth_m(pattern, grid)[:, None]], axis=1)
    uv, inside = camera.project(pose.to_camera(edge))
    if not inside.any():
        return 0, 0, 0, 0
    low = np.maximum(np.floor(uv[inside].min(0)).astype(int) - 8, 0)
    high = np.ceil(uv[inside].max(0)).astype(int) + 8
    return low[0], low[1], min(high[0], camera.width), min(high[1], camera.height)


def _surroundings(
    camera: DrawnCamera, style: RenderStyle, rng: np.random.Generator
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    coarse = rng.normal(0, style.clutter, (12, 12)).astype(np.float32)
    size = (camera.width, camera.height)
    out = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC) + np.float32(style.around)
    return np.asarray(np.clip(out, 0, 255), np.float32)


def _radius(camera: DrawnCamera, row: int) -> FloatArray:
    return np.asarray(np.hypot(np.arange(camera.width) - camera.cx, row - camera.cy))
