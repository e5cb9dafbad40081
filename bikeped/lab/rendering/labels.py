"""Labels of a picture: visible silhouettes behind occluders, and their tight boxes. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bikeped.lab.rendering.sprite import Sprite, overlapping_slices
from bikeped.lab.simulation.camera_pose import CameraPose
from bikeped.types import BoolArray, Float32Array, FloatArray, Kind

#: What each kind of agent counts as: the default configuration's classes.
KINDS: dict[str, Kind] = {
    "pedestrian": Kind.PEDESTRIAN,
    "cyclist": Kind.CYCLIST,
    "motorcycle": Kind.CYCLIST,
    "car": Kind.VEHICLE,
    "bus": Kind.VEHICLE,
    "truck": Kind.VEHICLE,
}
_MIN_COVERAGE = 0.4  #: coverage of a pixel that belongs to the silhouette
_MIN_PX = 1.5  #: smaller than this on a side is not in the picture


@dataclass(frozen=True)
class DrawnObject:
    """One road user in one picture.

    `id` is the agent's; parked cars of the place have negative ones. `box_px`: u1, v1, u2, v2 of
    the visible silhouette in pixels of the picture, from its edges; `full_box_px`: of the whole
    silhouette, which may reach beyond the picture. `visible`: share of the silhouette that is
    neither hidden nor outside the picture. `xy_m`: true ground centre in the camera ground frame,
    `world_m` in the world; `heading_rad` counter-clockwise from east.
    """

    id: int
    kind: str
    label: Kind
    box_px: tuple[float, float, float, float]
    full_box_px: tuple[float, float, float, float]
    visible: float
    xy_m: tuple[float, float]
    world_m: tuple[float, float]
    heading_rad: float

    @property
    def distance_m(self) -> float:
        """Along the ground from below the lens."""
        return float(np.hypot(*self.xy_m))


@dataclass(frozen=True)
class Occluder:
    """A sprite that hides what is behind it; with a `kind` it gets a label."""

    sprite: Sprite
    id: int
    kind: str | None
    xy_m: FloatArray  #: in the world
    heading_rad: float


def label(
    occluders: list[Occluder], lit: BoolArray, pose: CameraPose, size: tuple[int, int]
) -> list[DrawnObject]:
    """Labels of the `occluders` that have a kind and show; they are given far ones first.

    `lit` [h, w]: where the lens shows the scene with enough light.
    """
    left: list[Float32Array | None] = []
    for i, near in enumerate(occluders):
        for far, cover in zip(occluders[:i], left, strict=True):
            if cover is not None:
                _hide(cover, far.sprite, near.sprite)
        whole = np.asarray(near.sprite.alpha, np.float32) / np.float32(255)
        left.append(whole if near.kind is not None else None)
    found = [
        _label(item, item.kind, cover, lit, pose, size)
        for item, cover in zip(occluders, left, strict=True)
        if cover is not None and item.kind is not None
    ]
    return [item for item in found if item is not None]


def _hide(cover: Float32Array, far: Sprite, near: Sprite) -> None:
    """Takes from `far`'s coverage what `near` covers."""
    height, width = cover.shape
    left, top = near.left - far.left, near.top - far.top
    spot = overlapping_slices((width, height), left, top, near.alpha.shape[1], near.alpha.shape[0])
    if spot is not None:
        rows, columns, near_rows, near_columns = spot
        cover[rows, columns] *= 1 - near.alpha[near_rows, near_columns].astype(np.float32) / 255


def _label(
    item: Occluder,
    kind: str,
    cover: Float32Array,
    lit: BoolArray,
    pose: CameraPose,
    size: tuple[int, int],
) -> DrawnObject | None:
    sprite = item.sprite
    spot = overlapping_slices(size, sprite.left, sprite.top, cover.shape[1], cover.shape[0])
    if spot is None:
        return None
    rows, columns, patch_rows, patch_columns = spot
    shows = cover[patch_rows, patch_columns] * lit[rows, columns]
    seen = shows >= _MIN_COVERAGE
    across, down = np.flatnonzero(seen.any(axis=0)), np.flatnonzero(seen.any(axis=1))
    if len(across) == 0:
        return None
    raw = np.array([across[0], down[0], across[-1] + 1, down[-1] + 1], np.float64)
    raw += np.array([columns.start, rows.start] * 2)
    # Where the silhouette's own edge shows, it is known better than to a pixel.
    full = np.array(sprite.full_box_px)
    box = np.where(np.abs(raw - full) <= 1.5, full, raw)
    box = np.clip(box, 0.0, (*size, *size))
    if (box[2:] - box[:2] < _MIN_PX).any():
        return None
    ground = pose.world_to_ground(item.xy_m)
    return DrawnObject(
        id=item.id,
        kind=kind,
        label=KINDS[kind],
        box_px=tuple(box.tolist()),
        full_box_px=sprite.full_box_px,
        visible=float(min(shows.sum() / max(sprite.area_px, 1e-6), 1.0)),
        xy_m=tuple(ground.tolist()),
        world_m=tuple(item.xy_m.tolist()),
        heading_rad=item.heading_rad,
    )
