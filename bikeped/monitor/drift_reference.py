"""The picture of a street as edge patches with their directions and ground places, and its file.

A patch is a square of *edge strength*: the gradient's magnitude over its mean nearby. It stays the
same when the light changes, when a shadow crosses it, and when what is bright by day is dark by
night. Patches are kept in a pyramid, so that a fit finds them from far away; nothing of the street
but these patches is stored.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from bikeped.errors import BikepedError, GeometryError
from bikeped.geometry.camera import GroundCamera
from bikeped.geometry.framing import Framing
from bikeped.geometry.lens import Lens
from bikeped.types import Float32Array, FloatArray, ImageArray

#: The reduced picture has this focal length, 2.1 px a degree, but at least MIN_WIDTH_PX columns.
FOCAL_PX, MIN_WIDTH_PX = 120.0, 320
COARSE_FOCAL_PX = 30.0  #: of the smallest picture of the pyramid: a patch spans 17 degrees of it
PATCH_PX = 9  #: side of a patch in every picture of the pyramid; one more on each side is stored
MAX_PATCHES, MIN_PATCHES = 200, 20
_CELL_PX = 12  #: at most one patch in a square of this side
_MAX_ELEVATION_DEG = 20.0  #: higher up are clouds and leaves
_MAX_RADIUS = 0.92  #: share of the image circle; at its rim the picture ends
_MIN_CONTRAST = 1.0  #: root mean square of the gradient in a patch, grey levels a pixel
_MIN_SAMENESS = 0.7  #: correlation of a patch between the pictures of a reference
#: Ground farther than GROUND_M, and all that is not ground, is FAR_M away: it shows no parallax.
GROUND_M, FAR_M = 20.0, 60.0
FORMAT: Literal["bikeped camera reference 1"] = "bikeped camera reference 1"


@dataclass(frozen=True)
class DriftReference:
    """What a camera saw where it was aligned.

    `camera` and `framing` are those of the alignment. `uv_px` [n, 2]: the patches' middles in
    sensor pixels; `ground_m` [n, 2]: their places on the ground, NaN where they are above it or
    farther than `GROUND_M`; `patches` [n, levels, 11, 11]: edge strength, finest level first;
    `sharpness`: mean gradient of the pictures, grey levels a pixel.
    """

    camera: GroundCamera
    framing: Framing
    uv_px: FloatArray
    ground_m: FloatArray
    patches: Float32Array
    sharpness: float

    def to_json(self) -> bytes:
        """The content of a reference file."""
        lens = {f.name: getattr(self.camera.lens, f.name) for f in fields(Lens) if f.init}
        camera = {f.name: getattr(self.camera, f.name) for f in fields(GroundCamera) if f.init}
        [None if math.isnan(x) else (x, y) for x, y in self.ground_m.tolist()]
        ground = [None if math.isnan(x) else (x, y) for x, y in self.ground_m.tolist()]
        return msgspec.json.encode(
            _File(
                format=FORMAT,
                camera={**camera, "lens": lens},
                framing=self.framing,
                sharpness=self.sharpness,
                uv_px=self.uv_px.tolist(),
                ground_m=ground,
                patches=self.patches.astype("<f2").tobytes(),
                complete=True,
            )
        )

    @staticmethod
    def from_json(content: bytes, name: str) -> DriftReference:
        """The reference of a file's content; `name` for messages. GeometryError when it is none."""
        try:
            file = msgspec.json.decode(content, type=_File)
            lens = msgspec.convert(file.camera.pop("lens"), dict[str, Any])
            camera: dict[str, Any] = {
                k: tuple(v) if isinstance(v, list) else v for k, v in file.camera.items()
            }
            made = GroundCamera(Lens(**{**lens, "k": tuple(lens["k"])}), **camera)
            shape = len(file.uv_px), len(levels_of(made, file.framing)), PATCH_PX + 2, PATCH_PX + 2
            patches = np.frombuffer(file.patches, "<f2").astype(np.float32).reshape(shape)
            nowhere = (math.nan, math.nan)
            ground = [nowhere if place is None else place for place in file.ground_m]
            if len(ground) != shape[0] or shape[0] < MIN_PATCHES or not np.isfinite(patches).all():
                raise ValueError(f"{shape[0]} places")
        except (msgspec.MsgspecError, BikepedError, ValueError, KeyError, TypeError) as error:
            raise GeometryError(
                f"{name}: is not a camera reference ({error}); align the camera again"
            ) from error
        return DriftReference(
            made, file.framing, np.array(file.uv_px), np.array(ground), patches, file.sharpness
        )


class _File(msgspec.Struct):
    format: Literal["bikeped camera reference 1"]
    camera: dict[str, Any]
    framing: Framing
    sharpness: float
    uv_px: list[tuple[float, float]]
    ground_m: list[tuple[float, float] | None]
    patches: bytes  #: base64 of float16, little-endian
    complete: Literal[True]  #: the last word: a file that was cut off has none


def levels_of(camera: GroundCamera, framing: Framing) -> list[tuple[int, int]]:
    """Widths and heights of the pyramid's pictures, finest first."""
    scale = min(camera.lens.focal_px / FOCAL_PX, framing.sensor_w / MIN_WIDTH_PX)
    scale = max(scale, 1.0)
    width = round(framing.sensor_w / scale)
    height = round(framing.sensor_h * width / framing.sensor_w)
    focal = camera.lens.focal_px * width / framing.sensor_w
    sizes = [(width, height)]
    for _ in range(min(max(round(math.log2(focal / COARSE_FOCAL_PX)), 1), 3)):
        sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
    return sizes


def reduced(picture: ImageArray, size: tuple[int, int]) -> ImageArray:
    """The picture ([h, w] grey or [h, w, 3] RGB) as a grey one of `size` (width, height)."""
    if picture.ndim == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.uint8)
    while picture.shape[1] >= 2 * size[0] and not (picture.shape[0] % 2 or picture.shape[1] % 2):
        half = picture.shape[1] // 2, picture.shape[0] // 2  # four times faster than at once
        picture = np.asarray(cv2.resize(picture, half, interpolation=cv2.INTER_AREA), np.uint8)
    if (picture.shape[1], picture.shape[0]) != size:
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    return picture


def edge_strength(grey: ImageArray) -> tuple[Float32Array, float]:
    """The gradient's magnitude over its mean nearby [h, w], and its mean in grey levels a pixel."""
    smooth = cv2.GaussianBlur(grey, (5, 5), 1.0, dst=None).astype(np.float32)
    du = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32)
    dv = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)
    gradient = cv2.magnitude(du, dv)
    nearby = cv2.blur(gradient, (31, 31))
    strength = np.asarray(gradient / (nearby + np.float32(0.5)), np.float32)
    return strength, float(cv2.mean(gradient)[0])


_half = PATCH_PX // 2
_STORED = np.stack(np.meshgrid(*[np.arange(-_half - 1.0, _half + 2)] * 2), -1).reshape(-1, 2)
COMPARED = np.stack(np.meshgrid(*[np.arange(-_half + 0.0, _half + 1)] * 2), -1).reshape(-1, 2)


def sampled(image: Float32Array, at_px: npt.NDArray[np.floating]) -> Float32Array:
    """The picture's values at pixels [..., 2], measured from its edge, between pixels linear."""
    u = (at_px[..., 0] - 0.5).astype(np.float32)
    v = (at_px[..., 1] - 0.5).astype(np.float32)
    read = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(read, np.float32)


def normalised(patch: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Patches [n, samples] with mean 0 and length 1, and the lengths [n] before."""
    centred = patch - patch.mean(axis=1, keepdims=True)
    length = np.sqrt(np.einsum("ks,ks->k", centred, centred))
    return centred / np.maximum(length, 1e-3)[:, None], length


def make_reference(
    pictures: Sequence[ImageArray], camera: GroundCamera, framing: Framing
) -> DriftReference:
    """The reference of some pictures ([h, w] grey or [h, w, 3] RGB, any scaled copies of the
    sensor's picture), best over some seconds: what moves between them is left out.

    GeometryError when fewer than `MIN_PATCHES` places can be recognised.
    """
    sizes = levels_of(camera, framing)
    stacks: list[list[Float32Array]] = [[] for _ in sizes]
    mean, sharpness = np.zeros(sizes[0][::-1], np.float32), 0.0
    for picture in pictures:
        grey = reduced(picture, sizes[0])
        mean += grey / np.float32(len(pictures))
        for level, stack in enumerate(stacks):
            strength, gradient = edge_strength(grey)
            stack.append(strength)
            sharpness += gradient / len(pictures) if level == 0 else 0.0
            grey = np.asarray(cv2.pyrDown(grey), np.uint8)
    view = framing.for_frame(*sizes[0])
    uv = _places(mean, camera, view)
    if len(uv):
        finest = [normalised(sampled(one, uv[:, None] + COMPARED))[0] for one in stacks[0]]
        middle = normalised(np.asarray(np.mean(finest, axis=0)))[0]
        same = np.min([np.einsum("ks,ks->k", middle, one) for one in finest], axis=0)
        uv = uv[same >= _MIN_SAMENESS][:MAX_PATCHES]
    if len(uv) < MIN_PATCHES:
        raise GeometryError(
            f"camera reference: only {len(uv)} places can be recognised in the picture, "
            f"{MIN_PATCHES} are needed; use a picture by day, or one with fewer road users"
        )
    ground, down = camera.ground(view.frame_to_crop(uv))
    near = down & (np.hypot(ground[:, 0], ground[:, 1]) < GROUND_M)
    patches = [
        sampled(np.asarray(np.mean(stack, axis=0), np.float32), uv[:, None] / 2**level + _STORED)
        for level, stack in enumerate(stacks)
    ]
    return DriftReference(
        camera,
        framing,
        uv_px=uv * view.scale,
        ground_m=np.where(near[:, None], ground, np.nan),
        patches=np.stack(patches, axis=1).reshape(len(uv), len(sizes), PATCH_PX + 2, PATCH_PX + 2),
        sharpness=sharpness,
    )


def _places(mean: Float32Array, camera: GroundCamera, view: Framing) -> FloatArray:
    """Pixels [n, 2] that are easy to recognise, best first, spread over what is worth watching."""
    height, width = mean.shape
    smooth = cv2.GaussianBlur(mean, (0, 0), 0.8)
    gradient = cv2.magnitude(
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8),
    )
    contrast = np.sqrt(np.maximum(cv2.blur(np.square(gradient), (7, 7)), 0))
    corner = np.sqrt(np.maximum(cv2.cornerMinEigenVal(smooth, 7), 0))
    score = corner / max(float(corner.max()), 1e-6)
    score += 0.1 * contrast / max(float(contrast.max()), 1e-6)
    uv = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    crop, margin = view.frame_to_crop(uv), (PATCH_PX / 2 + 2) * view.scale
    low, high = np.array(view.window_px[:2]) + margin, np.array(view.window_px[2:]) - margin
    rim = camera.lens.max_radius_px
    good = (contrast > _MIN_CONTRAST) & (crop > low).all(axis=-1) & (crop < high).all(axis=-1)
    radius = np.hypot(crop[..., 0] - camera.cx, crop[..., 1] - camera.cy)
    good &= radius < min(rim * _MAX_RADIUS, rim - margin)
    good &= camera.rays(crop)[..., 2] < math.sin(math.radians(_MAX_ELEVATION_DEG))
    score = np.where(good, score, 0)
    best = []
    for top in range(0, height, _CELL_PX):
        for left in range(0, width, _CELL_PX):
            cell = score[top : top + _CELL_PX, left : left + _CELL_PX]
            row, column = divmod(int(cell.argmax()), cell.shape[1])
            if cell[row, column] > 0:
                best.append((float(cell[row, column]), left + column + 0.5, top + row + 0.5))
    best.sort(reverse=True)
    return np.array([place[1:] for place in best], np.float64).reshape(-1, 2)
